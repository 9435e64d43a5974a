"""Calibration boards: a chessboard or a ChArUco board, to print and to find in images.

The size counts inner corners, as OpenCV does: 9x6 has 10 by 7 squares.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["Board", "find_corners", "write_board"]

_MARKER_SHARE = 0.75
_MODULES = 8
"""Pixels of a square in the smallest exact picture: a ChArUco marker has 6 modules on 0.75 of a square."""
_MM_PER_POINT = 25.4 / 72.0
_PNG_PX_PER_MM = 300 / 25.4
_MARGIN_MM = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A board of *columns* by *rows* inner corners with squares of *square_m*.

    Raises:
        UsageError: The size is not within 3..40 corners, or the squares are not within 1 mm to 1 m.
    """

    columns: int
    rows: int
    square_m: float
    charuco: bool = False

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 40 and 3 <= self.rows <= 40):
            raise UsageError(
                f"a board of {self.columns}x{self.rows} corners is not within 3..40", hint="use 9x6"
            )
        if not 0.001 <= self.square_m <= 1.0:
            raise UsageError(
                f"squares of {1000 * self.square_m:g} mm are not within 1..1000 mm",
                hint="measure one printed square, in millimetres",
            )

    @classmethod
    def parse(cls, size: str, square_mm: float, *, charuco: bool = False) -> Board:
        """Return the board of a word such as ``9x6``; raises UsageError."""
        match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", size)
        if match is None:
            raise UsageError(f"{size} is not the size of a board", hint="count inner corners, such as 9x6")
        return cls(columns=int(match[1]), rows=int(match[2]), square_m=square_mm / 1e3, charuco=charuco)

    @property
    def corners(self) -> int:
        """The number of inner corners."""
        return self.columns * self.rows

    @property
    def points(self) -> npt.NDArray[np.float32]:
        """The ``(corners, 3)`` corners on the board, metres, row after row."""
        grid = np.zeros((self.corners, 3), dtype=np.float32)
        grid[:, :2] = np.mgrid[1 : self.columns + 1, 1 : self.rows + 1].T.reshape(-1, 2)
        grid *= np.float32(self.square_m)
        return grid


def find_corners(gray: npt.NDArray[np.uint8], board: Board) -> tuple[npt.NDArray[np.int64], Array] | None:
    """Return the numbers and ``(n, 2)`` pixels of the corners of *board* in a grey image, or None.

    A chessboard is found whole or not at all; of a ChArUco board any six corners are enough.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    if board.charuco:
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(_charuco(cv2, board)).detectBoard(gray)
        if numbers is None or len(numbers) < 6:
            return None
        return numbers.ravel().astype(np.int64), corners.reshape(-1, 2).astype(np.float64)
    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_FAST_CHECK
    good, corners = cv2.findChessboardCorners(gray, size, flags=flags)
    if not good:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    spacing = np.linalg.norm(np.diff(corners.reshape(board.rows, board.columns, 2), axis=1), axis=2).min()
    half = int(np.clip(spacing / 3, 2, 11))  # the window must not reach the next corner
    refined = cv2.cornerSubPix(gray, corners, (half, half), (-1, -1), criteria)
    return np.arange(board.corners), refined.reshape(-1, 2).astype(np.float64)


def write_board(path: Path, board: Board) -> None:
    """Write a board to print at its true size: a ``.pdf``, or a ``.png`` of 300 dots per inch.

    Raises:
        UsageError: The ending is another one, or the file cannot be written.
        MissingExtra: OpenCV is not installed.
    """
    if path.suffix not in (".pdf", ".png"):
        raise UsageError(
            f"{path} is neither .pdf nor .png", hint="write board.pdf: it prints at its true size"
        )
    picture = _picture(board)
    module_mm = 1e3 * board.square_m / _MODULES
    try:
        if path.suffix == ".pdf":
            path.write_bytes(_pdf(picture, module_mm))
            return
        cv2 = load_opencv()
        size = [round(n * module_mm * _PNG_PX_PER_MM) for n in picture.shape[::-1]]
        good, data = cv2.imencode(".png", cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST))
        assert good
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}", hint="name another file") from error


def _picture(board: Board) -> npt.NDArray[np.uint8]:
    """Return the board with eight pixels for a square, black 0 and white 255."""
    across, down = board.columns + 1, board.rows + 1
    if board.charuco:
        cv2 = load_opencv()
        drawn: npt.NDArray[np.uint8] = _charuco(cv2, board).generateImage(
            (across * _MODULES, down * _MODULES), marginSize=0, borderBits=1
        )
        return np.where(drawn > 127, 255, 0).astype(np.uint8)
    squares = np.indices((down, across)).sum(axis=0) % 2
    return np.kron(squares * 255, np.ones((_MODULES, _MODULES))).astype(np.uint8)


def _charuco(cv2: Any, board: Board) -> Any:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    size = (board.columns + 1, board.rows + 1)
    return cv2.aruco.CharucoBoard(size, board.square_m, _MARKER_SHARE * board.square_m, dictionary)


def _pdf(picture: npt.NDArray[np.uint8], module_mm: float) -> bytes:
    """Return a page on which every black run of a row is a rectangle, so that its size is exact."""
    margin, module = _MARGIN_MM / _MM_PER_POINT, module_mm / _MM_PER_POINT
    height, width = picture.shape
    page = (width * module + 2 * margin, height * module + 2 * margin)
    drawing = []
    for row in range(height):
        black = np.concatenate(([0], (picture[row] == 0).astype(np.int8), [0]))
        starts, ends = np.flatnonzero(np.diff(black) == 1), np.flatnonzero(np.diff(black) == -1)
        y = page[1] - margin - (row + 1) * module
        drawing += [
            f"{margin + start * module:.4f} {y:.4f} {(end - start) * module:.4f} {module:.4f} re"
            for start, end in zip(starts, ends, strict=True)
        ]
    content = ("0 g\n" + "\n".join(drawing) + "\nf\n").encode("ascii")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page[0]:.4f} {page[1]:.4f}] /Contents 4 0 R "
        "/Resources << >> >>".encode("ascii"),
        f"<< /Length {len(content)} >>\nstream\n".encode("ascii") + content + b"endstream",
    ]
    data, places = b"%PDF-1.4\n", []
    for number, pdf_object in enumerate(objects, start=1):
        places.append(len(data))
        data += f"{number} 0 obj\n".encode("ascii") + pdf_object + b"\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    end = f"xref\n0 {len(places) + 1}\n0000000000 65535 f \n{table}trailer\n"
    end += f"<< /Size {len(places) + 1} /Root 1 0 R >>\nstartxref\n{len(data)}\n%%EOF\n"
    return data + end.encode("ascii")
