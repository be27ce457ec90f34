"""Another process beside a test, which says when it has what the test waits for."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from rigs.files.places import ROOT


@contextlib.contextmanager
def running(code: str, *words: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Yield a process that runs Python code in a folder, when it has printed a line; then kill it.

    ``words``: its ``sys.argv[1:]``.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", code, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    process.stdout.readline()
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
