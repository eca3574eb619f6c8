"""The built-in path of each scene: a closed course, flown as often as needed."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.sim.world.path import Path
from kiteline_hw.sim.world.path_fit import fit

# Camera axes (columns) of a level camera that looks along +x: right is -y, down is -z.
_R_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def built_in_path(scene: str, seconds: float, camera_in_body: F64, agent: int = 0) -> Path:
    """The path of a scene for one of several agents, at least `seconds` long. Raises KeyError for an unknown scene."""
    t = np.arange(0.0, seconds + 2.0, 0.05)
    position, heading = _COURSES[scene](t, agent)
    sway = 0.05 * np.sin(1.9 * t + agent), 0.07 * np.sin(1.3 * t + 0.5 * agent)  # pitch and roll of a drone, rad
    poses = np.empty((len(t), 4, 4))
    for i in range(len(t)):
        yaw = se3.so3_exp(np.array([0.0, 0.0, heading[i]]))
        tilt = se3.so3_exp(np.array([sway[1][i], 0.06 + sway[0][i], 0.0]))  # the camera looks a little down
        poses[i] = se3.from_rt(yaw @ tilt @ _R_LEVEL, position[i])
    return fit(t, poses @ se3.inverse(camera_in_body), 0.2, 1e-4)


def lap_s(scene: str) -> float:
    """Seconds after which the path repeats: a world built around one lap suits a flight of any length."""
    return {"room": 40.0, "hall": 60.0, "corridor": 70.0, "street": 64.0}[scene]


def _phase(t: F64, period: float, agent: int) -> F64:
    return np.asarray(2 * np.pi * (t / period + 0.31 * agent))


def _room(t: F64, agent: int) -> tuple[F64, F64]:
    a = _phase(t, 40.0, agent)
    p = np.stack([1.7 * np.sin(2 * a), 2.3 * np.sin(a + 0.4), 1.4 + 0.35 * np.sin(3 * a + 1.0)], 1)
    return p, a + 0.7 * np.sin(2 * a) + 0.35 * np.sin(5 * a)


def _hall(t: F64, agent: int) -> tuple[F64, F64]:
    a = _phase(t, 60.0, agent)
    p = np.stack([7.0 * np.sin(a), 5.0 * np.sin(2 * a + 0.3), 2.6 + 1.0 * np.sin(3 * a)], 1)
    return p, a + 0.6 * np.sin(3 * a)


def _ring(distance: F64, length: float, width: float, radius: float) -> tuple[F64, F64]:
    """Position (n, 2) and heading along a rectangle with round corners, counter-clockwise."""
    straight = (length - 2 * radius, width - 2 * radius)
    quarter = 0.5 * np.pi * radius
    lap = 2 * (straight[0] + straight[1]) + 4 * quarter
    turns, s = np.divmod(distance, lap)
    xy, heading = np.zeros((len(s), 2)), np.zeros(len(s))
    corner = np.array([-straight[0] / 2, -width / 2])
    angle, start = 0.0, 0.0
    for side in range(4):
        direction = np.array([np.cos(angle), np.sin(angle)])
        left = np.array([-direction[1], direction[0]])
        run = straight[side % 2]
        on = (s >= start) & (s < start + run)
        xy[on] = corner + np.outer(s[on] - start, direction)
        heading[on] = angle
        corner = corner + run * direction
        start += run
        bend = (s >= start) & (s < start + quarter)
        phi = (s[bend] - start) / radius
        xy[bend] = corner + radius * (np.outer(np.sin(phi), direction) + np.outer(1 - np.cos(phi), left))
        heading[bend] = angle + phi
        corner = corner + radius * (direction + left)
        start += quarter
        angle += 0.5 * np.pi
    return xy, heading + 2 * np.pi * turns


def _corridor(t: F64, agent: int) -> tuple[F64, F64]:
    lap = 2 * (20.0 + 8.0) + 4 * 0.5 * np.pi * 2.0
    xy, heading = _ring(t / 70.0 * lap + 9.0 * agent, 24.0, 12.0, 2.0)
    sway = 0.15 * np.sin(0.8 * t + agent)
    p = np.stack(
        [xy[:, 0] - sway * np.sin(heading), xy[:, 1] + sway * np.cos(heading), 1.3 + 0.15 * np.sin(0.6 * t)], 1
    )
    return p, heading + 0.25 * np.sin(0.7 * t)


def _street(t: F64, agent: int) -> tuple[F64, F64]:
    lap = 2 * (130.0 + 60.0) + 4 * 0.5 * np.pi * 12.0
    xy, heading = _ring(t / 64.0 * lap + 25.0 * agent, 154.0, 84.0, 12.0)
    z = 1.65 + 2.0 * np.sin(xy[:, 0] / 40.0) + 1.0 * np.sin(xy[:, 1] / 25.0)
    sway = 0.3 * np.sin(0.5 * t + agent)
    p = np.stack([xy[:, 0] - sway * np.sin(heading), xy[:, 1] + sway * np.cos(heading), z + 0.02 * np.sin(6 * t)], 1)
    return p, heading + 0.06 * np.sin(0.6 * t)


_COURSES = {"room": _room, "hall": _hall, "corridor": _corridor, "street": _street}
