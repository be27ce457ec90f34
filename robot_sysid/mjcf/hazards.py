"""What MuJoCo must not be shown: a model at which it would wait for ever, end the process, take
hours or eat the memory is refused by its text and by the first bytes of its files.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.assets import Asset, find_assets
from robot_sysid.mjcf.documents import SUFFIXES, ModelDocument, Node, read_document

MOST_MEMORY = 4e8
"""What textures, height fields, meshes and blocks of numbers may take in MuJoCo together [bytes]:
66 million pixels; a plan, which copies the model, takes up to four times as much."""
MOST_COPIES = 3000
"""Copies of a part; MuJoCo takes the square of their number, a minute for 20 000."""
# Bytes per cell, and per byte of a file, as measured with MuJoCo 4.0: three colours in the
# compiler and in the model, a height field's floats four times.
_NUMBER = 16.0
_TEXEL = 6.0
_HEIGHT = 16.0
_FILE = 2.0
# Per triangle of a mesh: a quarter of what a plan takes, and three times what the model keeps.
_TRIANGLE = 450.0
# An OBJ file is read line by line only where it may have more triangles; bytes of a line that is
# cut into words.
_FEW = 20_000
_LONG = 100_000
_CELLS = {"hfield": ("nrow", "ncol"), "numeric": ("size",), "user": ("dim",)}
_COPIED = ("replicate", "composite", "flexcomp")
_PNG = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_DEFLATE = 1032.0
"""So many bytes at most come out of one that was compressed."""
_STL = 50.0
"""Bytes of a triangle in a binary STL file, the only kind that MuJoCo reads."""


def refuse_hazards(
    document: ModelDocument,
    mesh_dir: Path | None = None,
    above: tuple[Path, ...] = (),
    known: dict[Path, float] | None = None,
) -> float:
    """Raise ModelError for a document that MuJoCo must not even be shown; return the memory that it
    takes [bytes] with all that it attaches, but for what it is attached by and what is known.
    """
    own = document.path.resolve()
    attached = Counter[str]()
    known = {} if known is None else known
    needed: list[tuple[float, str]] = []
    for node, times in _repeated(document, document.root, 1.0):
        needed.append((_stated(node), f"<{node.tag}> in line {node.line}"))
        attached[node.get("model") or ""] += (
            math.ceil(times) if node.tag == "attach" else 0
        )
    for asset in find_assets(document, mesh_dir):
        _refuse_pipes(document, asset)
        if asset.path is None:
            continue
        path = asset.path.resolve()
        tag = asset.node.tag
        form = (asset.node.get("content_type") or path.suffix).lower()
        memory = _of_file(path, tag, form) if os.access(path, os.R_OK) else 0.0
        if tag == "model" and path.suffix.lower() in SUFFIXES:
            if path in (*above, own):
                fault = f"attaches itself by way of {asset.name}; take it out"
                raise ModelError(f"{document.path} {fault}")
            if path not in known:
                known[path] = refuse_hazards(
                    read_document(path), None, (*above, own), known
                )
            memory = known[path] * (1 + attached[asset.node.get("name") or ""])
        needed.append((memory, asset.name))
    # Each use of a file is read anew; a URDF's uses of a mesh are one.
    total = math.fsum(
        size for size, _ in (needed if document.kind == "mjcf" else {*needed})
    )
    if total > MOST_MEMORY:
        raise ModelError(
            f"{document.path}: its textures, height fields, meshes and numbers take "
            f"{total / 1e9:.3g} GB when unpacked, more than the {MOST_MEMORY / 1e9:g} GB that are "
            f"read; make them smaller, or take them out (largest: {max(needed)[1]})"
        )
    return total


def _repeated(
    document: ModelDocument, node: Node, times: float
) -> Iterator[tuple[Node, float]]:
    """Yield an element and all below it with how often each is repeated, or raise ModelError."""
    # MuJoCo takes the name of a class that it does not know for a format of printf.
    if "%" in (node.get("class") or ""):
        fault = f"the class {node.get('class')!r} of a {node.tag} has a % in its name; rename it"
        raise ModelError(f"{document.path}: {fault}")
    if node.tag in _COPIED:
        times *= max(1.0, _product(node.get("count")))
    if times > MOST_COPIES:
        fault = f"a {node.tag} makes {times:.3g} copies; at most {MOST_COPIES} are read"
        raise ModelError(f"{document.path}: {fault}")
    yield node, times
    for child in node.children():
        yield from _repeated(document, child, times)


def _stated(node: Node) -> float:
    """Return the memory that an element asks for by its numbers [bytes]."""
    if node.tag == "size":
        # What a process reserves for motion is not taken before it is used.
        counts = (
            _product(v) for name, v in node.attributes.items() if name != "memory"
        )
        return max([0.1 * _bytes(node), *(_NUMBER * count for count in counts)])
    if node.tag == "texture":
        width = _product(node.get("width"))
        flat = node.get("type") == "2d"
        return _TEXEL * width * (_product(node.get("height")) if flat else 6.0 * width)
    return _NUMBER * math.prod(
        _product(node.get(name)) for name in _CELLS.get(node.tag, ("",))
    )


def _bytes(node: Node) -> float:
    """Return the memory that a <size> asks for: a number with K, M, G, T, P or E behind it."""
    text = (node.get("memory") or "0").strip()
    power = "KMGTPE".find(text[-1:].upper()) + 1
    return _product(text[: -1 if power else None]) * 1024.0**power


def _product(text: str | None) -> float:
    """Return the product of an attribute's numbers; zero for none, of which MuJoCo will speak."""
    try:
        return math.prod(float(word) for word in (text or "0").split())
    except ValueError:
        return 0.0


def _refuse_pipes(document: ModelDocument, asset: Asset) -> None:
    # What was not found is no file, but may be there; too long a name is an error to Path.
    name = Path(asset.name.replace("\\", "/")).name
    for path in (folder / name for folder in asset.looked_in if asset.path is None):
        if os.path.exists(path) and not os.path.isdir(path):
            raise ModelError(
                f"{document.path}: {path} is not a file but a pipe or a device"
            )


def _of_file(path: Path, tag: str, form: str) -> float:
    """Return the memory that a file takes [bytes]; of a PNG by its head.

    ``form`` is the end of its name, or what the model says instead.
    """
    size = path.stat().st_size
    if tag == "mesh" and _FILE * size <= MOST_MEMORY:
        return max(_FILE * size, _TRIANGLE * _triangles(path, form))
    with path.open("rb") as stream:
        head = stream.read(26)
        is_image = (
            head.startswith(_PNG) and len(head) == 26 and tag in ("texture", "hfield")
        )
        if not is_image or size > MOST_MEMORY:
            return size * (_HEIGHT / 4.0 if tag == "hfield" else _FILE)
        width, height, depth, kind = struct.unpack(">IIBB", head[16:])
        raw = height * (1.0 + width * _CHANNELS.get(kind, 4) * depth / 8.0)
        memory = max(
            2.0 * raw, width * height * (_TEXEL if tag == "texture" else _HEIGHT)
        )
        # MuJoCo unpacks all that is there, and only then looks how much it should have been.
        may_be_more = _DEFLATE * size > MOST_MEMORY > memory
        is_bomb = may_be_more and _unpacks_beyond(stream, 2.0 * raw + 1e6)
        return _DEFLATE * size if is_bomb else memory


def _triangles(path: Path, form: str) -> float:
    """Return how many triangles a mesh has; where they are few, a number that may be too large."""
    if form.endswith("stl"):
        return path.stat().st_size / _STL
    content = path.read_bytes()
    if form.endswith("msh"):
        return (
            float(struct.unpack_from("<i", content, 12)[0])
            if len(content) >= 16
            else 0.0
        )
    # Where faces begin; a face of k corners, each after a blank, is k - 2 triangles.
    marks = [place for mark in (b"\nf", b"\rf") if (place := content.find(mark)) >= 0]
    first = min(marks, default=0)
    blanks = content.count(b" ", first) + content.count(b"\t", first)
    at_most = blanks - 2 * (content.count(b"\nf", first) + content.count(b"\rf", first))
    if at_most <= _FEW:
        return at_most
    count = 0
    for line in BytesIO(content.replace(b"\r", b"\n")):
        if line.lstrip(b" \t").startswith(b"f"):
            count += len(line.split()) - 3 if len(line) < _LONG else line.count(b" ")
        if _TRIANGLE * count > 4.0 * MOST_MEMORY:
            break
    return count


def _unpacks_beyond(png: BinaryIO, most: float) -> bool:
    """Return whether the data of a PNG file is longer than so many bytes."""
    unpacker = zlib.decompressobj()
    seen = 0
    png.seek(len(_PNG))
    while seen <= most and len(head := png.read(8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        packed = png.read(length) if kind == b"IDAT" else b""
        png.seek(length - len(packed) + 4, os.SEEK_CUR)
        with contextlib.suppress(zlib.error):  # of which MuJoCo will speak
            while packed and seen <= most:
                seen += len(unpacker.decompress(packed, 1 << 20))
                packed = unpacker.unconsumed_tail
    return seen > most
