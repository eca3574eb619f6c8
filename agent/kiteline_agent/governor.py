"""The CPU governor: holds the agent's CPU time under a share of one core, at the least loss of accuracy.

A closed loop on the CPU time that is handed in with each frame. Two things are steered: an effort, one row of LADDER
(how many points, how much stereo, how many keyframes), and, on the last row only, which frames are tracked at all.
Quality follows the expected load, with hysteresis; frames are let through evenly, as many as the budget bears; and
over both stands a sum over the last second that is overdrawn only to keep the vehicle from being lost.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from enum import Enum

from kiteline_agent.config import AgentConfig, GovernorConfig


@dataclass(frozen=True, slots=True)
class Effort:
    """How much work a frame may be. Factors on the configuration's own numbers, except levels."""

    points: float  # of the fine and the coarse pass, and of the inliers that are wanted
    corners: float  # a keyframe's births
    stereo: float  # points whose disparity is measured
    fine_from: int  # template level at which the fine pass begins
    first: int  # finest pyramid level that is made
    keyframes: float  # motion until the next keyframe
    slots: float  # keyframes whose points are looked for
    cost: float  # of a frame relative to the first row: a start, until it was measured


LADDER = (
    Effort(1.00, 1.00, 1.00, 1, 0, 1.0, 1.00, 1.00),
    Effort(0.80, 0.80, 0.80, 1, 0, 1.1, 1.00, 0.90),
    Effort(0.65, 0.65, 0.60, 0, 0, 1.2, 1.00, 0.73),
    Effort(0.80, 0.70, 0.60, 1, 1, 1.2, 1.00, 0.60),
    Effort(0.60, 0.60, 0.50, 1, 1, 1.4, 0.75, 0.51),
    Effort(0.45, 0.45, 0.35, 0, 1, 1.5, 0.50, 0.41),
    Effort(0.35, 0.40, 0.30, 0, 1, 1.6, 0.50, 0.36),
)  # from the best to the cheapest


class Extra(Enum):
    """What makes a frame dear."""

    KEYFRAME = "keyframe"
    SEARCH = "search"  # for a lost place
    SUBMAP = "submap"  # a first keyframe


_LONGER = 1.01  # growth of the expected period a frame, should the camera become slower
_GUESS = 3.0  # usual frames that something dear costs, before it was seen
_OUTLIER = 1.5  # a frame dearer than so many usual ones is no usual frame
_LEAST = 0.2  # of the budget is for frames, whatever keyframes cost


@dataclass(frozen=True, slots=True)
class Decision:
    """What to do with a frame. track: whether it is tracked at all. level: row of LADDER. changed: level is new.
    events: what was decided, in words for the log.
    """

    track: bool
    level: int
    changed: bool
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

    def __init__(self, config: GovernorConfig) -> None:
        self._config = config
        self.level = 0
        self._budget_ns = config.cpu_percent / 100.0 * config.window_s * 1e9  # a window
        self._spent: deque[tuple[int, int]] = deque()  # (t_ns, CPU ns) of the frames of the last window
        self._window_ns = 0
        self._turn = 0.0  # grows by the share of frames that can be tracked; at 1 it is a frame's turn
        self._frame_ns = 0.0  # what a tracked frame without a keyframe costs at this level
        self._extra_ns = dict.fromkeys(Extra, 0.0)  # what each adds to a frame
        self._keyframe_share = config.first_share  # of the tracked frames
        self._period_ns = 0.0  # between frames
        self._first_t_ns = 0
        self._last_t_ns: int | None = None
        self._last_tracked = False
        self._last_extra: Extra | None = None  # of the last frame
        self._calm_since_ns = 0
        self._level_since_ns = 0
        self._skipped = 0  # frames in a row

    @property
    def on(self) -> bool:
        """Whether there is a budget."""
        return self._budget_ns > 0.0

    def frame(self, t_ns: int, last_cpu_ns: int, *, lost: bool = False) -> Decision:
        """Decide about the frame at t_ns. last_cpu_ns: what the frame before cost, whether it was tracked or not.

        lost: there is no track that a skipped frame could endanger.
        """
        if not self.on:
            return Decision(True, 0, False, ())
        self._learn(last_cpu_ns)
        self._advance(t_ns)
        before, pace = self.level, self._pace()
        events: list[str] = []
        self._steer(t_ns)
        track = self._affordable(lost)
        if not track and self.level < len(LADDER) - 1:
            self._set_level(t_ns, self.level + 1)  # quality before frames
            track = self.level < len(LADDER) - 1 or self._affordable(lost)
        track = self._its_turn() and track
        if not track and not lost and self._skipped >= self._config.max_skips:
            track = True  # frames before tracking
            events.append("governor: over budget, or the track would be lost")
        if self.level != before:
            share = 100.0 * pace
            events.insert(0, f"governor: effort {before} -> {self.level}, every frame took {share:.0f} % of the budget")
        if track:
            self._skipped = 0
        else:
            self._skipped += 1
            events.append("governor: frame skipped")
        self._last_t_ns, self._last_tracked, self._last_extra = t_ns, track, None
        return Decision(track, self.level, self.level != before, tuple(events))

    def may(self, extra: Extra) -> bool:
        """Whether there is CPU time for something dear in this frame. Then it is done: the frame is booked under it."""
        if self.on and not self._room_for(extra):
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
        if self._last_t_ns >= self._first_t_ns + self._config.grace_s * 1e9:
            self._spent.append((self._last_t_ns, cpu_ns))
            self._window_ns += cpu_ns
        if not self._last_tracked:
            return
        gain = self._config.learning
        made = float(self._last_extra is Extra.KEYFRAME)
        self._keyframe_share += (made - self._keyframe_share) * self._config.slow_learning
        if self._last_extra is not None:
            known_ns = self._extra_ns[self._last_extra]
            more_ns = max(cpu_ns - self._frame_ns, 0.0)
            self._extra_ns[self._last_extra] += (more_ns - known_ns) * (2.0 * gain if known_ns else 1.0)
        elif self._frame_ns:
            cpu_ns = min(cpu_ns, round(_OUTLIER * self._frame_ns))  # a frame that was lost and found says little
            # Quicker to believe that frames are dear than that they are cheap.
            up = 2.0 * gain if cpu_ns > self._frame_ns else gain
            self._frame_ns += (cpu_ns - self._frame_ns) * min(up, 1.0)
        else:
            self._frame_ns = float(cpu_ns)

    def _advance(self, t_ns: int) -> None:
        """Move the window to a new time."""
        window_ns = round(self._config.window_s * 1e9)
        while self._spent and self._spent[0][0] <= t_ns - window_ns:
            self._window_ns -= self._spent.popleft()[1]
        if self._last_t_ns is None:
            self._first_t_ns = self._level_since_ns = self._calm_since_ns = t_ns
            return
        # Frames that a busy core passed over were not asked about: the shortest period is the camera's.
        passed_ns = float(t_ns - self._last_t_ns)
        self._period_ns = min(passed_ns, _LONGER * self._period_ns) if self._period_ns else passed_ns

    def _affordable(self, lost: bool) -> bool:
        """Whether the last second leaves room for the frame; of a lost one, for the search as well."""
        if not lost:
            cost_ns = self._frame_ns * (1.0 + self._config.doubt)
            return self._window_ns + cost_ns <= self._config.margin * self._budget_ns
        return self._room_for(Extra.SEARCH)

    def _room_for(self, extra: Extra) -> bool:
        """Whether a frame with something dear fits; what never fits is done when little else was."""
        need_ns = self._frame_ns + (self._extra_ns[extra] or _GUESS * self._frame_ns)
        return self._window_ns + need_ns <= self._budget_ns or self._window_ns <= _LEAST * self._budget_ns

    def _its_turn(self) -> bool:
        """On the last row: whether the frame is one of those, evenly spread, that the budget lets through."""
        pace = self._pace()
        # A keyframe may come at any time.
        bearable = self._config.margin - self._extra_ns[Extra.KEYFRAME] / self._budget_ns
        if self.level < len(LADDER) - 1 or pace <= bearable:
            self._turn = 0.0
            return True
        self._turn += max(bearable, _LEAST) / pace
        if self._turn < 1.0:
            return False
        self._turn -= 1.0
        return True

    def _steer(self, t_ns: int) -> None:
        """Hysteresis on the load: down at once, up only after a calm while and one row a time."""
        config = self._config
        load = self._pace()
        settled_ns = t_ns - self._level_since_ns
        if load > config.tight and settled_ns >= config.down_s * 1e9:
            level = self.level
            while level < len(LADDER) - 1 and load > config.tight:
                load *= LADDER[level + 1].cost / LADDER[level].cost
                level += 1
            if level != self.level:
                self._set_level(t_ns, level)
                return
        better = max(self.level - 1, 0)
        if load * LADDER[better].cost / LADDER[self.level].cost > config.comfort or self._skipped:
            self._calm_since_ns = t_ns
        elif self.level > 0 and t_ns - self._calm_since_ns >= config.up_s * 1e9:
            self._set_level(t_ns, better)

    def _pace(self) -> float:
        """Share of the budget that tracking every frame at this effort takes."""
        if not self._period_ns or not self._frame_ns:
            return 0.0
        a_frame_ns = self._frame_ns + self._keyframe_share * self._extra_ns[Extra.KEYFRAME]
        return a_frame_ns * self._config.window_s * 1e9 / self._period_ns / self._budget_ns

    def _set_level(self, t_ns: int, level: int) -> None:
        self._frame_ns *= LADDER[level].cost / LADDER[self.level].cost
        self._extra_ns[Extra.KEYFRAME] *= LADDER[level].corners / LADDER[self.level].corners
        self.level = level
        self._level_since_ns = self._calm_since_ns = t_ns
