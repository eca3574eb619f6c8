"""Which keyframes a window of corners keeps."""

from typing import Any

import numpy as np

from kiteline_agent.imaging.features import DetectorConfig
from kiteline_agent.inertial_start_config import CornerTracksConfig
from kiteline_agent.initialisation.corner_tracks import CornerTracks, TrackedKeyframe

SECOND = 1_000_000_000


def kept_s(seconds: float, config: CornerTracksConfig, oldest_s: float = 0.0) -> np.ndarray[Any, Any]:
    """Stamps of the keyframes that are left of one every 0.25 s."""
    camera: Any = None
    tracks = CornerTracks(camera, DetectorConfig(), config)
    for k in range(round(4 * seconds) + 1):
        tracks.keyframes.append(TrackedKeyframe(k * SECOND // 4, (), np.zeros(0, np.int64), np.zeros((0, 2))))
        tracks.drop_before(round(oldest_s * SECOND))
    return np.array([k.t_ns for k in tracks.keyframes]) / SECOND


def test_a_long_window_keeps_every_second_of_its_old_keyframes() -> None:
    config = CornerTracksConfig(keyframes=20)
    np.testing.assert_array_equal(kept_s(4.0, config), np.arange(0.0, 4.01, 0.25))
    long = kept_s(7.0, config)
    assert len(long) == 20 and long[0] == 0.0 and long[-1] == 7.0
    assert np.diff(long).max() == 0.5 and (np.diff(long)[-8:] == 0.25).all()


def test_a_window_that_is_thinned_out_ends_before_its_oldest_keyframes() -> None:
    config = CornerTracksConfig(keyframes=20)
    longest = kept_s(30.0, config)
    assert len(longest) == 20 and longest[-1] == 30.0 and 8.5 < np.ptp(longest) <= 9.5
    assert np.diff(longest).max() == 0.5
    assert kept_s(7.0, config, oldest_s=3.0)[0] == 3.0
