"""State of a guided calibration of an IMU beside a camera: which motion is wanted next, and how certain the result is.

Rotations of the images against the gyro tell its scales and axes, the camera's rotation and the time offset: turns
about an axis tell the column of that axis. Gravity along an axis tells that column of the accelerometer.
"""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_core.arrays import F64
from kiteline_lab.calibration.verdict import CalibrationFinding

_TURNS = ("nod it: turn it up and down", "pan it: turn it left and right", "roll it: tilt it from side to side")
_RESTS = (
    "lay it on its left side, then on its right side",
    "hold it upright, then upside down as far as it sees texture",
    "let it look up, then down",
)  # of the camera's x, y and z along gravity


@dataclass(frozen=True, slots=True)
class GuideConfig:
    """Deviations at which a value counts as known, and what is called wrong."""

    turn: float = 2.5e-3  # of the columns of the gyro's axes, rms: .14 degrees, .25 %; images themselves err by 2e-3
    offset_s: float = 5e-4
    force: float = 3.5e-3  # of the columns of the accelerometer's axes: what consumer IMUs differ by is 10e-3
    most_turn_deg: float = 6.0  # rotation found: beyond it the calibration told is another one's
    tracked: float = 0.9  # share of the frames


@dataclass(frozen=True, slots=True)
class ImuProgress:
    """What is known so far. R_c_b: (3,3) of the body's axes in the camera, as told. metric: lengths are known.

    excess: mean squared error of rotations over what is expected. frames, tracked: so far.
    """

    known: KnownImuConfig | None
    R_c_b: F64
    metric: bool
    frames: int
    tracked: int
    config: GuideConfig = GuideConfig()

    def wanted(self) -> str:
        """The motion that adds most information now; "" if nothing is missing."""
        c = self.config
        if self.frames >= 20 and self.tracked < 0.5 * self.frames:
            return "point it at something with texture, a metre or two away, and move it more slowly"
        if self.known is None:
            return "hold it still for two seconds, then turn it about each axis, by 20 degrees, once a second"
        gyro = self._columns(self.known.gyro_sigma)
        if gyro.max() > c.turn:
            return f"{_TURNS[self._camera_axis(int(gyro.argmax()))]} by 20 degrees, once a second"
        if self.offset_sigma_s > c.offset_s:
            return "turn it to and fro quickly, twice a second"
        force = self._columns(self.known.accel_sigma)
        if self.metric and force.max() > c.force:
            return f"{_RESTS[self._camera_axis(int(force.argmax()))]}, and hold it still there for two seconds"
        return ""

    @property
    def offset_sigma_s(self) -> float:
        """Deviation of the time offset; infinity where it is not known."""
        return self.known.offset_s[1] if self.known is not None and self.known.offset_s else float("inf")

    def _columns(self, sigma: tuple[float, ...]) -> F64:
        """(3,) deviations of the columns of a sensor's axes, rms; infinity where nothing is known."""
        if not sigma:
            return np.full(3, np.inf)
        return np.asarray(np.sqrt(np.mean(np.reshape(sigma, (3, 3)) ** 2, axis=0)))

    def _camera_axis(self, body_axis: int) -> int:
        return int(np.abs(self.R_c_b[:, body_axis]).argmax())

    def note(self) -> str:
        """The state in a line, for progress."""
        if self.known is None:
            return self.wanted()
        gyro, force = (self._columns(s).max() for s in (self.known.gyro_sigma, self.known.accel_sigma))
        text = f"offset to {1e3 * self.offset_sigma_s:.2f} ms, gyro to {100 * gyro:.2f} %, force to {100 * force:.2f} %"
        return f"{text}; {self.wanted() or 'complete'}"

    def findings(self) -> list[CalibrationFinding]:
        """The verdict: what was found, how well it is known, what to do where that is not enough."""
        c, known = self.config, self.known
        if known is None or not known.gyro or not known.offset_s:
            text = "no IMU was found that turns as the images do"
            mend = "check the calibration's T_b_c and axes, that both have one clock, and that the images are tracked"
            return [CalibrationFinding("bad", text, mend)]
        share = self.tracked / max(1, self.frames)
        tracked = f"{100 * share:.0f} % of {self.frames} frames tracked"
        out = [CalibrationFinding("good", tracked) if share >= c.tracked else
               CalibrationFinding("poor", tracked, "more texture, more light, slower turns")]  # fmt: skip
        offset_s, sigma_s = known.offset_s
        text = f"camera stamps {1e3 * offset_s:+.2f} ms to the IMU's time, known to {1e3 * sigma_s:.2f} ms"
        out.append(
            CalibrationFinding("good", text)
            if sigma_s <= c.offset_s
            else CalibrationFinding("poor", text, "turn it quickly")
        )
        gyro, sigma = np.reshape(known.gyro, (3, 3)), self._columns(known.gyro_sigma)
        turn_deg, scale = rotation_deg(gyro), 100.0 * float(np.abs(np.diag(gyro) - 1.0).max())
        text = (f"camera turned by {turn_deg:.2f} degrees against the gyro, whose scales are up to {scale:.2f} % off, "
                f"known to {100 * sigma.max():.2f} %")  # fmt: skip
        if turn_deg > c.most_turn_deg:
            mend = "the T_b_c told is another rig's, or an axis is swapped: measure it anew, and begin again"
            out.append(CalibrationFinding("bad", text, mend))
        else:
            level = "good" if sigma.max() <= c.turn else "poor"
            out.append(CalibrationFinding(level, text, "" if level == "good" else "longer turns about all axes"))
        if not self.metric:
            out.append(
                CalibrationFinding(
                    "poor", "accelerometer: not compared", "a single camera does not know lengths by itself"
                )
            )
            return out
        sigma = self._columns(known.accel_sigma)
        if not np.isfinite(sigma).all():
            out.append(CalibrationFinding("poor", "accelerometer: not compared", "move it to and fro too"))
            return out
        scale = 100.0 * float(np.abs(np.diag(np.reshape(known.accel, (3, 3))) - 1.0).max())
        text = f"accelerometer's scales up to {scale:.2f} % off, known to {100 * sigma.max():.2f} %"
        mend = "hold it still on each side, looking up, looking down: gravity tells the scale along it"
        out.append(
            CalibrationFinding("good", text) if sigma.max() <= c.force else CalibrationFinding("poor", text, mend)
        )
        return out


def rotation_deg(axes: F64) -> float:
    """Angle of the rotation in a sensor's axes (3,3)."""
    u, _, vt = np.linalg.svd(axes)
    return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(u @ vt) - 1.0), -1.0, 1.0))))
