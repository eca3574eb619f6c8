"""IMU and odometer tell the scale of one camera's map together, unless they contradict each other."""

import numpy as np
import pytest

from kiteline_agent.motion.joint_scale import JointScale


def test_each_counts_by_its_deviation() -> None:
    joint = JointScale()
    scale, sigma = joint.fused((1.02, 0.02), (0.99, 0.01))
    assert scale == pytest.approx(0.996, abs=1e-3) and sigma == pytest.approx(0.0089, abs=1e-4)
    assert joint.deviation((1.02, 0.02), (0.99, 0.01)) == pytest.approx(np.hypot(sigma / scale, scale - 1.0))


def test_the_scale_of_a_unit_does_not_matter() -> None:
    joint = JointScale()
    small, large = (joint.fused((k * 1.02, k * 0.02), (k * 0.99, k * 0.01)) for k in (0.1, 10.0))
    assert large[0] == pytest.approx(100.0 * small[0]) and large[1] == pytest.approx(100.0 * small[1])


def test_where_they_contradict_each_other_the_imu_stands_and_an_event_says_so() -> None:
    joint, by_imu, off = JointScale(), (1.0, 0.02), (1.1, 0.01)
    (event,) = joint.watch(by_imu, off)
    assert "10 % too long" in event
    assert joint.watch(by_imu, off) == [] and joint.fused(by_imu, off) == by_imu
    assert joint.deviation(by_imu, off) == pytest.approx(0.02)
    assert joint.watch(by_imu, (1.05, 0.01)) == []  # nearer, but not near
    (event,) = joint.watch(by_imu, (1.01, 0.01))
    assert "again" in event and joint.fused(by_imu, (1.01, 0.01)) != by_imu
