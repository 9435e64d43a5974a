"""Encode and decode coloured point clouds as binary PLY files.

The decoder compares the size that the header of a file states with the length of the file before it allocates
an array.

Source:
    Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest

__all__ = ["Colours", "Points", "decode_ply", "encode_ply"]

Points = npt.NDArray[np.float32]
"""Points ``(n, 3)``, x, y and z in metres."""
Colours = npt.NDArray[np.uint8]
"""Colours of points ``(n, 3)``, red, green and blue."""

# Largest length in bytes of the text header of a PLY file; a file with a longer one is refused.
_MAX_HEADER_BYTES = 4096
_DTYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "<i2",
    "ushort": "<u2",
    "int": "<i4",
    "uint": "<u4",
    "float": "<f4",
    "double": "<f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "float32": "<f4",
    "float64": "<f8",
}
"""The numpy dtype of each scalar type of PLY, in its old and its new spelling."""
_POSITION = ("x", "y", "z")  # names of the PLY properties of a point's position
_COLOUR = ("red", "green", "blue")  # names of the PLY properties of a point's colour
_VERTEX = np.dtype([*((name, "<f4") for name in _POSITION), *((name, "u1") for name in _COLOUR)])


def encode_ply(points: npt.ArrayLike, colours: Colours, *, is_metric: bool = True) -> bytes:
    """Return a point cloud as a binary PLY file.

    Args:
        points: ``(n, 3)``, in metres or in an unknown unit; stored as float32.
        colours: ``(n, 3)``, one for each point.
        is_metric: Whether the unit is the metre; a comment in the file states the unit.
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
    """Return the points ``(n, 3)`` and the colours ``(n, 3)`` of a binary PLY file.

    The file must have one element, ``vertex``, with scalar properties only: x, y, z as float or double, and
    red, green, blue as uchar.  Other properties, such as normals, are ignored.

    Raises:
        BadRequest: *data* is not such a file, or its length differs from the stated number of points.
    """
    header, end_mark, _ = data[:_MAX_HEADER_BYTES].partition(b"end_header\n")
    if not end_mark:
        raise _bad_cloud("its header has no end")
    count, vertex = _parse_header(header)
    size = len(data) - len(header) - len(end_mark)
    if size != count * vertex.itemsize:
        raise _bad_cloud(f"{size} bytes are not {count} points of {vertex.itemsize} bytes")
    vertices = np.frombuffer(data, dtype=vertex, offset=len(data) - size)
    points = np.column_stack([vertices[name] for name in _POSITION]).astype(np.float32, copy=False)
    return points, np.column_stack([vertices[name] for name in _COLOUR])


def _parse_header(header: bytes) -> tuple[int, np.dtype[np.void]]:
    """Return the stated number of points, and the dtype of one point.

    Raises:
        BadRequest: The header is not that of a file that `decode_ply` reads.
    """
    lines = [
        line.split()
        for line in header.decode("ascii", "replace").splitlines()
        if not line.startswith(("comment", "obj_info"))
    ]
    if lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]] or len(lines) < 3:
        raise _bad_cloud("it is not a binary, little-endian PLY file of version 1.0")
    count = lines[2][2] if len(lines[2]) == 3 and lines[2][:2] == ["element", "vertex"] else ""
    if not (count.isascii() and count.isdigit() and len(count) <= 12):
        raise _bad_cloud("the first element of its header is not: element vertex COUNT")
    dtypes: dict[str, str] = {}
    for words in lines[3:]:
        if len(words) != 3 or words[0] != "property" or words[1] not in _DTYPES or words[2] in dtypes:
            raise _bad_cloud(
                f"{' '.join(words)[:60]!r} in its header is not a property of a scalar type with a new name"
            )
        dtypes[words[2]] = _DTYPES[words[1]]
    position_dtypes = {dtypes.get(name) for name in _POSITION}
    if not position_dtypes <= {"<f4", "<f8"} or {dtypes.get(name) for name in _COLOUR} != {"u1"}:
        raise _bad_cloud("its points do not have x, y, z as float and red, green, blue as uchar")
    return int(count), np.dtype(list(dtypes.items()))


def _bad_cloud(reason: str) -> BadRequest:
    return BadRequest(
        f"the cloud: {reason}", hint="send what encode_ply returned, or a binary PLY with colours"
    )
