"""Models that MuJoCo must not read: at which it would wait for ever, end the process, take hours or
eat the memory. They are refused by their text and by the first bytes of their files.
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

MAX_MEMORY = 4e8
"""Memory that textures, height fields, meshes and blocks of numbers may take in MuJoCo together
[bytes]: 66 million pixels; a plan, which copies the model, takes up to four times as much."""
MAX_COPIES = 3000
"""Copies of an element; MuJoCo takes the square of their number, a minute for 20 000."""
_NUMBER_BYTES = 16.0
"""Memory per number in MuJoCo [bytes]; this and the next four as measured with MuJoCo 4.0."""
_TEXEL_BYTES = 6.0
"""Memory per pixel of a texture: three colours in the compiler and in the model [bytes]."""
_HEIGHT_BYTES = 16.0
"""Memory per cell of a height field: four floats [bytes]."""
_MEMORY_RATIO = 2.0
"""Memory per byte of a file of any other form."""
_TRIANGLE_BYTES = 450.0
"""Memory per triangle of a mesh [bytes]: a quarter of what a plan takes, and three times what the
model keeps."""
_FEW_TRIANGLES = 20_000
"""An OBJ file is read line by line only where it may have more triangles."""
_LONGEST_LINE = 100_000
"""Length up to which a line of an OBJ file is cut into words [bytes]."""
_SIZE_ATTRIBUTES = {"hfield": ("nrow", "ncol"), "numeric": ("size",), "user": ("dim",)}
"""Tag to the attributes whose product is a count of numbers."""
_MULTIPLIERS = ("replicate", "composite", "flexcomp")
_PNG = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Colour type of a PNG file to its numbers per pixel."""
_DEFLATE_RATIO = 1032.0
"""Bytes that come out of one compressed byte at most."""
_STL_BYTES = 50.0
"""Bytes of a triangle in a binary STL file, the only kind that MuJoCo reads."""


def refuse_hazards(
    document: ModelDocument,
    mesh_dir: Path | None = None,
    attaching: tuple[Path, ...] = (),
    memory_of_models: dict[Path, float] | None = None,
) -> float:
    """Return the memory that MuJoCo takes for a model [bytes], or raise ModelError for a hazard.

    Attached models are counted. The last two arguments are for them:

    Args:
        attaching: the models that attach this one, which it may not attach itself.
        memory_of_models: attached model to its memory [bytes]; filled on the way.
    """
    memory_of_models = {} if memory_of_models is None else memory_of_models
    main = document.path.resolve()
    n_attached = Counter[str]()
    needs: list[tuple[float, str]] = []
    for node, copies in _walk_with_copies(document, document.root, 1.0):
        needs.append((_memory_of_node(node), f"<{node.tag}> in line {node.line}"))
        if node.tag == "attach":
            n_attached[node.get("model") or ""] += math.ceil(copies)
    for asset in find_assets(document, mesh_dir):
        _refuse_pipes(document, asset)
        if asset.path is None:
            continue
        path = asset.path.resolve()
        tag = asset.node.tag
        form = (asset.node.get("content_type") or path.suffix).lower()
        memory = _memory_of_file(path, tag, form) if os.access(path, os.R_OK) else 0.0
        if tag == "model" and path.suffix.lower() in SUFFIXES:
            if path in (*attaching, main):
                fault = f"attaches itself by way of {asset.name}; take it out"
                raise ModelError(f"{document.path} {fault}")
            if path not in memory_of_models:
                memory_of_models[path] = refuse_hazards(
                    read_document(path), None, (*attaching, main), memory_of_models
                )
            count = 1 + n_attached[asset.node.get("name") or ""]
            memory = memory_of_models[path] * count
        needs.append((memory, asset.name))
    # Each use of a file is read anew; a URDF's uses of a mesh are one.
    counted = {*needs} if document.is_urdf else needs
    total = math.fsum(memory for memory, _ in counted)
    if total > MAX_MEMORY:
        raise ModelError(
            f"{document.path}: its textures, height fields, meshes and numbers take "
            f"{total / 1e9:.3g} GB when unpacked, more than the {MAX_MEMORY / 1e9:g} GB that are "
            f"read; make them smaller, or take them out (largest: {max(needs)[1]})"
        )
    return total


def _walk_with_copies(
    document: ModelDocument, node: Node, copies: float
) -> Iterator[tuple[Node, float]]:
    """Yield (element, number of its copies) for an element and all below it, or raise ModelError.

    ``copies``: of the element that it stands in.
    """
    # MuJoCo takes the name of a class that it does not know for a format of printf.
    if "%" in (node.get("class") or ""):
        fault = f"the class {node.get('class')!r} of a {node.tag} has a % in its name; rename it"
        raise ModelError(f"{document.path}: {fault}")
    if node.tag in _MULTIPLIERS:
        copies *= max(1.0, _product(node.get("count")))
    if copies > MAX_COPIES:
        fault = f"a {node.tag} makes {copies:.3g} copies; at most {MAX_COPIES} are read"
        raise ModelError(f"{document.path}: {fault}")
    yield node, copies
    for child in node.children():
        yield from _walk_with_copies(document, child, copies)


def _memory_of_node(node: Node) -> float:
    """Return the memory that an element asks for by its numbers [bytes]."""
    if node.tag == "size":
        # Memory that a process reserves for motion is not taken before it is used.
        sizes = [0.1 * _reserved_bytes(node)]
        for name, value in node.attributes.items():
            if name != "memory":
                sizes.append(_NUMBER_BYTES * _product(value))
        return max(sizes)
    if node.tag == "texture":
        width = _product(node.get("width"))
        is_flat = node.get("type") == "2d"
        height = _product(node.get("height")) if is_flat else 6.0 * width
        return _TEXEL_BYTES * width * height
    names = _SIZE_ATTRIBUTES.get(node.tag, ("",))
    return _NUMBER_BYTES * math.prod(_product(node.get(name)) for name in names)


def _reserved_bytes(node: Node) -> float:
    """Return the memory that a <size> reserves: a number with K, M, G, T, P or E behind it."""
    text = (node.get("memory") or "0").strip()
    power = "KMGTPE".find(text[-1:].upper()) + 1
    return _product(text[: -1 if power else None]) * 1024.0**power


def _product(text: str | None) -> float:
    """Return the product of an attribute's numbers; 0 where it has none, of which MuJoCo warns."""
    try:
        return math.prod(map(float, (text or "0").split()))
    except ValueError:
        return 0.0


def _refuse_pipes(document: ModelDocument, asset: Asset) -> None:
    """Raise ModelError where an asset is there, but not as a file."""
    # What was not found is no file, but may be there; too long a name is an error to Path.
    name = Path(asset.name.replace("\\", "/")).name
    for folder in asset.searched if asset.path is None else ():
        path = folder / name
        if os.path.exists(path) and not os.path.isdir(path):
            raise ModelError(
                f"{document.path}: {path} is not a file but a pipe or a device"
            )


def _memory_of_file(path: Path, tag: str, form: str) -> float:
    """Return the memory that a file takes in MuJoCo [bytes].

    Args:
        tag: of the element that refers to the file.
        form: its content type, such as "model/stl", or the end of its name, in lower case.
    """
    size = path.stat().st_size
    if tag == "mesh" and _MEMORY_RATIO * size <= MAX_MEMORY:
        triangles = _count_triangles(path, form)
        return max(_MEMORY_RATIO * size, _TRIANGLE_BYTES * triangles)
    with path.open("rb") as stream:
        head = stream.read(26)
        is_png = head.startswith(_PNG) and len(head) == 26
        if not is_png or tag not in ("texture", "hfield") or size > MAX_MEMORY:
            return size * (_HEIGHT_BYTES / 4.0 if tag == "hfield" else _MEMORY_RATIO)
        width, height, depth, colour_type = struct.unpack(">IIBB", head[16:])
        row = 1.0 + width * _CHANNELS.get(colour_type, 4) * depth / 8.0
        raw = height * row
        pixel_bytes = _TEXEL_BYTES if tag == "texture" else _HEIGHT_BYTES
        memory = max(2.0 * raw, width * height * pixel_bytes)
        # MuJoCo unpacks all that is there, and only then looks how much it should have been.
        largest = _DEFLATE_RATIO * size
        if largest > MAX_MEMORY > memory and _unpacks_beyond(stream, 2.0 * raw + 1e6):
            return largest
        return memory


def _count_triangles(path: Path, form: str) -> float:
    """Return how many triangles a mesh has; where they are few, a number that may be too large."""
    if form.endswith("stl"):
        return path.stat().st_size / _STL_BYTES
    content = path.read_bytes()
    if form.endswith("msh"):
        is_complete = len(content) >= 16
        return float(struct.unpack_from("<i", content, 12)[0]) if is_complete else 0.0
    # Faces begin with f; a face of k corners, each after a blank, is k - 2 triangles.
    starts = [content.find(b"\nf"), content.find(b"\rf")]
    first = min((start for start in starts if start >= 0), default=0)
    blanks = content.count(b" ", first) + content.count(b"\t", first)
    faces = content.count(b"\nf", first) + content.count(b"\rf", first)
    at_most = blanks - 2 * faces
    if at_most <= _FEW_TRIANGLES:
        return at_most
    count = 0
    for line in BytesIO(content.replace(b"\r", b"\n")):
        if line.lstrip(b" \t").startswith(b"f"):
            is_short = len(line) < _LONGEST_LINE
            count += len(line.split()) - 3 if is_short else line.count(b" ")
        if _TRIANGLE_BYTES * count > 4.0 * MAX_MEMORY:
            break
    return count


def _unpacks_beyond(png: BinaryIO, limit: float) -> bool:
    """Return whether the data of a PNG file unpack to more than a limit [bytes]."""
    unpacker = zlib.decompressobj()
    unpacked = 0
    png.seek(len(_PNG))
    while unpacked <= limit and len(head := png.read(8)) == 8:
        length, chunk_type = struct.unpack(">I4s", head)
        packed = png.read(length) if chunk_type == b"IDAT" else b""
        # Behind the data of each chunk stand four bytes of its checksum.
        png.seek(length - len(packed) + 4, os.SEEK_CUR)
        with contextlib.suppress(zlib.error):  # of which MuJoCo warns
            while packed and unpacked <= limit:
                unpacked += len(unpacker.decompress(packed, 1 << 20))
                packed = unpacker.unconsumed_tail
    return unpacked > limit
