"""Coordinate frames against values by hand."""

from math import cos, radians, sin

import numpy as np
import pytest

from kiteline_core.geometry.end_rates import end_rates
from kiteline_hw.mavlink.coordinate_frames import (
    controller_rates,
    local_covariance,
    local_pose,
    mounting,
    upper_triangle,
)

FLU = mounting("flu")


def pose(
    rotation: list[list[float]], position: tuple[float, float, float]
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    t = np.eye(4)
    t[:3, :3] = rotation
    t[:3, 3] = position
    return t


LEVEL = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
YAW_LEFT_90 = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # the nose (body x) points along o's +y
C30, S30 = cos(radians(30)), sin(radians(30))
NOSE_UP_30 = [[C30, 0.0, -S30], [0.0, 1.0, 0.0], [S30, 0.0, C30]]  # the nose has a component along +z
C20, S20 = cos(radians(20)), sin(radians(20))
RIGHT_WING_DOWN_20 = [[1.0, 0.0, 0.0], [0.0, C20, -S20], [0.0, S20, C20]]  # the left wing (body y) rises


@pytest.mark.parametrize(
    ("axes", "rotation", "q"),
    [
        ("flu", LEVEL, [1.0, 0.0, 0.0, 0.0]),
        ("flu", YAW_LEFT_90, [0.70710678, 0.0, 0.0, -0.70710678]),  # yaw is positive to the right in FRD
        ("flu", NOSE_UP_30, [0.96592583, 0.0, 0.25881905, 0.0]),  # pitch is positive nose up
        ("flu", RIGHT_WING_DOWN_20, [0.98480775, 0.17364818, 0.0, 0.0]),  # roll is positive right wing down
        # EuRoC's body (up, right, forward), level; a camera (right, down, forward) that looks along o's +y.
        ("urf", [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], [1.0, 0.0, 0.0, 0.0]),
        ("rdf", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], [0.70710678, 0.0, 0.0, -0.70710678]),
    ],
)
def test_attitude_by_hand(axes: str, rotation: list[list[float]], q: list[float]) -> None:
    position, attitude = local_pose(pose(rotation, (1.0, 2.0, 3.0)), mounting(axes))
    np.testing.assert_allclose(attitude, q, atol=1e-8)
    np.testing.assert_allclose(position, [1.0, -2.0, -3.0])  # 2 m to the left and 3 m up


def test_offset_of_the_flight_controller() -> None:
    """It sits 0.1 m behind and 0.05 m below the body's origin; the vehicle has its nose to the left."""
    t_b_f = mounting("flu", (-0.1, 0.0, -0.05))
    position, _ = local_pose(pose(YAW_LEFT_90, (0.0, 0.0, 1.0)), t_b_f)
    np.testing.assert_allclose(position, [0.0, 0.1, -0.95])  # behind is o's -y, which is to the right


@pytest.mark.parametrize(
    ("rotation", "moved", "velocity"),
    [
        (LEVEL, (0.2, 0.0, 0.0), (2.0, 0.0, 0.0)),  # forward
        (LEVEL, (0.0, 0.2, 0.0), (0.0, -2.0, 0.0)),  # to the left
        (LEVEL, (0.0, 0.0, 0.2), (0.0, 0.0, -2.0)),  # climbing
        (YAW_LEFT_90, (0.0, 0.2, 0.0), (2.0, 0.0, 0.0)),  # forward, the nose along +y
        (YAW_LEFT_90, (0.2, 0.0, 0.0), (0.0, 2.0, 0.0)),  # along +x is to its right
    ],
)
def test_velocity_by_hand(
    rotation: list[list[float]], moved: tuple[float, float, float], velocity: tuple[float, float, float]
) -> None:
    before, now = pose(rotation, (0.0, 0.0, 0.0)), pose(rotation, moved)
    v, w = controller_rates(now, *end_rates((0, 100_000_000), (before, now), 100_000_000), FLU)
    np.testing.assert_allclose(v, velocity, atol=1e-12)
    np.testing.assert_allclose(w, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("rotation", "rate"),
    [
        (YAW_LEFT_90, (0.0, 0.0, -1.57079633)),
        (NOSE_UP_30, (0.0, 0.52359878, 0.0)),
        (RIGHT_WING_DOWN_20, (0.34906585, 0.0, 0.0)),
    ],
)
def test_angular_rate_by_hand(rotation: list[list[float]], rate: tuple[float, float, float]) -> None:
    before, now = pose(LEVEL, (0.0, 0.0, 0.0)), pose(rotation, (0.0, 0.0, 0.0))
    _, w = controller_rates(now, *end_rates((0, 10**9), (before, now), 10**9), FLU)
    np.testing.assert_allclose(w, rate, atol=1e-8)


def test_covariance_of_a_known_matrix() -> None:
    c = np.zeros((6, 6))
    c[0, 0], c[1, 1], c[2, 2], c[3, 3], c[4, 4], c[5, 5] = 1.0, 2.0, 3.0, 4.0, 5.0, 6.0
    c[0, 1] = c[1, 0] = 0.5  # x and y err together: forward with left, so forward with minus right
    c[1, 2] = c[2, 1] = 0.25  # y and z: both turn round
    c[0, 5] = c[5, 0] = 0.125  # x with yaw
    got = upper_triangle(local_covariance(c))
    assert len(got) == 21
    expected = {0: 1.0, 1: -0.5, 5: -0.125, 6: 2.0, 7: 0.25, 11: 3.0, 15: 4.0, 18: 5.0, 20: 6.0}
    np.testing.assert_allclose(got, [expected.get(i, 0.0) for i in range(21)])


@pytest.mark.parametrize("bad", ["", "fl", "flux", "fld", "ffu", "xyz", "fbl"])
def test_invalid_axes(bad: str) -> None:
    with pytest.raises(ValueError, match="body axes"):
        mounting(bad)
