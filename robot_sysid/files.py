"""Output files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from robot_sysid.errors import InputError


@contextlib.contextmanager
def whole_file(path_or_file: str | os.PathLike[str] | TextIO) -> Iterator[TextIO]:
    """Yield a text file to write; a path appears only once the block ends without an error.

    Raises:
        InputError: the folder cannot be written to.
    """
    if not isinstance(path_or_file, (str, os.PathLike)):
        yield path_or_file
        return
    path = Path(path_or_file)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="\n") as file:
            yield file
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink()
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
