"""Pictures of grids, and their alignment."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_lab.grids.align import aligned
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile, GridFileError, planar
from kiteline_lab.grids.picture import draw_comparison, resampled


def room(cell_m: float = 0.05, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> GridFile:
    """4 by 5 m with two boxes, unlike its mirror images and quarter turns."""
    y, x = (np.indices((80, 100)) + 0.5) * 0.05
    solid = (x < 0.1) | (x > 4.9) | (y < 0.1) | (y > 3.9) | ((x > 1) & (x < 1.6) & (y > 2) & (y < 2.4)) | (x + y < 1.2)
    return GridFile(cell_m, origin, np.where(solid, OCCUPIED, FREE).astype(np.int8))


def share(image: np.ndarray, colour: tuple[int, int, int]) -> float:
    return float((image == colour).all(axis=2).mean())


def test_differences_have_colours_of_their_own(tmp_path: Path) -> None:
    true, est = room(), room()
    draw_comparison(tmp_path / "same.png", est, true, np.eye(3))
    est.state[30:40, 60:70] = OCCUPIED
    est.state[50:60, 60:70] = UNKNOWN
    est.state[40:48, 20:32] = FREE
    draw_comparison(tmp_path / "other.png", est, true, np.eye(3))
    same, other = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("same", "other"))
    legend = same[-26:]
    for colour in ((40, 40, 215), (190, 90, 20), (235, 190, 130)):
        assert share(same[:-26], colour) == 0.0 < share(legend, colour)
        assert share(other[:-26], colour) > 0.001


def test_the_legend_of_a_narrow_picture_is_whole(tmp_path: Path) -> None:
    narrow = room()
    narrow.state[:, 20:] = UNKNOWN
    draw_comparison(tmp_path / "narrow.png", narrow, narrow, np.eye(3))
    picture = cv2.imread(str(tmp_path / "narrow.png"))
    assert (picture[-26:, -8:] == 255).all()  # nothing reaches beyond the edge
    assert share(picture[-26:], (235, 190, 130)) > 0.0  # the last colour is there


def test_an_estimate_is_drawn_where_it_is_said_to_be() -> None:
    true, T = room(), planar(0.5, -0.25, 90.0)
    x, y, _ = np.linalg.inv(T)[:, 2]
    est = room(origin=(x, y, -0.5 * np.pi))
    found = resampled(est, true, T)
    assert (found == true.state).mean() > 0.999
    assert (resampled(room(), true, T) == true.state).mean() < 0.8


@pytest.mark.parametrize("guess", [(0.0, 0.0, 0.0), (0.3, -0.3, 3.0)])
def test_alignment_finds_the_motion(guess: tuple[float, float, float]) -> None:
    true = room()
    wanted = planar(0.33, -0.21, 4.0)
    back = np.linalg.inv(wanted)
    est = room(origin=(back[0, 2], back[1, 2], -np.radians(4.0)))
    est.state[:, 90:] = UNKNOWN  # a wall that was not seen
    T = aligned(est, true, planar(*guess))
    for corner in ((0.0, 0.0), (5.0, 4.0)):
        p = back @ [*corner, 1.0]
        assert np.linalg.norm((T @ p)[:2] - corner) < 0.03


def test_grids_without_obstacles_are_not_aligned() -> None:
    empty = GridFile(0.1, (0.0, 0.0, 0.0), np.zeros((5, 5), np.int8))
    with pytest.raises(GridFileError, match="without obstacles"):
        aligned(empty, room(), np.eye(3))
    unknown = GridFile(0.1, (0.0, 0.0, 0.0), np.full((5, 5), UNKNOWN, np.int8))
    with pytest.raises(GridFileError, match="unknown everywhere"):
        draw_comparison(Path("x.png"), unknown, unknown, np.eye(3))
