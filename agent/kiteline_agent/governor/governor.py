"""CPU governor: keeps the agent's CPU time below a share of one core, with the least loss of accuracy.

A closed loop on the CPU time of each frame. It controls the effort, one row of a ladder: number of points, share of
stereo, image resolution, keyframe rate, and how many frames are skipped. The rows are ordered by their loss of accuracy
(docs/decisions/governor-ladder.md). The effort follows the expected load with hysteresis; on the last row, frames are
skipped evenly to fit the budget. The sum over the last second exceeds the budget only if no frame was tracked for a
second.
"""

from collections import deque
from dataclasses import dataclass
from enum import Enum

from kiteline_agent.config import GovernorConfig
from kiteline_agent.governor.effort import ALONE, CARRIED, FULL, Effort
from kiteline_agent.governor.start_pacing import StartPacing

_WINDOW_S = 1.0  # s in which the budget has to hold
_MARGIN = 0.97  # share of the budget that is planned; the rest is for what was not expected
_COMFORT = 0.86  # share below which the load at the next better effort must stay before effort rises
_DOWN_S = 0.25  # s between two falls: the expected costs need time to follow the first one
_CARRIED_GAP_S = 1.0  # s between tracked frames with an IMU, whose prediction counts as tracking for as long
_BLIND_S = 1.0  # s without a tracked frame, after which one is tracked whatever it costs
_SETTLING_S = 1.0  # s at the start in which effort follows the load without hysteresis


class Extra(Enum):
    """Extra work that makes a frame expensive."""

    KEYFRAME = "keyframe"
    SEARCH = "search"  # relocalisation
    SUBMAP = "submap"  # the first keyframe of a submap
    PART = "part"  # of what can wait, a column scan or a search for the scale: only what nothing else needs


_LONGER = 1.03  # growth of the expected period per frame, if the camera is slower than assumed
_FIRST_LONGER = 2.5  # the same between the first two frames; a longer gap is due to the first frame's processing
_GUESS = {Extra.KEYFRAME: 1.7, Extra.SEARCH: 3.5, Extra.SUBMAP: 3.0, Extra.PART: 0.5}  # at first, in full frames
_OUTLIER = 1.5  # cost of a frame, in usual frames, above which it is clipped
_SPREAD = 2.0  # mean deviations that cover nine of ten frames
_ALONE = 1.1  # times the expected cost of a keyframe and its frame, which a window must have room for
_LEAST = 0.1  # least share of the budget for frames
_LEARNING, _KEYFRAME_LEARNING = 0.15, 0.4  # gains of the expected cost of frames and rate of keyframes
_FIRST_KEYFRAMES_S, _FIRST_PERIOD_S = 2.0, 0.05  # expected at the start: keyframes a second, s between frames


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision about a frame. track: False to skip it. effort: of the frame. events: for the log."""

    track: bool
    effort: Effort
    events: tuple[str, ...]


class Governor:
    """Decides about each frame and each expensive extra. Without a budget it permits everything."""

    def __init__(self, config: GovernorConfig) -> None:
        self._config = config
        self.level = 0
        self._ladder: tuple[Effort, ...] = ALONE
        self._budget_ns = config.cpu_percent / 100.0 * _WINDOW_S * 1e9  # per window
        self._spent: deque[tuple[int, int]] = deque()  # (t_ns, CPU ns) of the frames of the last window
        self._window_ns = 0
        self._due = 1.0  # accumulates the share of tracked frames; at 1 a frame is due
        self._frame_ns = 0.0  # expected cost of a tracked frame without extras at this level
        self._scatter = 0.0  # mean relative deviation of frames from their expected cost
        self._idle_ns = 0.0  # cost of a skipped frame
        self._extra_ns = dict.fromkeys(Extra, 0.0)  # expected extra cost of each
        self._keyframes_s = _FIRST_KEYFRAMES_S  # requested per second
        self._keyframe_t_ns = 0  # of the last one
        self._asked_t_ns: int | None = None  # of the first pending request
        self._period_ns = _FIRST_PERIOD_S * 1e9  # between frames
        self._first_t_ns = 0
        self._last_t_ns: int | None = None
        self._tracked_t_ns = 0  # of the last tracked frame
        self._last_tracked = False
        self._last_extra: Extra | None = None  # of the last frame
        self._waiting: Extra | None = None  # extra that did not fit in the last tracked frame
        self._waited: Extra | None = None  # the same of the tracked frame before
        self._calm_since_ns = 0
        self._level_since_ns = 0
        self._gap_s = config.max_gap_s  # longest time between two tracked frames
        self._measured = False  # False: the expected cost is the configured one
        self._pacing = StartPacing(self._budget_ns, config.first_frame_ms * 1e6)
        self._starting = False  # the last frame was of the start of a monocular map
        self._grace_ns = config.grace_s * 1e9
        if self.on:  # a map starts with expensive frames: choose an effort that fits
            self._frame_ns = config.first_frame_ms * 1e6
            self._change_row(self._ladder, self._best_affordable(0))

    @property
    def on(self) -> bool:
        """True if there is a budget."""
        return self._budget_ns > 0.0

    @property
    def _row(self) -> Effort:
        return self._ladder[self.level]

    def frame(self, t_ns: int, last_cpu_ns: int, *, lost: bool = False, carried: bool = False) -> Decision:
        """Decide about the frame at t_ns. last_cpu_ns: cost of the frame before, tracked or skipped.

        lost: tracking is lost already. carried: an IMU bridges skipped frames.
        """
        if not self.on:
            return Decision(True, FULL, ())
        self._learn(last_cpu_ns)
        self._starting = False
        self._advance(t_ns)
        before, load = self.level, self._load(self.level)
        events: list[str] = []
        self._gap_s = _CARRIED_GAP_S if carried else self._config.max_gap_s
        self._choose_row(t_ns, CARRIED if carried else ALONE)
        track = (self._is_due(lost=lost) or self._early(t_ns)) and self._affordable(t_ns, lost=lost)
        if not track and not lost and self._gap_exceeds(t_ns, self._gap_s):  # the last reserve, before tracking is lost
            track = self._window_ns + (1.0 + 0.5 * self._safety) * self._frame_ns <= self._budget_ns
            if not track and self._gap_exceeds(t_ns, _BLIND_S):
                track = True
                events.append("governor: over budget, or the track would be lost")
        if self.level != before:
            events.insert(0, f"governor: effort {before} -> {self.level}, the load was {100.0 * load:.0f} % of it")
        if track:
            self._due = max(self._due - 1.0, 0.0)
            self._tracked_t_ns = t_ns
            self._waited, self._waiting = self._waiting, None
        else:
            events.append("governor: frame skipped")
        self._last_t_ns, self._last_tracked, self._last_extra = t_ns, track, None
        return Decision(track, self._row, tuple(events))

    def start_frame(self, t_ns: int, last_cpu_ns: int, *, solving: bool, idle: bool) -> bool:
        """True if there is CPU time, at a frame before a monocular map with an IMU. `frame` decides about all others.

        solving: its solution is under way. idle: there is nothing to do.
        """
        if not self.on:
            return True
        self._learn(last_cpu_ns)
        self._grace_ns = 0.0  # the start is paced from the first frame on
        self._advance(t_ns)
        track = not idle and self._pacing.may_step(self._window_ns, solving=solving)
        self._last_t_ns, self._last_tracked, self._last_extra, self._starting = t_ns, track, None, True
        self._tracked_t_ns = t_ns
        return track

    def may_solve(self) -> bool:
        """True if a further part of the solution with which a monocular map begins fits in this step."""
        return not self._starting or self._pacing.may_solve(self._window_ns)

    def may(self, extra: Extra, *, urgent: bool = False) -> bool:
        """True if there is CPU time for an extra in this frame, which is then booked for the frame.

        urgent: without it tracking may be lost; half of the safety margin is enough.
        """
        if self.on:
            if extra is Extra.KEYFRAME and self._asked_t_ns is None:
                self._asked_t_ns = self._last_t_ns
            if self._waited is Extra.SUBMAP and extra is Extra.SEARCH:  # the time is reserved for the new submap
                return False
            if not self._room_for(extra, 1.0 + (0.5 if urgent else 1.0) * self._safety):
                self._waiting = extra
                return False
        self.note(extra)
        return True

    def may_do_part(self) -> bool:
        """True if a part of what can wait fits in this frame, which does nothing else extra; it is booked then.

        That is what is dropped first: scans also below full effort (`governed`), all without comfort.
        """
        if self.on:
            if self._last_extra is not None:
                return False
            need_ns = self._frame_ns + self._expected_ns(Extra.PART)
            if self._window_ns + need_ns > _COMFORT * self._budget_ns:
                return False
        self.note(Extra.PART)
        return True

    def note(self, extra: Extra) -> None:
        """Book an extra that is done in this frame whether or not there is CPU time."""
        self._last_extra = extra

    def _learn(self, cpu_ns: int) -> None:
        """Book the cost of the last frame, and update the expected costs."""
        if self._last_t_ns is None:
            return
        if not self._early(self._last_t_ns):
            self._spent.append((self._last_t_ns, cpu_ns))
            self._window_ns += cpu_ns
        if not self._last_tracked:
            self._idle_ns += (cpu_ns - self._idle_ns) * (_LEARNING if self._idle_ns else 1.0)
            return
        if self._starting:
            if self._last_extra is None:  # it opened no map
                self._pacing.learn(cpu_ns)
            return
        self._scatter += (self._relative_error(cpu_ns) - self._scatter) * _LEARNING
        if self._last_extra is not None:
            known_ns = self._extra_ns[self._last_extra]
            first = self._last_extra is Extra.SUBMAP and not self._measured  # nothing is tracked in it
            more_ns = max(cpu_ns - (0.0 if first else self._frame_ns), 0.0)
            self._extra_ns[self._last_extra] += (more_ns - known_ns) * (2.0 * _LEARNING if known_ns else 1.0)
            if self._last_extra not in (Extra.SEARCH, Extra.PART):
                self._count_keyframe(self._last_t_ns)
        elif self._measured:
            cpu_ns = min(cpu_ns, round(_OUTLIER * self._frame_ns))  # outliers: a frame that lost and regained tracking
            # Increases are followed faster than decreases.
            up = 2.0 * _LEARNING if cpu_ns > self._frame_ns else _LEARNING
            self._frame_ns += (cpu_ns - self._frame_ns) * min(up, 1.0)
        else:
            self._frame_ns, self._measured = float(cpu_ns), True

    def _advance(self, t_ns: int) -> None:
        """Advance the window to t_ns."""
        window_ns = round(_WINDOW_S * 1e9)
        while self._spent and self._spent[0][0] <= t_ns - window_ns:
            self._window_ns -= self._spent.popleft()[1]
        if self._last_t_ns is None:
            self._first_t_ns = self._level_since_ns = self._calm_since_ns = self._tracked_t_ns = t_ns
            return
        # A busy core drops frames without a decision: the shortest period is the camera's.
        passed_ns = float(t_ns - self._last_t_ns)
        longer = _LONGER if self._last_t_ns > self._first_t_ns else _FIRST_LONGER
        if passed_ns <= longer * self._period_ns:
            self._period_ns = passed_ns
        elif self._last_t_ns > self._first_t_ns:
            self._period_ns *= longer
        if self._asked_t_ns is None:  # no request for a while
            self._keyframes_s = min(self._keyframes_s, 1e9 / max(t_ns - self._keyframe_t_ns, 1))
        self._due += self._share() * passed_ns / self._period_ns

    def _relative_error(self, cpu_ns: int) -> float:
        """Relative deviation of the last frame from its expected cost."""
        known_ns = 0.0 if self._last_extra is None else self._extra_ns[self._last_extra]
        if not self._measured or (self._last_extra is not None and not known_ns):
            return self._scatter
        expected_ns = self._frame_ns + known_ns
        return min(abs(cpu_ns - expected_ns) / max(expected_ns, 1.0), _OUTLIER - 1.0)

    @property
    def _safety(self) -> float:
        """Safety margin: relative excess over the expected cost."""
        return max(self._config.min_cost_error, _SPREAD * self._scatter)

    def _count_keyframe(self, t_ns: int) -> None:
        """Update the rate of keyframe requests after a keyframe."""
        asked_t_ns = t_ns if self._asked_t_ns is None else self._asked_t_ns
        apart_ns = max(asked_t_ns - self._keyframe_t_ns, self._period_ns)
        if self._keyframe_t_ns:
            self._keyframes_s += (1e9 / apart_ns - self._keyframes_s) * _KEYFRAME_LEARNING
        self._keyframe_t_ns, self._asked_t_ns = t_ns, None

    def _affordable(self, t_ns: int, *, lost: bool) -> bool:
        """True if the budget of the last second allows the frame, and if lost, also a relocalisation attempt."""
        if lost:
            return self._room_for(self._waiting or Extra.SEARCH, 1.0 + self._safety)
        if self._waiting is Extra.KEYFRAME and not self._gap_exceeds(t_ns, self._gap_s):
            return self._room_for(Extra.KEYFRAME, 1.0 + self._safety)  # the keyframe has priority over more frames
        cost_ns = self._frame_ns * (1.0 + self._safety)
        return self._window_ns + cost_ns <= _MARGIN * self._budget_ns

    def _gap_exceeds(self, t_ns: int, gap_s: float) -> bool:
        """True at the frame that is next to gap_s after the last tracked one, and at all later ones."""
        return t_ns + 0.5 * self._period_ns - self._tracked_t_ns > gap_s * 1e9

    def _room_for(self, extra: Extra, factor: float) -> bool:
        """True if a frame with an extra fits, at `factor` times the expected cost.

        An extra that never fits is allowed when the window is nearly empty.
        """
        need_ns = self._frame_ns + self._expected_ns(extra)
        if self._last_extra is not None and self._last_extra is not extra:  # also done in this frame
            need_ns += self._expected_ns(self._last_extra)
        if self._window_ns + factor * need_ns <= self._budget_ns:
            return True
        if self._last_extra not in (None, extra):
            return False  # it is done in the next frame, alone
        idle_ns = self._idle_ns * _WINDOW_S * 1e9 / self._period_ns
        little = self._window_ns <= idle_ns + _LEAST * self._budget_ns
        return little and idle_ns + factor * need_ns > self._budget_ns

    def _expected_ns(self, extra: Extra) -> float:
        """Expected extra cost; before the first one of its kind that of the map's first keyframe, or a guess."""
        first_ns = self._extra_ns[Extra.SUBMAP] if extra is Extra.KEYFRAME else 0.0
        return self._extra_ns[extra] or first_ns or _GUESS[extra] * self._frame_ns / self._row.frame_cost

    def _early(self, t_ns: int) -> bool:
        """True at the start of a map: nothing is booked, and the IMU initialisation needs frames."""
        return t_ns < self._first_t_ns + self._grace_ns

    def _is_due(self, *, lost: bool) -> bool:
        """True if the frame is due, with tracked frames spread evenly."""
        self._due = min(self._due, 2.0)
        return lost or self._due >= 1.0 - 1e-6

    def _share(self) -> float:
        """Share of frames to track: as the budget allows, but no more than on the next better row, or its own."""
        most = 1.0 / min(self._every(max(self.level - 1, 0)), self._every(self.level))
        all_frames = self._frames(self.level) * self._every(self.level)
        if all_frames <= 0.0:
            return most
        planned = self._config.carried_fill if self._ladder is CARRIED else self._config.fill
        affordable = planned - self._load(self.level) + self._frames(self.level)
        return min(most, max(affordable, _LEAST) / all_frames)

    def _every(self, level: int) -> float:
        """`every` of a row, limited so that tracking is not lost."""
        most = self._gap_s * 1e9 // self._period_ns
        return max(min(self._ladder[level].every, most), 1.0)

    def _frames(self, level: int) -> float:
        """Share of the budget for the tracked frames of a row, without keyframes."""
        frames = _WINDOW_S * 1e9 / self._period_ns / self._every(level)
        return frames * self._row_frame_ns(level) / self._budget_ns

    def _row_frame_ns(self, level: int) -> float:
        """Expected cost of a tracked frame of a row."""
        return self._frame_ns * self._ladder[level].frame_cost / self._row.frame_cost

    def _load(self, level: int) -> float:
        """Expected load of a row, as a share of the budget: frames, keyframes, skipped frames.

        Where frames may be as far apart as a window, a keyframe waits for one that has room. A row whose keyframes
        have none is overloaded, and so is one with more keyframes than every second window, if no other frame has room
        beside a keyframe. Otherwise any window has to hold a keyframe.
        """
        if not self._frame_ns:
            return 0.0
        row, now = self._ladder[level], self._row
        waits = self._gap_s >= _WINDOW_S
        keyframes = self._keyframes_s * _WINDOW_S * now.keyframes / row.keyframes
        keyframe_ns = self._extra_ns[Extra.KEYFRAME] * row.keyframe_cost / now.keyframe_cost
        idle_ns = self._idle_ns * (1.0 - 1.0 / self._every(level)) * _WINDOW_S * 1e9 / self._period_ns
        load = self._frames(level) + (max(keyframes, 0.0 if waits else 1.0) * keyframe_ns + idle_ns) / self._budget_ns
        frame_ns = self._row_frame_ns(level)
        alone = (idle_ns + _ALONE * (frame_ns + keyframe_ns)) / self._budget_ns
        if waits and alone > 1.0:
            return max(load, alone)
        if waits and alone + frame_ns / self._budget_ns > 1.0:
            return max(load, 2.0 * keyframes)
        return load

    def _choose_row(self, t_ns: int, ladder: tuple[Effort, ...]) -> None:
        """Choose the row with hysteresis: lower effort at once, higher after a calm period and one row at a time."""
        config = self._config
        if ladder is not self._ladder:
            self._change_row(ladder, 0)
            self._set_level(t_ns, self._best_affordable(0))
            return
        if t_ns - self._first_t_ns < _SETTLING_S * 1e9:  # no stable load yet
            self._set_level(t_ns, self._best_affordable(0))
            return
        if self._load(self.level) > 1.0 and t_ns - self._level_since_ns >= _DOWN_S * 1e9:
            level = self._best_affordable(self.level)
            if level != self.level:
                self._set_level(t_ns, level)
                return
        if self.level == 0 or self._load(self.level - 1) > _COMFORT:
            self._calm_since_ns = t_ns
        elif self._waiting is None and t_ns - self._calm_since_ns >= config.up_s * 1e9:
            self._set_level(t_ns, self.level - 1)

    def _best_affordable(self, best: int) -> int:
        """The best row from `best` on that fits the budget, else the last one."""
        rows = range(best, len(self._ladder))
        return next((row for row in rows if self._load(row) <= 1.0), rows[-1])

    def _set_level(self, t_ns: int, level: int) -> None:
        self._change_row(self._ladder, level)
        self._level_since_ns = self._calm_since_ns = t_ns

    def _change_row(self, ladder: tuple[Effort, ...], level: int) -> None:
        """Change the row and scale the expected costs."""
        before = self._row
        self._ladder, self.level = ladder, level
        self._frame_ns *= self._row.frame_cost / before.frame_cost
        self._extra_ns[Extra.KEYFRAME] *= self._row.keyframe_cost / before.keyframe_cost
