"""When a monocular map in metres begins: the window is solved again until the newest keyframe sees enough landmarks."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.inertial.clocks.frame_clock import FrameClock
from kiteline_agent.inertial.imu_prior import ImuPrior
from kiteline_agent.inertial.preintegration import Samples, TimeOffset
from kiteline_agent.initialisation import inertial_start
from kiteline_agent.initialisation.corner_tracks import CornerObservations, with_found
from kiteline_agent.initialisation.inertial_start import InertialStart
from kiteline_agent.initialisation.metric_restart import MetricPoints
from kiteline_agent.initialisation.window.inertial_terms import CutSamples
from kiteline_agent.initialisation.window.window_state import SolvedWindow, finished
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.waiting_frames import WaitingFrames
from kiteline_core.frame import Frame, ImuBatch
from tests.agent.initialisation.window.test_window_bundle import CALIBRATION, FOCAL, T_B_C, window

CAMERA: Any = SimpleNamespace(fx=FOCAL, fy=FOCAL, cx=376.0, cy=240.0, width=752, height=480, T_b_c=T_B_C)

GLOBAL: Any = SimpleNamespace(rolls=False, is_unknown=False)  # shutter; the gyro's rates are not taken for it
EXACT = ImuPrior(None, TimeOffset(0.0, 1e-6), lambda samples: samples, FrameClock())


class Recorded:
    """The recorded samples between the first n keyframes; `rates` at their stamps are not to be asked for."""

    def __init__(self, cut: CutSamples, n: int) -> None:
        self._cut, self._n = cut, n

    def at(self, offset_s: float) -> list[Samples] | None:
        intervals = self._cut(offset_s)
        return None if intervals is None else intervals[: self._n - 1]

    def missing(self, _offset_s: float) -> None:
        return None


class Tracks:
    """Recorded corners, one keyframe more at each call of `add`."""

    def __init__(self, corners: CornerObservations) -> None:
        self._corners, self.keyframes, self.searched = corners, list[Any](), False

    @property
    def span_s(self) -> float:
        return float(self.keyframes[-1].t_ns - self.keyframes[0].t_ns) * 1e-9

    def is_due(self, _t_ns: int) -> bool:
        return True

    def follow(self, _left: object) -> bool:
        return True

    def add(self, t_ns: int, _left: object, _turn: object) -> bool:
        self.keyframes.append(SimpleNamespace(t_ns=t_ns))
        return True

    def drop_before(self, t_ns: int) -> None:
        pass

    def keep_connected(self, _least_s: float) -> bool:
        return True

    def clear(self) -> None:
        raise AssertionError("samples are missing")

    def flow_px(self) -> float:
        return 100.0

    def observations(self) -> CornerObservations:
        n = len(self.keyframes)
        corners = CornerObservations(self._corners.xy[:n], self._corners.seen[:n], self._corners.ids)
        return corners.part(np.flatnonzero(corners.seen.sum(axis=0) >= 3))


def begins_after(monkeypatch: pytest.MonkeyPatch, poor: int) -> tuple[float, float]:
    """Seconds until the scale is known, and until the map begins, if after that `poor` keyframes see few landmarks."""
    corners, cut, _ = window(1, keyframes=24, noise_px=0.2)
    asked: list[float] = []

    def points(ctx: FrameContext, *_: object) -> MetricPoints:
        asked.append(ctx.t_ns * 1e-9)
        few: Any = SimpleNamespace(sigma_rho=np.ones(5 if len(asked) <= poor else 100))
        return few  # type: ignore[no-any-return]

    monkeypatch.setattr(inertial_start, "window_points", points)
    monkeypatch.setattr(inertial_start, "realigned", lambda _keyframes, observations, *_: observations)
    config = AgentConfig()
    known = replace(
        config.inertial_start.bundle, lens_focal=1e-5, lens_centre_px=1e-2, lens_radial=1e-5, camera_turn_rad=1e-5
    )
    config = replace(config, inertial_start=replace(config.inertial_start, bundle=known))  # the scale is known sooner
    start = InertialStart(CAMERA, CALIBRATION, config, Work(), shutter=GLOBAL)
    start._tracks = Tracks(corners)  # type: ignore[assignment]
    monkeypatch.setattr(inertial_start, "WindowSamples", lambda *args: Recorded(cut, len(args[2])))
    monkeypatch.setattr(start._noise, "measure", lambda *_: None)  # noise as calibrated
    for k in range(24):
        ctx: Any = SimpleNamespace(t_ns=250_000_000 * k, images=SimpleNamespace(left=None))
        if start.add(ctx, EXACT) is not None:
            return asked[0], asked[-1]
    raise AssertionError("the map never begins")


@pytest.mark.parametrize("taken_as_stamped", [True, False])
def test_frames_that_are_taken_as_irregularly_as_they_are_stamped_begin_a_map_by_their_stamps(
    monkeypatch: pytest.MonkeyPatch, taken_as_stamped: bool
) -> None:
    """By the line through the stamps no window fits; and the other way round."""
    uneven_s = 8e-3
    corners, cut, _ = window(1, keyframes=36, noise_px=0.2, uneven_s=uneven_s if taken_as_stamped else 0.0)
    even_ns = 500_000_000 + 250_000_000 * np.arange(36)
    stamps = even_ns + np.round(1e9 * uneven_s * np.random.default_rng(51).normal(size=36)).astype(np.int64)
    clock = FrameClock()
    clock.jitter_s = uneven_s  # as the frames between keyframes have shown it
    clock._taken_ns = dict(zip(stamps.tolist(), even_ns.tolist()))
    monkeypatch.setattr(inertial_start, "window_points", lambda *_: SimpleNamespace(sigma_rho=np.ones(100)))
    monkeypatch.setattr(inertial_start, "realigned", lambda _keyframes, observations, *_: observations)
    start = InertialStart(CAMERA, CALIBRATION, AgentConfig(), Work())
    start._tracks = Tracks(corners)  # type: ignore[assignment]
    start._buffer = cut.__self__._buffer  # type: ignore[attr-defined]
    prior = ImuPrior(None, TimeOffset(0.0, 0.02), lambda samples: samples, clock)
    for stamp_ns in stamps.tolist():
        ctx: Any = SimpleNamespace(t_ns=stamp_ns, images=SimpleNamespace(left=None))
        if start.add(ctx, prior) is not None:
            break
    else:
        raise AssertionError("the map never begins")
    assert clock.refuted is taken_as_stamped


def test_a_map_that_lacks_landmarks_begins_at_one_of_the_next_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    known, begun = begins_after(monkeypatch, 0)
    assert known == begun
    assert begins_after(monkeypatch, 3) == (known, pytest.approx(known + 3 * 0.25))


def test_corners_that_alignment_finds_again_count_where_flow_lost_them() -> None:
    rng = np.random.default_rng(0)
    corners = CornerObservations(rng.normal(size=(4, 6, 2)), rng.random((4, 6)) < 0.5, np.arange(6))
    columns = np.array([0, 2, 5])
    aligned = replace(corners.part(columns), xy=rng.normal(size=(4, 3, 2)), seen=rng.random((4, 3)) < 0.7)
    both = with_found(corners, columns, aligned)
    for k in range(4):
        for i in range(6):
            at = np.flatnonzero(columns == i)
            again = len(at) == 1 and bool(aligned.seen[k, at[0]])
            assert both.seen[k, i] == (corners.seen[k, i] or again)
            if corners.seen[k, i]:
                np.testing.assert_array_equal(both.xy[k, i], corners.xy[k, i])
            elif again:
                np.testing.assert_array_equal(both.xy[k, i], aligned.xy[k, at[0]])


def test_windows_whose_keyframes_coincide_confirm_no_scale() -> None:
    def at(places: np.ndarray[Any, Any]) -> Any:
        solution: Any = SimpleNamespace(state=SimpleNamespace(p=places))
        return SolvedWindow((0, 1, 2, 3), np.zeros(0, np.int64), np.zeros((0, 3)), solution)

    apart, together = np.arange(12.0).reshape(4, 3), np.ones((4, 3))
    assert at(apart).lengths_apart(at(1.1 * apart)) == pytest.approx(np.log(1.1))
    with np.errstate(all="raise"):
        assert at(together).lengths_apart(at(together)) == np.inf
        assert at(together).lengths_apart(at(apart)) == np.inf
        assert at(apart).lengths_apart(at(together)) == np.inf


def at_once(result: Any) -> Any:
    """A computation of one part."""
    return result
    yield


def test_a_lower_cost_at_the_same_scale_confirms_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def solved(scale: float, cost: float) -> inertial_start._Solved:
        state = SimpleNamespace(p=scale * np.arange(12.0).reshape(4, 3))
        solution: Any = SimpleNamespace(state=state, cost=cost, scale_sigma=0.02)
        bundle: Any = None
        return inertial_start._Solved(solution, bundle, np.full((5, 3), scale), np.zeros(5, np.int64))

    def is_lowest(scale: float, cost: float) -> tuple[bool, float]:
        """Whether a solution with cost 1000 stands beside this one from nothing; scale of the next start."""
        found, start = solved(1.0, 1000.0), InertialStart(CAMERA, CALIBRATION, AgentConfig(), Work())
        start._before = SolvedWindow((0, 1, 2, 3), np.zeros(0, np.int64), found.xyz, found.solution)
        monkeypatch.setattr(start, "_solve", lambda *_: at_once(solved(scale, cost)))
        stands = finished(start._is_lowest(found, None, None))  # type: ignore[arg-type]
        return stands, float(start._before.xyz[0, 0])

    assert is_lowest(1.2, 1000.0) == (True, 1.0)
    assert is_lowest(1.2, 990.0) == (False, 1.2)
    assert is_lowest(1.005, 990.0) == (True, 1.0)  # it left out other corners


def test_a_window_begins_after_the_samples_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """An IMU that starts after the camera: keyframes from its first sample on count, not only those of later frames."""
    start = InertialStart(CAMERA, CALIBRATION, AgentConfig(), Work())
    monkeypatch.setattr(start._tracks, "flow_px", lambda: 100.0)
    monkeypatch.setattr(start._tracks, "is_due", lambda _t_ns: True)
    monkeypatch.setattr(start._tracks, "add", lambda *_: True)
    monkeypatch.setattr(start._tracks, "follow", lambda _left: True)
    ids = np.arange(20)
    start._tracks.keyframes = [SimpleNamespace(t_ns=250_000_000 * k, ids=ids) for k in range(20)]  # type: ignore[misc]
    t_ns = np.arange(1_100_000_000, 4_800_000_000, 5_000_000)
    ctx: Any = SimpleNamespace(
        t_ns=4_750_000_000, images=SimpleNamespace(left=None),
        imu=ImuBatch(t_ns, np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, 9.8], (len(t_ns), 1))),
    )  # fmt: skip
    start.add_samples(ctx)
    solved: list[int] = []
    monkeypatch.setattr(start, "_attempting", lambda _ctx, window: iter([solved.append(len(window.keyframes))]))
    start.add(ctx, EXACT)
    assert [k.t_ns for k in start._tracks.keyframes] == [250_000_000 * k for k in range(3, 20)]  # 0.5 s are bridged
    start.add(ctx, EXACT)
    assert solved == [17]


def test_samples_that_miss_in_every_window_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each window would begin after the last gap, and none is ever solved."""
    start = InertialStart(CAMERA, CALIBRATION, AgentConfig(), Work())
    monkeypatch.setattr(start, "_tracks", Tracks(window(1, keyframes=4, noise_px=0.2)[0]))
    gap: Any = SimpleNamespace(missing=lambda _offset_s: 0)
    monkeypatch.setattr(inertial_start, "WindowSamples", lambda *_: gap)
    told = []
    for k in range(100):
        ctx: Any = SimpleNamespace(t_ns=250_000_000 * k, images=SimpleNamespace(left=None))
        assert start.add(ctx, EXACT) is None
        told += [k] * len(start.take_warnings())
    assert told == [50]  # 10 s after the first window, which has 2.5


@pytest.mark.parametrize(("flow_px", "kept"), [(0.2, 17), (8.0, 77)])
def test_of_a_long_rest_a_window_holds_the_end(monkeypatch: pytest.MonkeyPatch, flow_px: float, kept: int) -> None:
    """A window of 20 s is solved every 2 s at most: the scale would be known seconds later than after a short rest."""
    config = AgentConfig()
    tracks = replace(config.inertial_start.corner_tracks, keyframes=100)
    start = InertialStart(
        CAMERA,
        CALIBRATION,
        replace(config, inertial_start=replace(config.inertial_start, corner_tracks=tracks)),
        Work(),
    )
    monkeypatch.setattr(start._tracks, "flow_px", lambda: flow_px)
    monkeypatch.setattr(start._tracks, "is_due", lambda _t_ns: True)
    monkeypatch.setattr(start._tracks, "add", lambda *_: True)
    monkeypatch.setattr(start._tracks, "follow", lambda _left: True)
    monkeypatch.setattr(start, "_attempting", lambda *_: None)
    ids = np.arange(20)
    start._tracks.keyframes = [SimpleNamespace(t_ns=250_000_000 * k, ids=ids) for k in range(77)]  # type: ignore[misc]
    ctx: Any = SimpleNamespace(t_ns=19_000_000_000, images=SimpleNamespace(left=None))
    start.add(ctx, EXACT)
    assert len(start._tracks.keyframes) == kept


SECOND = 1_000_000_000


@pytest.mark.parametrize(("behind_s", "begins"), [(0.0, True), (2.0, True), (1e9, False)])
def test_samples_of_another_clock_are_no_samples(behind_s: float, begins: bool) -> None:
    start = InertialStart(CAMERA, CALIBRATION, AgentConfig(), Work())
    waits = []
    for k in range(100):
        t_ns = 2 * 10**18 + 50_000_000 * k
        stamps = t_ns - round(behind_s * 1e9) - 5_000_000 * np.arange(10, dtype=np.int64)[::-1]
        ctx: Any = SimpleNamespace(t_ns=t_ns, imu=ImuBatch(stamps, np.zeros((10, 3)), np.ones((10, 3))))
        waits.append(start.add_samples(ctx))
    assert all(waits[:60]) and waits[-1] == begins  # without samples a map begins from two views


def test_frames_that_wait_are_some_time_apart_and_lose_no_samples() -> None:
    waiting, taken, samples = WaitingFrames(0.24), list[float](), 0

    def take(found: tuple[Frame, ImuBatch | None]) -> None:
        nonlocal samples
        taken.append(found[0].t_ns / SECOND)
        assert found[1] is not None
        samples += len(found[1].t_ns)

    for k in range(41):
        t_ns = k * SECOND // 20
        imu = ImuBatch(np.array([t_ns - 5_000_000, t_ns]), np.zeros((2, 3)), np.zeros((2, 3)))
        waiting.add(Frame(t_ns, np.zeros((4, 4), np.uint8)), imu)
        if k in (20, 22):
            take(waiting.next())
    assert taken == [0.0, 0.25] and waiting.span_s == pytest.approx(1.5)
    while len(waiting):
        take(waiting.next_to_track())
    assert samples == 2 * 41 and taken[-1] == 2.0  # the newest frame is among them
    assert min(np.diff(taken)) > 0.24 and max(np.diff(taken)) <= 0.5


def test_frames_do_not_wait_for_ever() -> None:
    waiting = WaitingFrames(0.24)
    for k in range(2000):
        t_ns = k * SECOND // 20
        waiting.add(
            Frame(t_ns, np.zeros((4, 4), np.uint8)), ImuBatch(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3)))
        )
        assert len(waiting) <= 64
    frame, imu = waiting.next()
    assert imu is not None and imu.t_ns[0] == 0 and imu.t_ns[-1] == frame.t_ns  # samples of all frames before


def test_biases_of_the_imu_are_as_unknown_as_is_said() -> None:
    config = AgentConfig()
    bundle = replace(config.inertial_start.bundle, gyro_bias_rad_s=0.3, accel_bias_m_s2=0.5)
    config = replace(config, inertial_start=replace(config.inertial_start, bundle=bundle))
    start = InertialStart(CAMERA, CALIBRATION, config, Work())
    assert start._default_prior().sigma.tolist() == [0.3] * 3 + [0.5] * 3
