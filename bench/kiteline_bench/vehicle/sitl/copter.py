"""The physics of a quadrotor, for an autopilot that is given its state."""

import json
from dataclasses import dataclass, field

import numpy as np

from kiteline_core.arrays import F64, U16
from kiteline_core.geometry import se3

_G = 9.80665  # m/s^2
_MASS_KG = 1.5
_INERTIA = np.array([0.03, 0.03, 0.05])  # kg m^2
_ARM_M = 0.18  # of each motor, forward and to the side
_YAW_M = 0.05  # torque of a propeller over its thrust
_EXPO = 0.65  # of thrust over command, ArduCopter's default MOT_THST_EXPO
_HOVER = 0.36  # share of the thrust at which it hovers
_LAG_S = 0.02  # of a motor
_DRAG, _TURN_DRAG = 0.3, 0.4  # 1/s
_GUST_M_S2, _GUST_S = 0.03, 2.0  # deviation of the acceleration by the air of a room, and how long it lasts
# Forward, right and yaw direction of the motors of a quadrotor X, in ArduCopter's order.
_MOTORS = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0]])


@dataclass(slots=True)
class Copter:
    """State in NED and body FRD. position_m: of the controller; 0 on the ground. seed: of the wind."""

    seed: int = 0
    t_s: float = 0.0
    position_m: F64 = field(default_factory=lambda: np.zeros(3))
    velocity_m_s: F64 = field(default_factory=lambda: np.zeros(3))
    R_n_f: F64 = field(default_factory=lambda: np.eye(3))
    rate_rad_s: F64 = field(default_factory=lambda: np.zeros(3))
    force_m_s2: F64 = field(default_factory=lambda: np.array([0.0, 0.0, -_G]))  # what accelerometers measure, in f
    thrust: F64 = field(default_factory=lambda: np.zeros(4))  # of each motor, of its largest
    _gust: F64 = field(default_factory=lambda: np.zeros(3))
    _rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        """Begin the wind."""
        self._rng = np.random.default_rng([self.seed, 77])

    @property
    def heading_rad(self) -> float:
        """Heading, clockwise from north."""
        return float(np.arctan2(self.R_n_f[1, 0], self.R_n_f[0, 0]))

    def step(self, pwm: U16, dt_s: float) -> None:
        """Advance by dt_s with the motors' commands (4,) in us."""
        u = np.clip((pwm.astype(np.float64) - 1000.0) / 1000.0, 0.0, 1.0)
        wanted = (1.0 - _EXPO) * u + _EXPO * u * u
        self.thrust += (wanted - self.thrust) * min(1.0, dt_s / _LAG_S)
        newton = self.thrust * (_MASS_KG * _G / (4.0 * _HOVER))
        torque = np.array(
            [
                -_ARM_M * float(_MOTORS[:, 1] @ newton),
                _ARM_M * float(_MOTORS[:, 0] @ newton),
                _YAW_M * float(_MOTORS[:, 2] @ newton),
            ]
        )
        blow = _GUST_M_S2 * np.sqrt(2 * dt_s / _GUST_S) * self._rng.standard_normal(3)
        self._gust += blow - self._gust * dt_s / _GUST_S
        w = self.rate_rad_s
        turn = (torque - np.cross(w, _INERTIA * w)) / _INERTIA - _TURN_DRAG * w
        lift = np.array([0.0, 0.0, -float(newton.sum()) / _MASS_KG])
        flies = self.position_m[2] < 0.0 or float(lift[2]) < -_G
        wind = self._gust - _DRAG * self.velocity_m_s if flies else np.zeros(3)
        acceleration = self.R_n_f @ lift + wind + [0.0, 0.0, _G]
        self.velocity_m_s = self.velocity_m_s + acceleration * dt_s
        self.position_m = self.position_m + self.velocity_m_s * dt_s
        self.rate_rad_s = w + turn * dt_s
        self.R_n_f = self.R_n_f @ se3.so3_exp(self.rate_rad_s * dt_s)
        if self.position_m[2] >= 0.0 and acceleration[2] >= 0.0:  # on its legs, level
            heading = self.heading_rad
            acceleration, self.velocity_m_s, self.rate_rad_s = np.zeros(3), np.zeros(3), np.zeros(3)
            self.position_m[2] = 0.0
            self.R_n_f = se3.so3_exp(np.array([0.0, 0.0, heading]))
        self.force_m_s2 = self.R_n_f.T @ (acceleration - [0.0, 0.0, _G])
        self.t_s += dt_s

    def message(self, since_s: float) -> bytes:
        """The state as ArduPilot's JSON interface takes it; its time begins at since_s."""
        state = {
            "timestamp": self.t_s - since_s,
            "imu": {"gyro": self.rate_rad_s.tolist(), "accel_body": self.force_m_s2.tolist()},
            "position": self.position_m.tolist(),
            "quaternion": se3.quaternion_from_rotation(self.R_n_f).tolist(),
            "velocity": self.velocity_m_s.tolist(),
            "no_time_sync": 1,
        }
        return b"\n" + json.dumps(state, separators=(", ", ":")).encode() + b"\n"
