"""Calibration boards: chessboards, and ChArUco boards, which may be seen in part; drawing and detection."""

import re
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from kiteline_core.arrays import F64, I64, U8
from kiteline_core.errors import KitelineError

FORMS = (
    "charuco:COLUMNSxROWS:SQUARE_M[:MARKER_M[:DICTIONARY]] or chessboard:COLUMNSxROWS:SQUARE_M (squares, not corners)"
)
_MARKER_SHARE = 0.75  # of a marker's side in its square, where it is not told
_DICTIONARY = "DICT_5X5_250"
_FEWEST_CORNERS = 6  # of a view: four fix a pose, the others check it
_MOST_SQUARES = 40


class BoardError(KitelineError):
    """A board that cannot be understood."""


@dataclass(frozen=True, slots=True)
class Corners:
    """Corners of a board in an image. ids: (n,) which; px: (n, 2) where."""

    ids: I64
    px: F64


@dataclass(frozen=True)
class Board:
    """A flat board of squares, counted as printed. marker_m, dictionary: of a ChArUco board; 0 and "" without."""

    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = ""

    @property
    def is_charuco(self) -> bool:
        """True for a ChArUco board."""
        return self.marker_m > 0.0

    @cached_property
    def points_m(self) -> F64:
        """Inner corners (n, 3) by id, in m, z = 0."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square_m * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1).astype(np.float64)

    @cached_property
    def _charuco(self) -> cv2.aruco.CharucoBoard:
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, _markers(self.dictionary)
        )

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._charuco)

    def find(self, image: U8) -> Corners | None:
        """The corners in a grey image, None if there are too few."""
        if self.is_charuco:
            px, ids, _, _ = self._detector.detectBoard(image)
            if ids is None or len(ids) < _FEWEST_CORNERS:
                return None
            found = Corners(np.asarray(ids, np.int64).ravel(), np.asarray(px, np.float64).reshape(-1, 2))
            return found if _spread(self.points_m[found.ids]) else None
        size = (self.columns - 1, self.rows - 1)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        seen, px = cv2.findChessboardCornersSB(image, size, flags=flags)
        if not seen:
            return None
        return Corners(np.arange(len(self.points_m)), np.asarray(px, np.float64).reshape(-1, 2))

    def draw(self, px_a_square: int, margin_squares: float = 0.5) -> U8:
        """An image to print, one square `px_a_square` wide."""
        margin = round(margin_squares * px_a_square)
        size = (self.columns * px_a_square + 2 * margin, self.rows * px_a_square + 2 * margin)
        if self.is_charuco:
            return np.asarray(self._charuco.generateImage(size, marginSize=margin), np.uint8)
        y, x = np.indices((self.rows, self.columns))
        squares = np.where((x + y) % 2 == 0, 0, 255).astype(np.uint8)
        board = np.kron(squares, np.ones((px_a_square, px_a_square), np.uint8))
        return np.asarray(np.pad(board, margin, constant_values=255), np.uint8)


def parse_board(text: str) -> Board:
    """The board of a text such as charuco:9x7:0.03. Raises BoardError."""
    kind, _, rest = text.partition(":")
    parts = rest.split(":") if rest else []
    if kind not in ("charuco", "chessboard") or not 2 <= len(parts) <= (4 if kind == "charuco" else 2):
        raise BoardError(f"board {text!r}: expected {FORMS}")
    count = re.fullmatch(r"(\d+)x(\d+)", parts[0])
    columns, rows = (int(n) for n in count.groups()) if count else (0, 0)
    if not (3 <= columns <= _MOST_SQUARES and 3 <= rows <= _MOST_SQUARES):
        raise BoardError(f"board {text!r}: {parts[0]!r} are no columns and rows of squares: expected 3x3 to 40x40")
    square_m = _metres(parts[1], text)
    if kind == "chessboard":
        return Board(columns, rows, square_m)
    marker_m = _metres(parts[2], text) if len(parts) > 2 else _MARKER_SHARE * square_m
    if marker_m >= square_m:
        raise BoardError(f"board {text!r}: markers of {marker_m:g} m do not fit in squares of {square_m:g} m")
    dictionary = parts[3] if len(parts) > 3 else _DICTIONARY
    markers, needed = len(_markers(dictionary).bytesList), columns * rows // 2
    if needed > markers:
        raise BoardError(f"board {text!r}: {needed} markers are needed, {dictionary} has {markers}")
    return Board(columns, rows, square_m, marker_m, dictionary)


def same_order(left: Corners, right: Corners) -> Corners:
    """The right camera's corners of a chessboard in the order of the left one's: a board turned by 180° looks the same.

    Both cameras are taken to be mounted the same way up.
    """
    if len(left.px) != len(right.px) or (left.px[-1] - left.px[0]) @ (right.px[-1] - right.px[0]) > 0:
        return right
    return Corners(right.ids, right.px[::-1].copy())


def _metres(text: str, board: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1e-3 <= value <= 1.0:
        raise BoardError(f"board {board!r}: a side of {text!r}: expected metres, such as 0.03")
    return value


def _markers(name: str) -> cv2.aruco.Dictionary:
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        raise BoardError(f"dictionary {name!r} is not known: expected one of OpenCV's, such as {_DICTIONARY}")
    return cv2.aruco.getPredefinedDictionary(number)


def _spread(points: F64) -> bool:
    """True if corners do not lie on one line."""
    return bool(np.linalg.matrix_rank(points[:, :2] - points[0, :2], tol=1e-6) == 2)
