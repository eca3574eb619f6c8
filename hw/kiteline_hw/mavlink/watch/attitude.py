"""Compares the agent's attitude with the flight controller's, and finds the axes by which the body is mounted. Pure.

Both attitudes tell where down is and how the vehicle turns, and only the rotation between body and controller differs.
All 24 ways in which axes can be mounted are judged by the same samples: rotations over a few degrees, which need no
common north or gravity, and the direction of gravity. The axes in use are wrong when others fit far better.
"""

import itertools
from collections import deque
from dataclasses import dataclass
from math import cos, sin

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.mavlink.controller_odometry import StampClock
from kiteline_hw.mavlink.coordinate_frames import R_L_O, mounting
from kiteline_hw.mavlink.messages import Attitude
from kiteline_hw.mavlink.watch.findings import FindingLevel, FindingLog
from kiteline_hw.ports import PoseSample

TOPIC = "axes"


@dataclass(frozen=True, slots=True)
class AttitudeWatchConfig:
    """When attitudes are compared, and how sure a finding must be. chi2: squared errors over their variance."""

    turn_rad: float = 0.087  # of a rotation that is compared: 5 degrees, three times its noise
    turn_ns: int = 2_000_000_000  # ns; over which a rotation adds up at most: gyros and images drift
    turns: int = 40  # rotations kept
    turn_sigma_rad: float = 0.026  # of a rotation: two attitudes of two filters, and their time offset
    turn_sigma_share: float = 0.15  # of the angle; likewise
    size_share: float = 0.3  # by which the two angles may differ; more is a jump of heading, or a false pose
    down_ns: int = 400_000_000  # ns between two looks at gravity: neighbours have the same error
    downs: int = 8  # looks at gravity kept
    down_rate_rad_s: float = 0.4  # of the turn above which gravity is not compared: 0.1 s of delay is 2 degrees
    down_sigma_rad: float = 0.10  # of gravity; mountings are off by degrees, and accelerations tilt it
    gap_ns: int = 300_000_000  # ns; attitudes are not interpolated over longer gaps between poses
    wrong_chi2: float = 30.0  # by which other axes fit better than those in use
    tie_chi2: float = 12.0  # within which two axes fit equally well
    fit_chi2: float = 3.0  # of a mean rotation by the best axes, above which nothing is said of others
    sure_chi2: float = 20.0  # by which all others are worse, so that the axes in use are confirmed
    misfit_chi2: float = 6.0  # of a mean rotation by the best axes: they do not fit either
    misfit_turns: int = 8  # rotations before that is said
    tilt_rad: float = 0.17  # 10 degrees between the two directions of gravity are said
    level_rad: float = 0.10  # 6 degrees, below which that is over


def _candidates() -> dict[str, F64]:
    """R_b_f (3,3) of the 24 right-handed axes, by their letters."""
    out = {}
    for letters in map("".join, itertools.product("fblrud", repeat=3)):
        try:
            out[letters] = mounting(letters)[:3, :3]
        except ValueError:
            continue
    return out


CANDIDATES = _candidates()
_LETTERS = tuple(CANDIDATES)
_R_F_B = np.stack([r.T for r in CANDIDATES.values()])  # (24, 3, 3)


def attitude_rotation(angles_rad: tuple[float, float, float]) -> F64:
    """R_n_f (3,3) of roll, pitch and yaw."""
    (cr, cp, cy), (sr, sp, sy) = map(cos, angles_rad), map(sin, angles_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


class AttitudeWatch:
    """Poses and ATTITUDE messages in, findings out. R_b_f: (3,3) of the controller's axes (FRD) in the body, in use."""

    def __init__(self, R_b_f: F64, log: FindingLog) -> None:
        self.config = AttitudeWatchConfig()
        self._log = log
        self._in_use = int(np.argmax([np.trace(r @ R_b_f) for r in _R_F_B]))
        self._clock = StampClock()
        self._waiting: deque[tuple[int, F64]] = deque(maxlen=32)  # attitudes of the controller: time, R_n_f
        self._before: tuple[int, F64, int] | None = None  # the last pose: time, R_l_b, epoch
        self._turn_start: tuple[int, F64, F64] | None = None  # time, R_l_b, R_n_f
        self._turns: deque[F64] = deque(maxlen=self.config.turns)  # (24,) chi2 of each rotation
        self._downs: deque[tuple[F64, float]] = deque(maxlen=self.config.downs)  # (24,) chi2; angle by the axes in use
        self._next_down_ns: int | None = None

    def restart(self) -> None:
        """Forget the samples: the controller or the odometry frame began anew."""
        self._clock = StampClock()
        self._waiting.clear()
        self._turns.clear()
        self._downs.clear()
        self._before = self._turn_start = self._next_down_ns = None

    def receive(self, m: Attitude, now_ns: int) -> None:
        """Add the controller's attitude."""
        if all(np.isfinite(m.angles_rad)):
            self._waiting.append((self._clock.to_ours(m.t_ms * 1_000_000, now_ns), attitude_rotation(m.angles_rad)))

    def pose(self, pose: PoseSample) -> None:
        """Add a pose, newer than those before, and compare."""
        before, self._before = self._before, None
        if not pose.tracked:
            self._turn_start = None
            return
        self._before = pose.t_ns, R_L_O @ pose.T_o_b[:3, :3], pose.epoch
        if before is None or before[2] != pose.epoch or not 0 < pose.t_ns - before[0] <= self.config.gap_ns:
            self._turn_start = None
            return
        changed = False
        while self._waiting and self._waiting[0][0] <= pose.t_ns:
            t_ns, r_n_f = self._waiting.popleft()
            if t_ns > before[0]:
                share = (t_ns - before[0]) / (pose.t_ns - before[0])
                step = se3.so3_log(before[1].T @ self._before[1])
                rate = float(np.linalg.norm(step)) * 1e9 / (pose.t_ns - before[0])
                changed |= self._compare(t_ns, before[1] @ se3.so3_exp(share * step), r_n_f, rate)
        if changed:
            self._judge()

    def _compare(self, t_ns: int, r_l_b: F64, r_n_f: F64, rate_rad_s: float) -> bool:
        """Add the samples of one instant; True if there is a new one."""
        c = self.config
        added = False
        due = self._next_down_ns is None or t_ns >= self._next_down_ns
        if due and (rate_rad_s < c.down_rate_rad_s or len(self._downs) < 2):
            self._next_down_ns = t_ns + c.down_ns
            predicted = _R_F_B @ r_l_b[2]  # (24, 3) down in f: the third row of a rotation into a frame with z down
            angles = np.arccos(np.clip(predicted @ r_n_f[2], -1.0, 1.0))
            self._downs.append(((angles / c.down_sigma_rad) ** 2, float(angles[self._in_use])))
            added = True
        if self._turn_start is None or t_ns - self._turn_start[0] > c.turn_ns:
            self._turn_start = t_ns, r_l_b, r_n_f
            return added
        _, first_b, first_f = self._turn_start
        w_b, w_f = se3.so3_log(first_b.T @ r_l_b), se3.so3_log(first_f.T @ r_n_f)
        small, large = sorted((float(np.linalg.norm(w_b)), float(np.linalg.norm(w_f))))
        if large < c.turn_rad:
            return added
        self._turn_start = t_ns, r_l_b, r_n_f
        if large - small > c.size_share * large + c.turn_sigma_rad:
            return added
        errors = np.linalg.norm(_R_F_B @ w_b - w_f, axis=1)
        self._turns.append((errors / (c.turn_sigma_rad + c.turn_sigma_share * large)) ** 2)
        return True

    def _judge(self) -> None:
        c = self.config
        if len(self._downs) < 2:
            return
        chi2 = np.sum([d for d, _ in self._downs], axis=0) + (np.sum(self._turns, axis=0) if self._turns else 0.0)
        best = float(chi2.min())
        used = _LETTERS[self._in_use]
        turns = np.mean(self._turns, axis=0) if self._turns else np.zeros(len(_LETTERS))
        if float(chi2[self._in_use]) - best > c.wrong_chi2 and float(turns[chi2.argmin()]) < c.fit_chi2:
            self._say_wrong(used, [_LETTERS[i] for i in np.flatnonzero(chi2 < best + c.tie_chi2)])
            return
        if len(self._turns) >= c.misfit_turns and float(turns[self._in_use]) > c.misfit_chi2:
            self._log.say(
                TOPIC, "none", FindingLevel.WARNING,
                f"attitude: the vehicle turns otherwise than the flight controller says, by any axes (now {used})",
                "kiteline: mounting fits no axes",
                "The camera is mounted at an angle that its calibration does not say, or its stamps are late",
            )  # fmt: skip
            return
        others = np.delete(chi2, self._in_use)
        tilt_rad = float(np.median([angle for _, angle in self._downs]))
        if tilt_rad > c.tilt_rad and len(self._downs) >= c.downs // 2:
            if self._log.state(TOPIC) != "tilt":
                self._log.say(
                    TOPIC, "tilt", FindingLevel.WARNING,
                    f"attitude: own roll and pitch are {np.degrees(tilt_rad):.0f} degrees off the flight controller's, "
                    f"with axes {used}",
                    f"kiteline: tilt is off by {np.degrees(tilt_rad):.0f} deg",
                    "Check the camera's angle in the calibration, and calibrate the level of the controller",
                )  # fmt: skip
            return
        level = tilt_rad < (c.level_rad if self._log.state(TOPIC) == "tilt" else c.tilt_rad)
        fits = bool(self._turns) and float(turns[self._in_use]) < c.fit_chi2
        if fits and level and float(others.min()) - float(chi2[self._in_use]) > c.sure_chi2:
            self._log.say(
                TOPIC, "good", FindingLevel.INFO,
                f"attitude: agrees with the flight controller's, axes {used} are right",
                f"kiteline: axes {used} are right",
            )  # fmt: skip

    def _say_wrong(self, used: str, fitting: list[str]) -> None:
        if len(fitting) == 1:
            right, remedy = fitting[0], f"Land, and start the agent with --axes {fitting[0]}"
        else:
            right = " or ".join([", ".join(fitting[:-1]), fitting[-1]])
            remedy = f"Do not fly. Tilt and turn the vehicle by hand to learn which of {right} is right"
        self._log.say(
            TOPIC, tuple(fitting), FindingLevel.ERROR,
            f"attitude: --axes {used} are wrong: by the flight controller's attitude they are {right}",
            f"kiteline: axes {used} wrong, fit: {'/'.join(fitting)}", remedy,
        )  # fmt: skip
