"""A bound on what a compressed ROS bag unpacks to.

The library behind ``ros_bag`` unpacks each chunk, message or file whole, whatever comes out: a few
kilobytes may become the computer's whole memory, or disk. Here what it unpacks with gets a bound.
"""

from __future__ import annotations

from io import BytesIO
from typing import Any

MOST_RATIO, ALWAYS = 100, 10**8
"""Recordings shrink to a tenth; a piece may unpack to 100 times its size, or to 100 MB."""
_BLOCK = 2**20


class TooMuchError(Exception):
    """A piece of a bag unpacks to more than the bound."""


def bound_unpacking() -> None:
    """Have ``rosbags`` unpack no more than the bound, in this process from now on."""
    import bz2

    import lz4.frame
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap as mcap

    two = {"bz2": Bounded(bz2).decompress, "lz4": Bounded(lz4.frame).decompress}
    getattr(ros1, "decompressors", {}).update(two)
    for module, name in ((ros1, "bz2"), (ros1, "lz4"), (mcap, "lz4")):
        setattr(module, f"{name}_decompress", two[name])
    for module in (mcap, ros2):
        library = getattr(module, "zstd", None)
        if library is not None and not isinstance(library, Bounded):
            setattr(module, "zstd", Bounded(library))  # noqa: B010
    _bound_zstandard(mcap, ros2)


def _bound_zstandard(mcap: Any, ros2: Any) -> None:
    """The same for the last ``rosbags`` for Python 3.9, which unpacks with ``zstandard``."""
    library = getattr(ros2, "zstandard", None)
    if library is not None and not isinstance(library, Bounded):
        ros2.zstandard = Bounded(library)
        mcap.DECOMPRESSORS["zstd"] = ros2.zstandard.decompress


class Bounded:
    """A compression library that reads within the bound.

    Args:
        library: a module like ``bz2``.
    """

    def __init__(self, library: Any) -> None:
        self._library = library

    def __getattr__(self, name: str) -> Any:
        return getattr(self._library, name)

    def decompress(self, packed: bytes, _: int = 0) -> bytes:
        """Return the content of packed bytes, or raise TooMuchError."""
        content = BytesIO()
        self.copy_stream(BytesIO(packed), content)
        return content.getvalue()

    def ZstdDecompressor(self) -> Bounded:
        """Return what ``zstandard`` has its functions in."""
        return self

    def copy_stream(self, packed: Any, content: Any) -> None:
        """Write the content of a packed file to another, or raise TooMuchError."""
        with self.open(packed) as stream:
            while piece := stream.read(_BLOCK):
                content.write(piece)

    def open(self, file: Any, mode: str = "rb", **options: Any) -> Any:
        """Open a file as the library does; reading on beyond the bound raises TooMuchError."""
        stream = self._library.open(file, mode, **options)
        if mode != "rb" or not hasattr(file, "seek"):
            return stream
        size = file.seek(0, 2)
        file.seek(0)
        return _Stream(stream, max(ALWAYS, MOST_RATIO * size))


class _Stream:
    """What comes out of a packed stream, up to ``most`` bytes."""

    def __init__(self, stream: Any, most: int) -> None:
        self._stream, self._most, self._read = stream, most, 0

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        """Return the next bytes, at most ``size``."""
        piece: bytes = self._stream.read(size)
        self._read += len(piece)
        if self._read > self._most:
            raise TooMuchError(
                f"a piece of it unpacks to more than {self._most / 1e6:g} MB, far more than any "
                "recording would; record it again without compression"
            )
        return piece
