"""Point clouds with colours as PLY files: one writer, and one reader that reads all that it writes.

Only bytes are made and read here; nothing is executed, and sizes are compared before an array is made.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest

__all__ = ["Colours", "Points", "decode_ply", "encode_ply"]

Points = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

_MAX_HEADER_BYTES = 4096
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "float": "<f4", "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2",
    "int32": "<i4", "uint32": "<u4", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_POSITION, _COLOUR = ("x", "y", "z"), ("red", "green", "blue")
_VERTEX = np.dtype([*((name, "<f4") for name in _POSITION), *((name, "u1") for name in _COLOUR)])


def encode_ply(points: npt.ArrayLike, colours: Colours, *, is_metric: bool = True) -> bytes:
    """Return ``(n, 3)`` points in metres and ``(n, 3)`` uint8 colours as a binary PLY file.

    *is_metric* says whether the unit is metres, or arbitrary: the file says the same in a comment.
    """
    vertices = np.empty(len(colours), dtype=_VERTEX)
    positions = np.asarray(points, dtype=np.float32)
    for column, name in enumerate(_POSITION):
        vertices[name] = positions[:, column]
    for column, name in enumerate(_COLOUR):
        vertices[name] = colours[:, column]
    unit = "metres" if is_metric else "up to scale: the unit is arbitrary"
    lines = ["ply", "format binary_little_endian 1.0", f"comment {unit}", f"element vertex {len(vertices)}"]
    lines += [f"property float {name}" for name in _POSITION]
    lines += [f"property uchar {name}" for name in _COLOUR]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + vertices.tobytes()


def decode_ply(data: bytes) -> tuple[Points, Colours]:
    """Return the ``(n, 3)`` points and ``(n, 3)`` colours of a binary PLY file.

    The file has one element, ``vertex``, whose properties are numbers; those that are neither a position nor
    a colour are skipped.

    Raises:
        BadRequest: The bytes are not such a file, or are cut short.
    """
    head, mark, _ = data[:_MAX_HEADER_BYTES].partition(b"end_header\n")
    if not mark:
        raise _refused("its header has no end")
    count, vertex = _layout(head)
    size = len(data) - len(head) - len(mark)
    if size != count * vertex.itemsize:
        raise _refused(f"{size} bytes are not {count} points of {vertex.itemsize} bytes")
    vertices = np.frombuffer(data, dtype=vertex, offset=len(data) - size)
    points = np.column_stack([vertices[name] for name in _POSITION]).astype(np.float32, copy=False)
    return points, np.column_stack([vertices[name] for name in _COLOUR])


def _layout(head: bytes) -> tuple[int, np.dtype[np.void]]:
    """Return how many points a header announces, and the numbers of one point; raises BadRequest."""
    lines = [
        line.split() for line in head.decode("ascii", "replace").splitlines()
        if not line.startswith(("comment", "obj_info"))
    ]  # fmt: skip
    if lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]] or len(lines) < 3:
        raise _refused("it is not a binary, little-endian PLY file of version 1.0")
    count = lines[2][2] if len(lines[2]) == 3 and lines[2][:2] == ["element", "vertex"] else ""
    if not (count.isascii() and count.isdigit() and len(count) <= 12):
        raise _refused("its first element is not a number of points")
    properties: dict[str, str] = {}
    for words in lines[3:]:
        if len(words) != 3 or words[0] != "property" or words[1] not in _TYPES or words[2] in properties:
            raise _refused(f"{' '.join(words)[:60]!r} is not a number of a point")
        properties[words[2]] = _TYPES[words[1]]
    positions = {properties.get(name) for name in _POSITION}
    if not positions <= {"<f4", "<f8"} or {properties.get(name) for name in _COLOUR} != {"u1"}:
        raise _refused("its points do not have x, y, z as float and red, green, blue as uchar")
    return int(count), np.dtype(list(properties.items()))


def _refused(why: str) -> BadRequest:
    return BadRequest(f"the cloud: {why}", hint="send what encode_ply returned, or a binary PLY with colours")
