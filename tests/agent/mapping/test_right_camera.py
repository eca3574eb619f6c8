"""What is told of the right camera, to the base and to the next flight: of a worn rig, and of a good calibration."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.inertial.calibration.known_imu import known_axes
from kiteline_agent.mapping.right_camera import RightCamera
from kiteline_codec.schema import StereoAlignment
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Rectifier
from kiteline_core.geometry.disparity_offset import GOOD_PX, TERMS
from kiteline_core.ids import AgentId
from tests.agent.disparity_flights import SIDEWAYS, WORN, Flight

SMALL = np.array([-0.15, -0.1, 0.1, -0.15, 0.0])  # as good calibrations have


def flown(offset: F64) -> tuple[Flight, RightCamera, list[StereoAlignment]]:
    """A flight of 80 frames, and the records that it put."""
    flight, channel, camera = Flight(offset, 1, SIDEWAYS), MagicMock(), MagicMock()
    lens = CameraModel(752, 480, 430.0, 430.0, 376.0, 240.0)
    rectifier = Rectifier(CameraRig(lens, lens, np.eye(4), se3.from_rt(np.eye(3), np.array([0.11, 0.0, 0.0]))))
    right = RightCamera(AgentId(0), camera, flight.map, rectifier, AgentConfig(), channel, Work())
    right.disparities = flight.alignment
    for t_ns, T, rows, seen in flight.frames(80):
        track: Any = SimpleNamespace(T_c_m=T, rows=rows, inlier=np.ones(len(rows), np.bool_), observed=seen)
        right.add(t_ns, track)
    right.rows = MagicMock(estimate_px=np.zeros(TERMS), read=False, known=True)
    return flight, right, [call.args[0] for call in channel.put.call_args_list]


def test_a_worn_rig_s_offset_is_told_with_its_deviation_to_base_and_next_flight() -> None:
    flight, right, records = flown(WORN)
    assert np.array_equal(records[-1].disparity_px, flight.map.disparity_offset)
    assert not records[-1].good_calibration and 0.0 < records[-1].sigma_px < 0.2
    known = right.known()
    assert known is not None
    np.testing.assert_allclose(known.disparity_px, flight.map.disparity_offset, atol=6e-4)
    assert known.disparity_sigma_px == pytest.approx(flight.alignment.sigma_px, abs=1e-4)
    np.testing.assert_allclose(right.disparity_cov, flight.alignment.expected_cov + GOOD_PX**2 * np.eye(TERMS))


def test_a_good_calibration_s_offset_is_told_as_such_and_is_of_this_flight_alone() -> None:
    flight, right, records = flown(SMALL)
    assert flight.map.disparity_offset.any()
    assert records[-1].good_calibration and records[-1].sigma_px is None
    known = right.known()
    assert known is not None and known.disparity_px == () and known.disparity_sigma_px == 0.0


def test_deviations_of_axes_are_roots_of_their_variances() -> None:
    sigma = np.linspace(1e-3, 9e-3, 9)
    axes, told = known_axes(np.eye(3), np.diag(sigma**2))
    assert axes == tuple(np.eye(3).ravel().tolist())
    assert told == pytest.approx(sigma)
