"""Says whether a flight controller's estimator uses the poses that it is sent. Pure."""

from dataclasses import dataclass

from kiteline_hw.mavlink.watch.findings import FindingLevel, FindingLog
from kiteline_hw.mavlink.watch.messages import (
    ARDUPILOT,
    NO_AIDING_FLAG,
    POSITION_FLAGS,
    EkfStatusReport,
    FilterStatus,
    StatusText,
)

TOPIC = "poses"
_USED_TEXT, _STOPPED_TEXT = "is using external nav", "stopped aiding"  # of ArduPilot's EKF3
_IGNORED = {
    True: "Check VISO_TYPE 3 and EK3_SRC1_POSXY 6 (then restart the controller): kiteline doctor --mavlink URL does",
    False: "Check EKF2_EV_CTRL 15: kiteline doctor --mavlink URL does",
}


@dataclass(frozen=True, slots=True)
class EstimatorConfig:
    """How long a state lasts before it is said."""

    used_ns: int = 1_000_000_000  # ns with a position while poses are sent
    ignored_ns: int = 6_000_000_000  # ns without one; a filter takes seconds to align itself
    rejected_ns: int = 1_000_000_000  # ns of innovations beyond the filter's limit
    silent_ns: int = 10_000_000_000  # ns without any report
    unheard_ns: int = 3_000_000_000  # ns between two reports, over which no state lasts: they come twice a second
    gap_ns: int = 1_000_000_000  # ns between two poses after which they count as stopped


class EstimatorWatch:
    """Poses and reports of the estimator in, findings out."""

    def __init__(self, log: FindingLog) -> None:
        self.config = EstimatorConfig()
        self._log = log
        self._first_pose_ns: int | None = None
        self._last_pose_ns: int | None = None
        self._report_ns: int | None = None
        self._since: dict[str, int] = {}  # since when good, bad, rejected
        self._position_before = False  # the estimator had a position before poses came

    def restart(self) -> None:
        """The controller began anew."""
        self._first_pose_ns = self._last_pose_ns = self._report_ns = None
        self._position_before = False
        self._since.clear()
        self._log.forget(TOPIC)

    def sent(self, quality: int, now_ns: int) -> None:
        """A pose was sent. Those of failed tracking are ignored rightly, and do not count."""
        if quality <= 0:
            return
        if self._last_pose_ns is None or now_ns - self._last_pose_ns > self.config.gap_ns:
            self._first_pose_ns = now_ns
            self._since.clear()
        self._last_pose_ns = now_ns

    def text(self, m: StatusText) -> None:
        """A text of the controller: ArduPilot's filter says by name what it uses."""
        if _USED_TEXT in m.text:
            self._say_used("and says so")
        elif _STOPPED_TEXT in m.text:
            self._log.say(
                TOPIC, "stopped", FindingLevel.ERROR, "poses: the flight controller's estimator stopped using them",
                "kiteline: EKF stopped using poses",
            )  # fmt: skip

    def report(self, m: FilterStatus, now_ns: int) -> None:
        """A report of the estimator."""
        if self._report_ns is not None and now_ns - self._report_ns > self.config.unheard_ns:
            self._since.clear()
        self._report_ns = now_ns
        has_position = bool(m.flags & POSITION_FLAGS) and not m.flags & NO_AIDING_FLAG
        first, last = self._first_pose_ns, self._last_pose_ns
        if first is None or last is None or now_ns - last > self.config.gap_ns:
            self._position_before = has_position
            self._since.clear()
            return
        rejected = max(m.velocity_ratio, m.position_ratio) >= 1.0
        for state, holds in (("used", has_position and not rejected), ("rejected", rejected)):
            if holds:
                self._since.setdefault(state, now_ns)
            else:
                self._since.pop(state, None)
        if not has_position:
            self._since.setdefault("ignored", now_ns)
        else:
            self._since.pop("ignored", None)
        self._judge(m, now_ns)

    def _judge(self, m: FilterStatus, now_ns: int) -> None:
        c = self.config
        ardupilot = isinstance(m, EkfStatusReport)

        def lasts(state: str, duration_ns: int) -> bool:
            return state in self._since and now_ns - self._since[state] >= duration_ns

        if lasts("rejected", c.rejected_ns):
            self._log.say(
                TOPIC, "rejected", FindingLevel.ERROR,
                f"poses: the estimator rejects them: innovations {max(m.velocity_ratio, m.position_ratio):.1f} times "
                "its limit",
                "kiteline: EKF rejects poses",
                "Wrong axes, delay or scale: see the other lines, and VISO_DELAY_MS or EKF2_EV_DELAY",
            )  # fmt: skip
        elif lasts("ignored", c.ignored_ns):
            self._log.say(
                TOPIC, "ignored", FindingLevel.ERROR,
                "poses: sent, but the flight controller ignores them: its estimator has no position",
                "kiteline: EKF ignores the poses", _IGNORED[ardupilot],
            )  # fmt: skip
        elif lasts("used", c.used_ns) and self._log.state(TOPIC) != "used":
            if self._position_before and self._log.state(TOPIC) is None:
                self._log.say(
                    TOPIC, "unknown", FindingLevel.INFO,
                    "poses: sent; the estimator had a position before them, so whether it uses them is not told",
                    "kiteline: EKF has position without poses",
                    "With GPS or optical flow as well, look at the innovations in the ground station",
                )  # fmt: skip
            elif self._log.state(TOPIC) != "unknown":
                self._say_used("it has a position")

    def _say_used(self, why: str) -> None:
        self._log.say(
            TOPIC, "used", FindingLevel.INFO, f"poses: the flight controller's estimator uses them ({why})",
            "kiteline: EKF uses the poses",
        )  # fmt: skip

    def tick(self, autopilot: int, now_ns: int) -> None:
        """Say that no report comes. autopilot: MAV_AUTOPILOT."""
        first = self._first_pose_ns
        if first is None or self._report_ns is not None or now_ns - first < self.config.silent_ns:
            return
        name = "EKF_STATUS_REPORT" if autopilot == ARDUPILOT else "ESTIMATOR_STATUS"
        self._log.say(
            TOPIC, "silent", FindingLevel.WARNING,
            f"poses: sent; whether they are used is not told, as no {name} comes",
            f"kiteline: no {name}", "The port may be too slow, or its stream rates fixed",
        )  # fmt: skip
