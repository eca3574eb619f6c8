"""Starts a monocular map in metres from corners and IMU, once the scale is known; until then there is no pose."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.inertial.clocks.frame_clock import FrameClock
from kiteline_agent.inertial.imu_prior import ImuPrior
from kiteline_agent.inertial.preintegration import BiasPrior, TimeOffset, preintegrate
from kiteline_agent.inertial.samples.imu_watch import SILENT_S, has_recent
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_agent.initialisation import corner_tracks
from kiteline_agent.initialisation.contradiction import ContradictionWatch, contradicts, exceeds_lens_errors
from kiteline_agent.initialisation.corner_tracks import CornerObservations, CornerTracks, TrackedKeyframe
from kiteline_agent.initialisation.inertial_map import InertialMap
from kiteline_agent.initialisation.landmark_realignment import realigned
from kiteline_agent.initialisation.metric_restart import window_points
from kiteline_agent.initialisation.window.known_length import KnownLength, joint_sigma
from kiteline_agent.initialisation.window.noise_of_windows import NoiseOfWindows
from kiteline_agent.initialisation.window.rolling_rows import RollingRows
from kiteline_agent.initialisation.window.window_bundle import InertialBundle, lens_prior
from kiteline_agent.initialisation.window.window_noise import WindowNoise
from kiteline_agent.initialisation.window.window_readout import WindowReadout
from kiteline_agent.initialisation.window.window_samples import WindowSamples
from kiteline_agent.initialisation.window.window_state import (
    InParts,
    SolvedWindow,
    WarmStart,
    WindowSolution,
    lengths_apart,
)
from kiteline_agent.initialisation.window_odometry import Mean, WindowOdometry
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_agent.tracking.shutter.shutter_stage import ShutterStage
from kiteline_agent.tracking.waiting_frames import WaitingFrames
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry.cameras import RectifiedCamera

Result = TypeVar("Result")

_NEARLY = 1.3  # times the deviation of a known scale: below it the landmarks are aligned again, to know it sooner
_MIN_VIEWS = 3  # keyframes in which a landmark is aligned again, to be kept
_STILL_FLOW = 0.25  # share of `min_flow` below which the vehicle stands
_LOWER_COST = 1.0  # by which a solution from nothing must be better: a deviation of the scale is worth 0.5
_SAME_SCALE = 0.5  # deviations of the scale: solutions that differ by less left out other corners
_BEHIND_SHARE = 0.25  # of the time by which tracking is behind: then fewer windows are solved
_MIN_SPAN_S = 2.4  # s before which a window tells no scale
_MAX_SPAN_S = 24.0  # s; longest window: older keyframes are dropped
_REST_S = 4.0  # s of a rest before the flight that a window holds: enough for the biases
_MAX_GAP_S = 0.5  # s without samples: a longer gap ends a window; in a shorter one images tell what is missing
_ATTEMPT_S = 0.45  # s between two solutions: each costs as much as some frames
_ATTEMPT_SHARE = 0.09  # of the window's length between two solutions: long windows cost more
_LANDMARKS_EACH = 70  # in each keyframe: in fast turns no track is long
_AGREEMENT = 0.04  # relative difference of the scale to that of the solution before, on its keyframes
_STATE_INFLATION = 2.0  # of the deviations of the state with which tracking begins
_STRUCTURE_PX = 1.2  # px; median error of corners with the gyro's rotations: 0.3 if these are right, else 2
_SCALE_SIGMA = 0.02  # relative deviation of the scale below which it is metric
_FLOWS_A_SEARCH = 4  # time of a search for hidden corners over that of following all of them
_LANDMARKS = 220  # of the window, with the longest tracks: errors of few add up to a wrong turn and motion


@dataclass(frozen=True, slots=True)
class _Solved:
    """A solution, what found it, its landmarks (P,3) m and the keyframe (P,) that saw each first."""

    solution: WindowSolution
    bundle: InertialBundle
    xyz: F64
    first: I64


@dataclass(frozen=True, slots=True)
class _Window:
    """Keyframes that are solved for together, samples of the IMU between them, and what is known before.

    prior: of the IMU's biases. offset: of time between camera and IMU. clock: of the frames. rows: of a rolling
    shutter; None: of a global one, or of one of which nothing is known.
    """

    keyframes: tuple[TrackedKeyframe, ...]
    samples: WindowSamples
    prior: BiasPrior
    offset: TimeOffset
    clock: FrameClock
    rows: RollingRows | None

    @property
    def t_ns(self) -> tuple[int, ...]:
        """Stamps of the keyframes."""
        return tuple(k.t_ns for k in self.keyframes)


class InertialStart:
    """Follows corners and solves their window about twice a second. Call `add` with every frame that has no map.

    Where CPU time is short, later frames wait for a solution: the map is the same, and begins later. waiting: these.
    """

    def __init__(
        self, camera: RectifiedCamera, calibration: ImuCalibration, config: AgentConfig, work: Work,
        may_go_on: Callable[[], bool] = lambda: True, odometry: Mean = lambda from_ns, to_ns: None,
        shutter: ShutterStage | None = None,
    ) -> None:  # fmt: skip
        """may_go_on: asked before each part of a solution; False: no CPU time is left for it in this step.

        odometry: means of an odometer's velocities between two stamps. shutter: of the camera; None: a global one.
        """
        self._camera = camera
        self._calibration = calibration
        self._config = config
        self._work = work
        self._may_go_on = may_go_on
        self._shutter = shutter
        self._readout = WindowReadout()
        self._attempt: InParts[InertialMap | None] | None = None  # that has begun
        self._beside_map = False  # it began while a map was tracked
        start = config.inertial_start
        detector = replace(config.detector, cell_px=start.corner_tracks.cell_px, max_corners=corner_tracks.CORNERS)
        self._tracks = CornerTracks(camera, detector, start.corner_tracks)
        self.odometry = WindowOdometry(odometry)
        self.waiting = WaitingFrames(corner_tracks.KEYFRAME_S)
        self._buffer = SampleBuffer(_MAX_SPAN_S + 1.0, _MAX_GAP_S)
        self._before: SolvedWindow | None = None
        self._noise = NoiseOfWindows(calibration, start.bundle)
        self._lens_prior = lens_prior(start.bundle, camera.fx)
        self._lens_info = self._lens_prior  # of what is left of the lens's errors
        self._contradiction = ContradictionWatch(start.contradiction)
        self._warnings: list[str] = []
        self._by_stamps = False  # windows fit by stamps, and not by the camera's rate
        self._structure_px = 0.0  # of the newest solution from nothing
        self._tried_ns: int | None = None
        self._last_samples_ns: int | None = None  # stamp of the last frame with samples

    def add_samples(self, ctx: FrameContext) -> bool:
        """Buffer the IMU samples of a frame. False if none has come for SILENT_S."""
        self._buffer.push(ctx.imu)
        if self._last_samples_ns is None or has_recent(ctx.imu, ctx.t_ns):
            self._last_samples_ns = ctx.t_ns
        return (ctx.t_ns - self._last_samples_ns) * 1e-9 <= SILENT_S

    @property
    def has_samples(self) -> bool:
        """True once a sample of the IMU has come."""
        return self._buffer.newest_t_ns is not None

    def clear(self) -> None:
        """A map is tracked: begin anew after it."""
        self._tracks.clear()
        self.odometry.clear()
        self._attempt = self._before = self._tried_ns = None
        self._noise.clear()
        self._by_stamps = False
        self._readout.clear()
        self._contradiction.begin_again()

    @property
    def keyframe_t_ns(self) -> int | None:
        """Stamp of the newest keyframe of the window; None without one."""
        return self._tracks.keyframes[-1].t_ns if self._tracks.keyframes else None

    @property
    def contradicted(self) -> bool:
        """True if images and IMU certainly contradict each other, so that no scale will be known."""
        return self._contradiction.certain

    def take_warnings(self) -> list[str]:
        """Events since the last call: what the user should check."""
        warnings, self._warnings = self._warnings + self.odometry.take_events(), []
        return warnings

    @property
    def solving(self) -> bool:
        """True if a solution has begun and is not at its end."""
        return self._attempt is not None

    @property
    def idle(self) -> bool:
        """True if there is nothing to do before the next frame comes."""
        first_ns = self.waiting.first_t_ns
        return not self.solving and (first_ns is None or not self._tracks.is_due(first_ns))

    def add(self, ctx: FrameContext, imu: ImuPrior) -> InertialMap | None:
        """Follow the corners into a frame whose samples were taken in. Returns a map once its scale is known."""
        if self._beside_map:  # it would begin a map at an older frame than this one
            self._attempt, self._beside_map = None, False
        self._follow(ctx, imu)
        return self.go_on()

    def add_beside_map(self, ctx: FrameContext, imu: ImuPrior) -> InertialMap | None:
        """The same while a map is tracked, which must not wait: of a solution each frame does one part.

        The map that is returned is of the frame in which its solution began.
        """
        self._follow(ctx, imu)
        self._beside_map = self._attempt is not None
        return self.go_on(1)

    def _follow(self, ctx: FrameContext, imu: ImuPrior) -> None:
        every = self._config.governor.cpu_percent <= 0.0  # else the frames between keyframes do not come here
        self._work.followed += int(every)
        shows = not every or self._tracks.follow(ctx.images.left)
        if shows and self._tracks.is_due(ctx.t_ns):
            added = self._tracks.add(ctx.t_ns, ctx.images.left, lambda since_ns: self._turn(since_ns, ctx.t_ns, imu))
            self._work.followed += 1 + _FLOWS_A_SEARCH * int(self._tracks.searched)
            if added:
                self.odometry.add(ctx.t_ns)
                self._bound_window(ctx.t_ns)
                if self._attempt is None:
                    self._attempt = self._begin(ctx, imu)

    def go_on(self, parts: float = np.inf) -> InertialMap | None:
        """Go on by at most so many parts, as CPU time allows. Returns a map once the solution tells its scale."""
        while self._attempt is not None and parts > 0 and self._may_go_on():
            parts -= 1
            try:
                with np.errstate(all="ignore"):  # see InertialBundle.solving
                    next(self._attempt)
            except StopIteration as end:
                self._attempt = None
                return end.value  # type: ignore[no-any-return]
        return None

    def _turn(self, since_ns: int, t_ns: int, imu: ImuPrior) -> F64 | None:
        """(3,3) rotation of the camera at t_ns in that at since_ns, by the gyro; None without samples."""
        offset = imu.offset if self._before is None else self._before.solution.offset
        begin_ns, end_ns = (self._time_ns(t, imu) + round(offset.offset_s * 1e9) for t in (since_ns, t_ns))
        samples = self._buffer.between(begin_ns, end_ns)
        if samples is None:
            return None
        samples, bias = imu.correct(samples), np.zeros(6) if imu.bias is None else imu.bias.bias
        R_b_c = self._camera.T_b_c[:3, :3]
        return np.asarray(R_b_c.T @ preintegrate(samples, bias, self._calibration).turn @ R_b_c)

    def _time_ns(self, stamp_ns: int, imu: ImuPrior) -> int:
        """When a frame was taken, by its stamp or by the camera's rate."""
        return stamp_ns if self._by_stamps else imu.clock.taken_ns(stamp_ns)

    def _bound_window(self, t_ns: int) -> None:
        """Forget keyframes that the newest window no longer holds."""
        config = self._config.inertial_start
        self._tracks.drop_before(t_ns - round(_MAX_SPAN_S * 1e9))
        if self._tracks.flow_px() < _STILL_FLOW * config.min_flow * self._camera.fx:
            self._tracks.drop_before(t_ns - round(_REST_S * 1e9))

    def _begin(self, ctx: FrameContext, imu: ImuPrior) -> InParts[InertialMap | None] | None:
        """An attempt with the window that ends with this keyframe; None while none is due."""
        config = self._config.inertial_start
        span_s = self._tracks.span_s
        wait_s = max(_ATTEMPT_S, _ATTEMPT_SHARE * span_s, _BEHIND_SHARE * self.waiting.span_s)
        waited = self._tried_ns is None or (ctx.t_ns - self._tried_ns) * 1e-9 >= wait_s
        if span_s < _MIN_SPAN_S or not waited or self._tracks.flow_px() < config.min_flow * self._camera.fx:
            return None
        from_nothing = self._before is None or not self._before.solution.fits
        if from_nothing and not self._tracks.keep_connected(_MIN_SPAN_S):
            self._warnings += self._contradiction.note_wait(ctx.t_ns)
            return None
        keyframes = tuple(self._tracks.keyframes)
        times_ns = [self._time_ns(k.t_ns, imu) for k in keyframes]
        samples = WindowSamples(self._buffer, imu.correct, times_ns, imu.offset.offset_s)
        missing = samples.missing(imu.offset.offset_s)
        if missing is not None:  # the window begins after it
            self._tracks.drop_before(keyframes[missing + 1].t_ns)
            self._warnings += self._contradiction.note_wait(ctx.t_ns)
            return None
        self._tried_ns = ctx.t_ns
        prior = self._default_prior() if imu.bias is None else imu.bias
        rows = None
        if self._shutter is not None and self._shutter.rolls:
            rows = self._rows(samples, imu.offset, self._shutter)
        return self._attempting(ctx, _Window(keyframes, samples, prior, imu.offset, imu.clock, rows))

    def _rows(self, samples: WindowSamples, offset: TimeOffset, shutter: ShutterStage) -> RollingRows:
        """Rows of the shutter in a window. offset: where no window before this one tells it."""
        offset = offset if self._before is None else self._before.solution.offset
        return RollingRows(samples.stamps_s, samples.rates(offset.offset_s), shutter.at_rest)

    def _attempting(self, ctx: FrameContext, window: _Window) -> InParts[InertialMap | None]:
        """Solve the window; align its landmarks again and solve it once more when the scale seems to be known."""
        all_corners = self._tracks.observations()
        if len(all_corners.ids) < self._config.local_map.first_points:
            return None
        columns = corner_tracks.covering(all_corners, _LANDMARKS, _LANDMARKS_EACH)
        observations = all_corners.part(columns)
        before, stamps = self._before, window.t_ns
        self._noise.measure(window.samples.at(window.offset.offset_s) or [], self._buffer.density[0])
        warm = None if before is None else before.warm_start(stamps, observations.ids)
        found = None if warm is None else (yield from self._solve(observations, window, warm))
        if found is None or not found.solution.fits:
            warm, found = None, (yield from self._solve(observations, window, None))
        if found is None:
            self._doubt(window.clock)
            self._before = None
            wrong_turns = self._structure_px > _STRUCTURE_PX
            self._note_contradiction(ctx.t_ns, contradicts=True if wrong_turns else None)
            return None
        if (yield from self._finds_readout(found, observations, window)):
            return None
        solution, modelled = found.solution, self._noise.now
        noise, sigma = self._noise.seen(solution)
        length = self.odometry.length(stamps, solution.state, sigma if solution.fits else np.inf)
        if joint_sigma(sigma, length) < _NEARLY * _SCALE_SIGMA:
            self._work.alignments += int(np.count_nonzero(observations.seen))
            aligned = realigned(
                window.keyframes, observations, solution.state, found.xyz, found.first, self._camera, window.rows
            )
            all_corners = corner_tracks.with_found(all_corners, columns, aligned)
            yield
            keep = aligned.seen.sum(axis=0) >= _MIN_VIEWS
            self._noise.now = noise
            again = self._bundle(aligned.part(keep), window, length)
            warmer = WarmStart(solution.state, found.xyz[keep])
            solution = (yield from self._counted(again.solving(warmer), len(window.keyframes))) or solution
            noise, sigma = self._noise.seen(solution)
        self._before = SolvedWindow(stamps, observations.ids, found.xyz, solution)
        (wrong, by_imu), fits = self._contradicts(solution, noise), solution.converged and solution.fits
        if fits:
            self._contradiction.note_lengths(sigma, _SCALE_SIGMA, self._noise.vibration_m_s2)
        self._note_contradiction(ctx.t_ns, contradicts=wrong if wrong or fits else None, by_imu=by_imu)
        if not fits:
            self._doubt(window.clock)
        known = fits and sigma < _SCALE_SIGMA and not wrong
        agrees = before is not None and before.lengths_apart(self._before) < _AGREEMENT  # later frames confirm it
        self._noise.now = modelled
        if known and agrees and warm is not None:
            if not (yield from self._is_lowest(found, observations, window)):
                return None
        self._noise.now = noise
        if not known or not agrees:
            return None
        bundle = self._bundle(all_corners, window)
        placed = yield from self._counted(bundle.placing_landmarks(solution.state), len(window.keyframes))
        points = None if placed is None else window_points(ctx, all_corners, placed, self._camera)
        if points is None or len(points.sigma_rho) < self._config.local_map.first_points:
            self._tried_ns = None  # the next keyframe may see more of the landmarks
            return None
        if self._by_stamps:
            window.clock.refute()
        cov = _STATE_INFLATION**2 * solution.cov
        duration_s = (stamps[-1] - stamps[0]) * 1e-9
        self._lens_info = np.asarray(np.linalg.inv(solution.lens_cov), np.float64)
        lens = solution.state.lens
        accel_noise = noise.accel * max(self._noise.level_now, 1.0)
        shutters = self._shutters(solution, window.rows)
        if shutters:
            ctx, points = replace(ctx, shutter=shutters[-1]), points.at_frame(shutters[-1], self._camera)
        return InertialMap(
            ctx, points, solution, cov, solution.scale_sigma, duration_s, accel_noise, lens, window.keyframes,
            all_corners, shutters,
        )  # fmt: skip

    def _shutters(self, solution: WindowSolution, rows: RollingRows | None) -> tuple[RollingShutter, ...]:
        """The rolling shutter in each keyframe of a solution; none of a global one."""
        if rows is None:
            return ()
        return tuple(replace(rows.shutter, twist=twist) for twist in rows.twists(solution.state, self._camera.T_b_c))

    def _finds_readout(self, found: _Solved, corners: CornerObservations, window: _Window) -> InParts[bool]:
        """True if this window tells the read-out of a rolling shutter. A map waits until the next one confirms it."""
        if self._shutter is None or not (self._shutter.is_unknown and found.solution.fits):
            return False
        measuring = self._readout.measuring(
            found.bundle, found.solution, lambda rows: self._bundle(corners, replace(window, rows=rows)),
            self._rows(window.samples, window.offset, self._shutter), self._config.inertial_start.bundle.sigma_px,
        )  # fmt: skip
        told = yield from self._counted(measuring, len(corners.seen))
        if told is None:
            return self._readout.waits
        self._warnings += self._shutter.take(*told)
        self._before = self._tried_ns = None
        return True

    def _doubt(self, clock: FrameClock) -> None:
        """Place the frames of the next window otherwise: by the camera's rate, or by their stamps."""
        self._by_stamps = clock.jitter_s > 0.0 and not self._by_stamps

    def _solve(self, corners: CornerObservations, window: _Window, warm: WarmStart | None) -> InParts[_Solved | None]:
        bundle = self._bundle(corners, window)
        solution = yield from self._counted(bundle.solving(warm), len(corners.seen))
        self._structure_px = bundle.structure_px
        return None if solution is None else _Solved(solution, bundle, *bundle.landmarks_of(solution.state))

    def _counted(self, parts: InParts[Result], keyframes: int) -> InParts[Result]:
        """The parts of a solution, each counted as work of the frame in which it is done."""
        while True:
            self._work.window_keyframes += keyframes
            try:
                next(parts)
            except StopIteration as end:
                return end.value  # type: ignore[no-any-return]
            yield

    def _is_lowest(self, found: _Solved, corners: CornerObservations, window: _Window) -> InParts[bool]:
        """True if a solution from nothing has no lower cost, or the same scale.

        A warm start may stay in a wrong minimum. If so, the other solution is the one to start from.
        """
        cold = yield from self._solve(corners, window, None)
        if cold is None or cold.solution.cost > found.solution.cost - _LOWER_COST:
            return True
        apart = lengths_apart(found.solution.state.p, cold.solution.state.p)
        if apart < _SAME_SCALE * found.solution.scale_sigma:
            return True
        assert self._before is not None
        self._before = replace(self._before, xyz=cold.xyz, solution=cold.solution)
        return False

    def _contradicts(self, solution: WindowSolution, noise: WindowNoise) -> tuple[bool, bool]:
        """Whether a window contradicts, and whether it does so by more than its lens."""
        gyro_noise, prior = noise.gyro / self._noise.of_samples.gyro, self._default_prior()
        wrong = contradicts(solution, gyro_noise, prior, self._lens_prior)
        return wrong, wrong and exceeds_lens_errors(solution, gyro_noise, prior)

    def _note_contradiction(self, t_ns: int, *, contradicts: bool | None, by_imu: bool = True) -> None:
        self._warnings += self._contradiction.note(t_ns, contradicts=contradicts, by_imu=by_imu)

    def _bundle(
        self, corners: CornerObservations, window: _Window, length: KnownLength | None = None
    ) -> InertialBundle:
        return InertialBundle(
            corners, window.samples.at, self._calibration, self._camera.T_b_c, self._camera.fx,
            self._config.inertial.gravity_m_s2, window.prior, self._config.inertial_start.bundle,
            self._noise.now, self._lens_info, window.offset, length, window.rows,
        )  # fmt: skip

    def _default_prior(self) -> BiasPrior:
        bundle = self._config.inertial_start.bundle
        return BiasPrior(np.zeros(6), np.repeat([bundle.gyro_bias_rad_s, bundle.accel_bias_m_s2], 3))
