"""Parts that stand still in the images of a turning camera are found; nothing is found where nothing tells."""

import cv2
import numpy as np
import pytest

from kiteline_agent.imaging.fixed_parts import CELL_PX, FixedParts, FixedPartsConfig
from kiteline_core.arrays import F64, U8, Bool
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import GRID_STEP, RectifiedCamera

W, H, F, N = 384, 256, 250.0, 60
CAMERA = RectifiedCamera(W, H, F, F, 0.5 * W, 0.5 * H, 0.1, True, np.eye(4))
K = np.array([[F, 0.0, 0.5 * W], [0.0, F, 0.5 * H], [0.0, 0.0, 1.0]])
LEG = (40, 170, 90, 256)  # left, top, right, bottom in px
NOTHING = np.zeros((0, 4))


def scenery(*, stripes: bool = False) -> U8:
    """What is far away: a texture of blobs, or horizontal stripes."""
    rng = np.random.default_rng(3)
    image = np.full((700, 1000), 120, np.uint8)
    for _ in range(20 if stripes else 2500):
        x, y, grey = int(rng.integers(1000)), int(rng.integers(700)), int(rng.integers(20, 235))
        w, h = (1000, int(rng.integers(4, 20))) if stripes else rng.integers(5, 40, 2).tolist()
        cv2.rectangle(image, (0 if stripes else x, y), (x + w, y + h), grey, -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8)


def turned(k: int, *, pitch: float = 0.12) -> F64:
    """T_o_c of frame k: the camera looks around."""
    return se3.from_rt(se3.so3_exp(np.array([pitch * np.sin(0.35 * k), 0.3 * np.sin(0.2 * k), 0.0])), np.zeros(3))


def seen(world: U8, T_o_c: F64) -> U8:
    centre = np.array([[F, 0.0, 500.0], [0.0, F, 350.0], [0.0, 0.0, 1.0]])
    return np.asarray(cv2.warpPerspective(world, K @ T_o_c[:3, :3].T @ np.linalg.inv(centre), (W, H)), np.uint8)


def with_leg(image: U8) -> U8:
    """A leg with a label on it."""
    out, (left, top, right, bottom) = image.copy(), LEG
    cv2.rectangle(out, (left, top), (right, bottom), 25, -1)
    cv2.putText(out, "K7", (left + 4, top + 40), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 240, 3)
    return out


def half(image: U8) -> U8:
    return np.asarray(cv2.pyrDown(image), np.uint8)


def look(parts: FixedParts, k: int, image: U8, T_o_c: F64) -> bool:
    t_ns = k * 200_000_000
    return parts.is_due(t_ns, T_o_c) and parts.look(t_ns, half(image), T_o_c, np.array([2.0, 9.0]))


def cells_of_leg() -> Bool:
    cells = np.zeros((H // CELL_PX, W // CELL_PX), np.bool_)
    cells[LEG[1] // CELL_PX :, LEG[0] // CELL_PX : LEG[2] // CELL_PX + 1] = True
    return cells


def test_a_leg_is_found_while_the_camera_turns_and_given_back_when_it_is_gone() -> None:
    parts, world = FixedParts(CAMERA, FixedPartsConfig(), NOTHING, None), scenery()
    found_at = None
    for k in range(N):
        look(parts, k, with_leg(seen(world, turned(k))), turned(k))
        assert not (parts.cells & ~cells_of_leg()).any()
        found_at = k if found_at is None and parts.cells.any() else found_at
    assert found_at is not None and found_at * 0.2 > 1.0
    assert np.count_nonzero(parts.cells) >= 0.6 * np.count_nonzero(cells_of_leg())
    for k in range(N, 2 * N):
        look(parts, k, seen(world, turned(k)), turned(k))
    assert not parts.cells.any()


def test_what_is_named_is_not_looked_for() -> None:
    named = np.array([[LEG[0] / W, LEG[1] / H, (LEG[2] + 1) / W, 1.0]])
    parts, world = FixedParts(CAMERA, FixedPartsConfig(), named, None), scenery()
    assert not any(look(parts, k, with_leg(seen(world, turned(k))), turned(k)) for k in range(N))


@pytest.mark.parametrize("case", ["surroundings", "hover", "old image", "stripes along the motion", "no turn"])
def test_nothing_is_found_where_nothing_tells(case: str) -> None:
    parts, world = FixedParts(CAMERA, FixedPartsConfig(), NOTHING, None), scenery(stripes=case.startswith("stripes"))
    for k in range(N):
        T_o_c = turned(k, pitch=0.0) if case.startswith("stripes") else turned(k)
        image = seen(world, T_o_c)
        if case == "hover":
            T_o_c = se3.from_rt(se3.so3_exp(np.array([0.0, 0.01 * np.sin(k), 0.0])), np.zeros(3))
            image = with_leg(seen(world, T_o_c))
        elif case == "old image":
            image = seen(world, np.eye(4))
        elif case == "no turn":  # straight ahead: what is far stands still, too
            T_o_c = se3.from_rt(np.eye(3), np.array([0.0, 0.0, 0.5 * k]))
            image = with_leg(seen(world, np.eye(4)))
        assert not look(parts, k, image, T_o_c)
    assert not parts.cells.any()


def test_a_near_scene_that_may_have_stood_still_tells_nothing() -> None:
    """The camera turns to one side and moves to the other: what is at some depth stays where it is."""
    parts, world = FixedParts(CAMERA, FixedPartsConfig(), NOTHING, None), scenery()
    for k in range(N):
        angle, still = 0.2 * np.sin(0.3 * k), seen(world, np.eye(4))
        T_o_c = se3.from_rt(se3.so3_exp(np.array([0.0, angle, 0.0])), np.array([-5.0 * np.tan(angle), 0.0, 0.0]))
        assert not look(parts, k, np.where(np.arange(W) < W // 4, still, seen(world, T_o_c)).astype(np.uint8), T_o_c)
    assert not parts.cells.any()


def test_it_can_be_switched_off() -> None:
    assert not FixedParts(CAMERA, FixedPartsConfig(on=False), NOTHING, None).is_due(0, np.eye(4))


def test_the_edge_where_rectification_leaves_the_raw_image_is_no_part() -> None:
    """A wide lens: left of 40 px there is no raw image, and the rectified one repeats its border."""
    columns, rows = (side // GRID_STEP + 1 for side in (W, H))
    grid = np.stack(np.meshgrid(GRID_STEP * np.arange(columns) - 40.0, GRID_STEP * np.arange(rows) + 0.0), axis=-1)
    world = scenery()
    found = {}
    for name, told in (("with", grid.astype(np.float32)), ("without", None)):
        parts = FixedParts(CAMERA, FixedPartsConfig(), NOTHING, told)
        for k in range(N):
            image = seen(world, turned(k))
            image[:, :40] = np.where(np.arange(H)[:, None] // 16 % 2, 20, 230)
            look(parts, k, image, turned(k))
        found[name] = parts.cells
    assert found["without"][:, 0].any()
    assert not found["with"].any()
