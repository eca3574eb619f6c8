"""Velocities brought to the body frame: by hand, and against motion itself."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import UNMEASURED, OdometryBatch
from kiteline_core.geometry import se3

# A body whose axes are a camera's (right, down, forward) above and ahead of a rover's axle (forward, left, up).
R_B_D = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
T_B_D = se3.from_rt(R_B_D, np.array([0.0, 0.2, -0.5]))  # the axle lies 0.2 m below the camera and 0.5 m behind it


def one(
    velocity: list[float], rate: list[float], velocity_sigma: F64 | None = None, rate_sigma: F64 | None = None
) -> OdometryBatch:
    v, w = (np.full(3, 0.1) if s is None else s for s in (velocity_sigma, rate_sigma))
    return OdometryBatch(
        np.array([7], np.int64), np.array([velocity]), np.array([rate]), odometry.variances(v)[None],
        odometry.variances(w)[None],
    )  # fmt: skip


def test_a_rover_that_turns_left_moves_its_camera_to_the_left() -> None:
    # 1 m/s ahead, 0.5 rad/s to the left: half a metre ahead of the axle that is 0.25 m/s sideways.
    told = odometry.in_body(one([1.0, 0.0, 0.0], [0.0, 0.0, 0.5], rate_sigma=np.full(3, 0.01)), T_B_D)
    np.testing.assert_allclose(told.velocity[0], [-0.25, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(told.rate[0], [0.0, -0.5, 0.0], atol=1e-12)


def test_a_rover_that_climbs_moves_its_camera_up_and_back() -> None:
    # Nose up, 0.1 rad/s: about the rover's left axis that is -0.1; the camera ahead rises, the camera above falls back.
    told = odometry.in_body(one([2.0, 0.0, 0.0], [0.0, -0.1, 0.0], rate_sigma=np.full(3, 0.01)), T_B_D)
    np.testing.assert_allclose(told.velocity[0], [0.0, -0.05, 2.0 - 0.02], atol=1e-6)


def test_a_turn_that_is_not_measured_only_makes_the_velocity_doubtful() -> None:
    sigma = np.array([np.inf, np.inf, np.inf])
    told = odometry.in_body(one([1.0, 0.0, 0.0], [9.0, 9.0, 9.0], rate_sigma=sigma), T_B_D)
    np.testing.assert_allclose(told.velocity[0], [0.0, 0.0, 1.0], atol=2e-3)
    assert told.velocity_cov[0, 0, 0] > 0.01 + 0.2 * 0.5**2  # sideways: the lever is half a metre long
    assert told.rate_cov[0].diagonal().min() >= UNMEASURED * 0.99


def test_one_measured_axis_stays_the_only_one() -> None:
    sigma = np.array([0.05, np.inf, np.inf])
    told = odometry.in_body(one([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], sigma), se3.from_rt(R_B_D, np.zeros(3)))
    np.testing.assert_allclose(told.velocity_cov[0].diagonal(), [UNMEASURED, UNMEASURED, 0.0025], rtol=1e-6)


vectors = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


@given(vectors, vectors, vectors)
def test_both_frames_tell_of_one_motion(mount: F64, pose: F64, twist: F64) -> None:
    """The device's own motion over a short time, and the body's, from poses alone."""
    T_b_d, T_w_b, dt = se3.exp(mount), se3.exp(pose), 1e-5
    after = T_w_b @ se3.exp(twist * dt)
    device, device_after = T_w_b @ T_b_d, after @ T_b_d
    v_d = device[:3, :3].T @ (device_after[:3, 3] - device[:3, 3]) / dt
    w_d = se3.so3_log(device[:3, :3].T @ device_after[:3, :3]) / dt
    told = odometry.in_body(one(list(v_d), list(w_d), rate_sigma=np.full(3, 1e-4)), T_b_d)
    np.testing.assert_allclose(told.velocity[0], T_w_b[:3, :3].T @ (after[:3, 3] - T_w_b[:3, 3]) / dt, atol=2e-3)
    np.testing.assert_allclose(told.rate[0], twist[3:], atol=2e-3)


def test_batches_are_joined_and_chosen_from() -> None:
    a, b = one([1.0, 0.0, 0.0], [0.0] * 3), one([2.0, 0.0, 0.0], [0.0] * 3)
    assert odometry.joined([]) is None
    assert odometry.joined([a]) is a
    both = odometry.joined([a, b])
    assert both.velocity[:, 0].tolist() == [1.0, 2.0]
    assert both.rate_cov.shape == (2, 3, 3)
    assert odometry.chosen(both, slice(1, 2)).velocity[0, 0] == 2.0


def test_what_holds_no_numbers_is_told_apart() -> None:
    good, nan = one([1.0, 0.0, 0.0], [0.0] * 3), one([np.nan, 0.0, 0.0], [0.0] * 3)
    negative = OdometryBatch(good.t_ns, good.velocity, good.rate, -good.velocity_cov, good.rate_cov)
    fast, vague = one([1e30, 0.0, 0.0], [0.0] * 3), one([1.0, 0.0, 0.0], [0.0] * 3)
    vague.rate_cov[0, 1, 1] = 1e300
    askew = one([1.0, 0.0, 0.0], [0.0] * 3)
    askew.velocity_cov[0, 0, 1] = 5.0
    infinite = one([1.0, 0.0, 0.0], [0.0, np.inf, 0.0])
    batch = odometry.joined([good, nan, negative, fast, vague, askew, infinite, good])
    assert batch is not None
    assert odometry.usable(batch).tolist() == [True, *[False] * 6, True]
