"""Windows of poses by images, whatever the camera's rate."""

import numpy as np
import pytest

from kiteline_agent.inertial.calibration.pose_chain import PoseChain, SampledMotion
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.frame import ImuBatch


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 100.0, 120.0, 240.0])
@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_windows_are_completed_at_any_rate_of_the_camera(rate_hz: float, late_s: float) -> None:
    buffer, chain, windows = SampleBuffer(3.0, 0.2), PoseChain(0.6), 0
    sampled_ns = 0
    for k in range(round(6.0 * rate_hz)):
        t_ns = round(k / rate_hz * 1e9) + 10**9
        stamps = np.arange(sampled_ns, t_ns - round(late_s * 1e9) + 1, 5_000_000, np.int64)
        if len(stamps):
            sampled_ns = int(stamps[-1]) + 5_000_000
            buffer.push(ImuBatch(stamps, np.zeros((len(stamps), 3)), np.ones((len(stamps), 3))))
        chain.add(t_ns, np.eye(4))
        found = chain.take(buffer, 0.0)
        if isinstance(found, SampledMotion):
            windows += 1
            assert found.samples.duration_s == pytest.approx(0.6, abs=1.0 / rate_hz + 1e-6)
    assert windows >= 7
