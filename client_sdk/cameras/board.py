"""Calibration boards: print a chessboard, and find its corners in images.

The size of a board counts inner corners, as OpenCV does: a board of 9x6 has 10 by 7 squares.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["Board", "find_corners", "write_board"]

_MIN_CORNERS = 3  # a board with fewer inner corners in a row or column is refused: OpenCV needs three
_MAX_CORNERS = 40
"""A board with more inner corners in a row or column is refused: they are too close to each other in an
image."""
_MIN_SQUARE_M = 0.001  # a smaller side of a square is refused: the user has stated metres as millimetres
_MAX_SQUARE_M = 1.0  # a larger side of a square is refused: the stated number is probably not in millimetres
_MM_PER_POINT = 25.4 / 72.0  # millimetres in a point, the unit of PDF
_MARGIN_MM = 10.0  # white margin around the board on a PDF page: printers do not print to the edge


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A calibration board: a chessboard, of which an image must show all inner corners.

    Attributes:
        columns: Number of inner corners in a row.
        rows: Number of inner corners in a column.
        square_m: Side of a square, m.

    Raises:
        UsageError: The size is not within 3..40 corners, or the squares are not within 1 mm to 1 m.
    """

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if not all(_MIN_CORNERS <= count <= _MAX_CORNERS for count in (self.columns, self.rows)):
            raise UsageError(
                f"a board of {self.columns}x{self.rows} corners is not within {_MIN_CORNERS}..{_MAX_CORNERS}",
                hint="use 9x6",
            )
        if not _MIN_SQUARE_M <= self.square_m <= _MAX_SQUARE_M:
            raise UsageError(
                f"squares of {1000 * self.square_m:g} mm are not within 1..1000 mm",
                hint="measure one printed square, in millimetres",
            )

    @classmethod
    def parse(cls, size: str, square_mm: float) -> Board:
        """Return the board with *size* inner corners, a word such as ``9x6``, and squares of *square_mm*.

        Raises:
            UsageError: The word is no size, or `Board` refuses the numbers.
        """
        match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", size)
        if match is None:
            raise UsageError(f"{size} is not the size of a board", hint="count inner corners, such as 9x6")
        return cls(columns=int(match[1]), rows=int(match[2]), square_m=square_mm / 1e3)

    @property
    def corners(self) -> int:
        """The number of inner corners of the board."""
        return self.columns * self.rows

    @property
    def points(self) -> npt.NDArray[np.float32]:
        """The positions ``(corners, 3)`` of the corners on the board, m, row after row, with z = 0."""
        grid = np.zeros((self.corners, 3), dtype=np.float32)
        grid[:, :2] = np.mgrid[1 : self.columns + 1, 1 : self.rows + 1].T.reshape(-1, 2)
        grid *= np.float32(self.square_m)
        return grid


def find_corners(gray: npt.NDArray[np.uint8], board: Board) -> Array | None:
    """Find the corners of *board* in a grey image ``(h, w)``.

    Returns:
        The pixels ``(corners, 2)`` of `Board.points`, column and row, to a fraction of a pixel; None if not
        all corners are found.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_FAST_CHECK
    is_found, corners = cv2.findChessboardCorners(gray, size, flags=flags)
    if not is_found:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    spacing_px = np.linalg.norm(np.diff(corners.reshape(board.rows, board.columns, 2), axis=1), axis=2).min()
    half_window_px = int(np.clip(spacing_px / 3, 2, 11))  # the window must not reach the next corner
    refined = cv2.cornerSubPix(gray, corners, (half_window_px, half_window_px), (-1, -1), criteria)
    pixels: Array = refined.reshape(-1, 2).astype(np.float64)
    return pixels


def write_board(path: Path, board: Board) -> None:
    """Write a PDF page that shows a board in its true size.

    Raises:
        UsageError: The file name does not end in ``.pdf``, or the file cannot be written.
    """
    if path.suffix != ".pdf":
        raise UsageError(f"{path} is no .pdf", hint="write board.pdf: it prints at its true size")
    is_white = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0) % 2
    try:
        path.write_bytes(_pdf_of((255 * is_white).astype(np.uint8), 1e3 * board.square_m))
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}", hint="name another file") from error


def _pdf_of(image: npt.NDArray[np.uint8], pixel_mm: float) -> bytes:
    """Return a PDF page with an image ``(h, w)`` whose pixels have a side of *pixel_mm*.

    Each run of black pixels in a row is drawn as a rectangle, so that the printed size is exact.
    """
    # 1. Draw rectangles, in points from the lower left corner of the page.
    margin, pixel = _MARGIN_MM / _MM_PER_POINT, pixel_mm / _MM_PER_POINT
    height, width = image.shape
    page = (width * pixel + 2 * margin, height * pixel + 2 * margin)
    rectangles = []
    for row in range(height):
        black = np.concatenate(([0], (image[row] == 0).astype(np.int8), [0]))
        starts, ends = np.flatnonzero(np.diff(black) == 1), np.flatnonzero(np.diff(black) == -1)
        y = page[1] - margin - (row + 1) * pixel
        rectangles += [
            f"{margin + start * pixel:.4f} {y:.4f} {(end - start) * pixel:.4f} {pixel:.4f} re"
            for start, end in zip(starts, ends, strict=True)
        ]
    content = ("0 g\n" + "\n".join(rectangles) + "\nf\n").encode("ascii")
    # 2. Make the objects of the file: catalogue, list of pages, page, and its content.
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page[0]:.4f} {page[1]:.4f}] /Contents 4 0 R "
        "/Resources << >> >>".encode("ascii"),
        f"<< /Length {len(content)} >>\nstream\n".encode("ascii") + content + b"endstream",
    ]
    # 3. Join the objects, and append the table of their offsets.
    data, offsets = b"%PDF-1.4\n", []
    for number, pdf_object in enumerate(objects, start=1):
        offsets.append(len(data))
        data += f"{number} 0 obj\n".encode("ascii") + pdf_object + b"\nendobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    end = f"xref\n0 {len(offsets) + 1}\n0000000000 65535 f \n{table}trailer\n"
    end += f"<< /Size {len(offsets) + 1} /Root 1 0 R >>\nstartxref\n{len(data)}\n%%EOF\n"
    return data + end.encode("ascii")
