"""The CPU governor: holds the agent's CPU time under a share of one core, at the least loss of accuracy.

A closed loop on the CPU time that is handed in with each frame. What is steered is an effort, one row of a ladder: how
many points, how much stereo, how fine the images, how many keyframes, and every which frame is tracked. The rows stand
in the order of what they cost in accuracy (docs/decisions/governor-ladder.md). Effort follows the expected load, with
hysteresis; on the last row frames are let through evenly, as many as the budget bears; and over all stands a sum over
the last second that is overdrawn only where nothing was tracked for a second.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from enum import Enum

from kiteline_agent.config import AgentConfig, GovernorConfig


@dataclass(frozen=True, slots=True)
class Effort:
    """How much work a frame may be. Factors on the configuration's own numbers, except levels and every."""

    points: float  # of the fine and the coarse pass, and of the inliers that are wanted
    corners: float  # a keyframe's births
    stereo: float  # points whose disparity is measured
    fine_from: int  # template level at which the fine pass begins
    first: int  # finest pyramid level that is made
    keyframes: float  # motion until the next keyframe
    slots: float  # keyframes whose points are looked for
    every: int  # which frame is tracked: 1 all, 2 every other one
    frame_cost: float  # of a tracked frame relative to the first row: a start, until it was measured
    keyframe_cost: float  # the same of what a keyframe adds


FULL = Effort(1.00, 1.00, 1.0, 1, 0, 1.0, 1.0, 1, 1.00, 1.00)
CARRIED = (
    FULL,
    Effort(1.00, 1.00, 1.0, 1, 0, 1.0, 1.0, 2, 1.00, 1.00),
    Effort(1.00, 1.00, 1.0, 1, 0, 1.0, 1.0, 3, 1.00, 1.00),
    Effort(1.00, 1.00, 1.0, 1, 0, 1.4, 1.0, 4, 1.00, 1.00),
    Effort(1.00, 1.00, 1.0, 1, 0, 1.4, 1.0, 6, 1.00, 1.00),
    Effort(1.00, 1.00, 1.0, 1, 0, 1.4, 1.0, 8, 1.00, 1.00),
    Effort(0.50, 0.50, 0.5, 1, 0, 1.4, 0.5, 8, 0.75, 0.90),
    Effort(0.65, 0.65, 0.5, 1, 1, 1.4, 0.5, 8, 0.60, 0.75),
    Effort(0.45, 0.45, 0.3, 0, 1, 1.4, 0.5, 9, 0.52, 0.70),
)  # an IMU carries the pose over skipped frames: they cost next to nothing
ALONE = (
    FULL,
    Effort(1.00, 1.00, 1.0, 1, 0, 1.0, 1.0, 2, 1.00, 1.00),
    Effort(1.00, 1.00, 0.5, 1, 1, 1.2, 1.0, 2, 0.72, 0.82),
    Effort(0.80, 0.80, 0.5, 0, 1, 1.2, 1.0, 2, 0.62, 0.78),
    Effort(0.65, 0.65, 0.5, 0, 1, 1.2, 1.0, 2, 0.58, 0.75),
    Effort(0.65, 0.65, 0.5, 0, 1, 1.2, 1.0, 3, 0.58, 0.75),
    Effort(0.65, 0.65, 0.5, 0, 1, 1.2, 1.0, 4, 0.58, 0.75),
    Effort(0.45, 0.45, 0.3, 0, 1, 1.4, 0.5, 4, 0.52, 0.70),
)  # images alone: a turn between two frames has to be followed, so pixels go before more frames


class Extra(Enum):
    """What makes a frame dear."""

    KEYFRAME = "keyframe"
    SEARCH = "search"  # for a lost place
    SUBMAP = "submap"  # a first keyframe


_LONGER = 1.03  # growth of the expected period a frame, should the camera be slower than thought
_FIRST_LONGER = 2.5  # the same between the first two frames; more, and the core was busy with the first
_GUESS = {Extra.KEYFRAME: 1.7, Extra.SEARCH: 3.0, Extra.SUBMAP: 3.0}  # usual frames that it costs, before it was seen
_OUTLIER = 1.5  # a frame dearer than so many usual ones is no usual frame
_SPREAD = 2.0  # mean deviations within which nine of ten frames lie
_LEAST = 0.1  # of the budget is for frames, whatever keyframes cost


@dataclass(frozen=True, slots=True)
class Decision:
    """What to do with a frame. track: whether it is tracked at all. effort: at which. events: what was decided, in
    words for the log.
    """

    track: bool
    effort: Effort
    events: tuple[str, ...]


def governed(config: AgentConfig, effort: Effort) -> AgentConfig:
    """The configuration at an effort. Fewer points lie in larger cells, and fewer inliers are enough."""
    align, keyframe = config.align, config.keyframe
    points = max(round(align.points * effort.points), 2 * config.pose.min_inliers)
    return replace(
        config,
        pyramid=replace(config.pyramid, first=effort.first),
        align=replace(
            align,
            points=points,
            coarse_points=max(round(align.coarse_points * effort.points), 2 * config.pose.min_inliers),
            cell_px=round(align.cell_px / effort.points**0.5),
            fine_from=min(align.fine_from, effort.fine_from),
        ),
        stereo=replace(config.stereo, points=round(config.stereo.points * effort.stereo)),
        detector=replace(
            config.detector, max_corners=round(config.detector.max_corners * effort.corners), first=effort.first
        ),
        keyframe=replace(
            keyframe,
            min_inliers=max(round(keyframe.min_inliers * effort.points), config.pose.min_inliers + 10),
            min_cover=keyframe.min_cover * (0.5 + 0.5 * effort.points),
            baseline_ratio=keyframe.baseline_ratio * effort.keyframes,
            rotation_rad=keyframe.rotation_rad * min(effort.keyframes, 1.4),
        ),
        local_map=replace(config.local_map, searched=max(round(config.local_map.searched * effort.slots), 8)),
    )


class Governor:
    """Asked once before each frame, and told of each keyframe. Without a budget it never says no."""

    def __init__(self, config: GovernorConfig, *, inertial: bool = False) -> None:
        """inertial: there is an IMU, which will soon carry the pose."""
        self._config = config
        self.level = 0
        self._ladder: tuple[Effort, ...] = CARRIED if inertial else ALONE
        self._budget_ns = config.cpu_percent / 100.0 * config.window_s * 1e9  # a window
        self._spent: deque[tuple[int, int]] = deque()  # (t_ns, CPU ns) of the frames of the last window
        self._window_ns = 0
        self._turn = 1.0  # grows by the share of frames that are tracked; at 1 it is a frame's turn
        self._frame_ns = 0.0  # what a tracked frame without a keyframe costs at this level
        self._scatter = 0.0  # how much, of their cost, frames differ from what was expected, on average
        self._idle_ns = 0.0  # what a frame costs that is not tracked
        self._extra_ns = dict.fromkeys(Extra, 0.0)  # what each adds to a frame
        self._keyframes_s = config.first_keyframes  # that are asked for in a second
        self._keyframe_t_ns = 0  # of the last one
        self._asked_t_ns: int | None = None  # when the next one was first asked for
        self._period_ns = config.first_period_s * 1e9  # between frames
        self._first_t_ns = 0
        self._last_t_ns: int | None = None
        self._tracked_t_ns = 0  # of the last frame that was tracked
        self._last_tracked = False
        self._last_extra: Extra | None = None  # of the last frame
        self._waiting: Extra | None = None  # what there was no room for in the last frame that was tracked
        self._waited: Extra | None = None  # the same of the one before
        self._calm_since_ns = 0
        self._level_since_ns = 0
        self._gap_s = config.max_gap_s  # most that may lie between two tracked frames
        self._measured = False  # until then frames are expected to cost what they do elsewhere
        if self.on:  # a map begins with dear frames: not at an effort that cannot be borne
            self._frame_ns = config.first_frame_ms * 1e6
            self._climb_to(self._ladder, self._bearable(0))
            if self._row.every > 3:  # too few frames for the IMU to start from
                self._climb_to(ALONE, 0)
                self._climb_to(ALONE, self._bearable(0))
        self._first_ladder = self._ladder

    @property
    def on(self) -> bool:
        """Whether there is a budget."""
        return self._budget_ns > 0.0

    @property
    def _row(self) -> Effort:
        return self._ladder[self.level]

    def frame(self, t_ns: int, last_cpu_ns: int, *, lost: bool = False, carried: bool = False) -> Decision:
        """Decide about the frame at t_ns. last_cpu_ns: what the frame before cost, whether it was tracked or not.

        lost: there is no track that a skipped frame could endanger. carried: an IMU bridges skipped frames.
        """
        if not self.on:
            return Decision(True, FULL, ())
        self._learn(last_cpu_ns)
        self._advance(t_ns)
        before, load = self.level, self._load(self.level)
        events: list[str] = []
        self._gap_s = self._config.carried_gap_s if carried else self._config.max_gap_s
        self._steer(t_ns, CARRIED if carried else self._first_ladder if self._early(t_ns) else ALONE)
        track = (self._its_turn(lost) or self._early(t_ns)) and self._affordable(t_ns, lost)
        if not track and not lost and self._blind_for(t_ns, self._gap_s):  # frames before tracking
            track = self._window_ns + (1.0 + 0.5 * self._doubt) * self._frame_ns <= self._budget_ns
            if not track and self._blind_for(t_ns, self._config.blind_s):
                track = True
                events.append("governor: over budget, or the track would be lost")
        if self.level != before:
            events.insert(0, f"governor: effort {before} -> {self.level}, the load was {100.0 * load:.0f} % of it")
        if track:
            self._turn = max(self._turn - 1.0, 0.0)
            self._tracked_t_ns = t_ns
            self._waited, self._waiting = self._waiting, None
        else:
            events.append("governor: frame skipped")
        self._last_t_ns, self._last_tracked, self._last_extra = t_ns, track, None
        return Decision(track, self._row, tuple(events))

    def may(self, extra: Extra, *, urgent: bool = False) -> bool:
        """Whether there is CPU time for something dear in this frame. Then it is done: the frame is booked under it.

        urgent: without it the track may be lost; then half of the doubt is enough.
        """
        if self.on:
            if extra is Extra.KEYFRAME and self._asked_t_ns is None:
                self._asked_t_ns = self._last_t_ns
            if self._waited is Extra.SUBMAP and extra is Extra.SEARCH:  # the room is for the new map
                return False
            if not self._room_for(extra, 1.0 + (0.5 if urgent else 1.0) * self._doubt):
                self._waiting = extra
                return False
        self.note(extra)
        return True

    def note(self, extra: Extra) -> None:
        """Something dear is done in this frame, whether there is CPU time for it or not."""
        self._last_extra = extra

    def _learn(self, cpu_ns: int) -> None:
        """Book what the last frame cost, and sharpen what frames and keyframes are expected to cost."""
        if self._last_t_ns is None:
            return
        if not self._early(self._last_t_ns):
            self._spent.append((self._last_t_ns, cpu_ns))
            self._window_ns += cpu_ns
        gain = self._config.learning
        if not self._last_tracked:
            self._idle_ns += (cpu_ns - self._idle_ns) * (gain if self._idle_ns else 1.0)
            return
        self._scatter += (self._surprise(cpu_ns) - self._scatter) * gain
        if self._last_extra is not None:
            known_ns = self._extra_ns[self._last_extra]
            more_ns = max(cpu_ns - self._frame_ns, 0.0)
            self._extra_ns[self._last_extra] += (more_ns - known_ns) * (2.0 * gain if known_ns else 1.0)
            if self._last_extra is not Extra.SEARCH:
                self._count_keyframe(self._last_t_ns)
        elif self._measured:
            cpu_ns = min(cpu_ns, round(_OUTLIER * self._frame_ns))  # a frame that was lost and found says little
            # Quicker to believe that frames are dear than that they are cheap.
            up = 2.0 * gain if cpu_ns > self._frame_ns else gain
            self._frame_ns += (cpu_ns - self._frame_ns) * min(up, 1.0)
        else:
            self._frame_ns, self._measured = float(cpu_ns), True

    def _advance(self, t_ns: int) -> None:
        """Move the window to a new time."""
        window_ns = round(self._config.window_s * 1e9)
        while self._spent and self._spent[0][0] <= t_ns - window_ns:
            self._window_ns -= self._spent.popleft()[1]
        if self._last_t_ns is None:
            self._first_t_ns = self._level_since_ns = self._calm_since_ns = self._tracked_t_ns = t_ns
            return
        # Frames that a busy core passed over were not asked about: the shortest period is the camera's.
        passed_ns = float(t_ns - self._last_t_ns)
        longer = _LONGER if self._last_t_ns > self._first_t_ns else _FIRST_LONGER
        if passed_ns <= longer * self._period_ns:
            self._period_ns = passed_ns
        elif self._last_t_ns > self._first_t_ns:
            self._period_ns *= longer
        if self._asked_t_ns is None:  # none was needed for so long
            self._keyframes_s = min(self._keyframes_s, 1e9 / max(t_ns - self._keyframe_t_ns, 1))
        self._turn += self._share() * passed_ns / self._period_ns

    def _surprise(self, cpu_ns: int) -> float:
        """By how much the last frame was off, of what it was expected to cost, as far as that was known."""
        known_ns = 0.0 if self._last_extra is None else self._extra_ns[self._last_extra]
        if not self._measured or (self._last_extra is not None and not known_ns):
            return self._scatter
        expected_ns = self._frame_ns + known_ns
        return min(abs(cpu_ns - expected_ns) / max(expected_ns, 1.0), _OUTLIER - 1.0)

    @property
    def _doubt(self) -> float:
        """How much dearer than expected a frame may be."""
        return max(self._config.doubt, _SPREAD * self._scatter)

    def _count_keyframe(self, t_ns: int) -> None:
        """A keyframe was made: how many are asked for, whether there was room for them at once or not."""
        asked_t_ns = t_ns if self._asked_t_ns is None else self._asked_t_ns
        apart_ns = max(asked_t_ns - self._keyframe_t_ns, self._period_ns)
        if self._keyframe_t_ns:
            self._keyframes_s += (1e9 / apart_ns - self._keyframes_s) * self._config.keyframe_learning
        self._keyframe_t_ns, self._asked_t_ns = t_ns, None

    def _affordable(self, t_ns: int, lost: bool) -> bool:
        """Whether the last second leaves room for the frame; of a lost one, for the search as well."""
        if lost:
            return self._room_for(self._waiting or Extra.SEARCH, 1.0 + self._doubt)
        if self._waiting is Extra.KEYFRAME and not self._blind_for(t_ns, self._gap_s):
            return self._room_for(Extra.KEYFRAME, 1.0 + self._doubt)  # it goes before more frames
        cost_ns = self._frame_ns * (1.0 + self._doubt)
        return self._window_ns + cost_ns <= self._config.margin * self._budget_ns

    def _blind_for(self, t_ns: int, gap_s: float) -> bool:
        """Whether the last tracked frame will be longer ago than gap_s if this one is not tracked."""
        return t_ns + self._period_ns - self._tracked_t_ns > gap_s * 1e9

    def _room_for(self, extra: Extra, dearer: float) -> bool:
        """Whether a frame with something dear fits, were it dearer than expected; what never fits is done when little
        else was.
        """
        need_ns = self._frame_ns + (self._extra_ns[extra] or _GUESS[extra] * self._frame_ns)
        if self._last_extra is not None and self._last_extra is not extra:  # done in this very frame
            need_ns += self._extra_ns[self._last_extra] or _GUESS[self._last_extra] * self._frame_ns
        if self._window_ns + dearer * need_ns <= self._budget_ns:
            return True
        if self._last_extra not in (None, extra):
            return False  # it comes next, alone
        idle_ns = self._idle_ns * self._config.window_s * 1e9 / self._period_ns
        little = self._window_ns <= idle_ns + _LEAST * self._budget_ns
        return little and idle_ns + dearer * need_ns > self._budget_ns

    def _early(self, t_ns: int) -> bool:
        """Whether the map has just begun: nothing is booked, and an IMU needs frames to start from."""
        return t_ns < self._first_t_ns + self._config.grace_s * 1e9

    def _its_turn(self, lost: bool) -> bool:
        """Whether the frame is one of those, evenly spread, that are tracked. A turn that cannot be paid for waits."""
        self._turn = min(self._turn, 2.0)
        return lost or self._turn >= 1.0 - 1e-6

    def _share(self) -> float:
        """Of the frames that are tracked: what the budget bears, but no more than on the next better row."""
        most = 1.0 / self._every(max(self.level - 1, 0))
        all_frames = self._frames(self.level) * self._every(self.level)
        if all_frames <= 0.0:
            return most
        bearable = self._config.fill - self._load(self.level) + self._frames(self.level)
        return min(most, max(bearable, _LEAST) / all_frames)

    def _every(self, level: int) -> float:
        """Which frame a row tracks; never so few that the track would be lost."""
        most = self._gap_s * 1e9 // self._period_ns
        return max(min(self._ladder[level].every, most), 1.0)

    def _frames(self, level: int) -> float:
        """Share of the budget that the tracked frames of a row take, without keyframes."""
        row, now = self._ladder[level], self._row
        frame_ns = self._frame_ns * row.frame_cost / now.frame_cost
        return frame_ns / self._every(level) * self._config.window_s * 1e9 / self._period_ns / self._budget_ns

    def _load(self, level: int) -> float:
        """Share of the budget that a row is expected to take: frames, keyframes (one may always come), the rest."""
        if not self._frame_ns:
            return 0.0
        row, now = self._ladder[level], self._row
        keyframes = max(self._keyframes_s * self._config.window_s * now.keyframes / row.keyframes, 1.0)
        keyframe_ns = self._extra_ns[Extra.KEYFRAME] * row.keyframe_cost / now.keyframe_cost
        idle_ns = self._idle_ns * (1.0 - 1.0 / self._every(level)) * self._config.window_s * 1e9 / self._period_ns
        return self._frames(level) + (keyframes * keyframe_ns + idle_ns) / self._budget_ns

    def _steer(self, t_ns: int, ladder: tuple[Effort, ...]) -> None:
        """Hysteresis on the load: down at once, up only after a calm while and one row a time."""
        config = self._config
        if ladder is not self._ladder:
            self._climb_to(ladder, 0)
            self._set_level(t_ns, self._bearable(0))
            return
        if t_ns - self._first_t_ns < config.settling_s * 1e9:  # nothing to hold on to yet
            self._set_level(t_ns, self._bearable(0))
            return
        if self._load(self.level) > config.tight and t_ns - self._level_since_ns >= config.down_s * 1e9:
            level = self._bearable(self.level)
            if level != self.level:
                self._set_level(t_ns, level)
                return
        if self.level == 0 or self._load(self.level - 1) > config.comfort:
            self._calm_since_ns = t_ns
        elif t_ns - self._calm_since_ns >= config.up_s * 1e9:
            self._set_level(t_ns, self.level - 1)

    def _bearable(self, best: int) -> int:
        """The best row from `best` on that the budget bears, else the last one."""
        rows = range(best, len(self._ladder))
        return next((row for row in rows if self._load(row) <= self._config.tight), rows[-1])

    def _set_level(self, t_ns: int, level: int) -> None:
        self._climb_to(self._ladder, level)
        self._level_since_ns = self._calm_since_ns = t_ns

    def _climb_to(self, ladder: tuple[Effort, ...], level: int) -> None:
        """Another row: what was learned is scaled."""
        before = self._row
        self._ladder, self.level = ladder, level
        self._frame_ns *= self._row.frame_cost / before.frame_cost
        self._extra_ns[Extra.KEYFRAME] *= self._row.keyframe_cost / before.keyframe_cost
