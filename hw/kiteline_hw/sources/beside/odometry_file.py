"""An odometer's file beside the images of a data set: velocities, or the counts of two wheels' encoders."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiteline_core import odometry
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.ports import FrameSource, SourceError
from kiteline_hw.sensors.odometry_buffer import RATE_SIGMA_RAD_S, VELOCITY_SIGMA_M_S, OdometerStream
from kiteline_hw.sources.overrides import SourceView
from kiteline_hw.sources.text_files import Yaml, nanoseconds, read_rows, read_yaml, seconds_to_ns, yaml_number

CSV, YAML = "odometer.csv", "odometer.yaml"
_WHAT = "an odometer's samples, with a first line that names t_ns or t_s, and ticks_left,ticks_right or any of {}"
_AXES = ("vx", "vy", "vz", "wx", "wy", "wz")  # m/s and rad/s along forward, left and up
_TICKS = ("ticks_left", "ticks_right")
_FORWARD_LEFT_UP = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # in a camera: right, down, forward
_ACROSS_M_S, _TILT_RAD_S = 0.2, 0.3  # deviations of a wheeled vehicle's sideways and vertical motion, roll and pitch
_LEAST_NS, _MOST_NS = 20_000_000, 500_000_000  # ns over which counts are differenced: they are coarse


def with_odometry_file(source: FrameSource, *folders: Path) -> FrameSource:
    """The source with the velocities of the first odometer.csv in these folders; the source itself without one.

    Raises SourceError if the file is no such file.
    """
    path = next((folder / CSV for folder in folders if (folder / CSV).is_file()), None)
    return source if path is None else _OdometryFileView(source, read_odometry_file(path, source.rig))


def read_odometry_file(path: Path, rig: CameraRig) -> OdometryBatch:
    """Samples of a file, in the body frame of the rig and in order of time. Raises SourceError.

    What is known of the odometer is in odometer.yaml beside it: metres_per_tick, track_m, velocity_sigma_m_s,
    rate_sigma_rad_s and T_b_d, 16 numbers: the odometer (forward, left, up) in the body. Without T_b_d it is at the
    left camera and looks where that looks.
    """
    beside = path.with_name(YAML)
    table = read_yaml(beside, "what is known of an odometer") if beside.is_file() else {}
    rows = read_rows(path, _WHAT.format(", ".join(_AXES)), ",")
    names = next(rows, [])
    time = next((name for name in ("t_ns", "t_s") if name in names), None)
    ticks = all(name in names for name in _TICKS)
    if time is None or not (ticks or any(name in names for name in _AXES)):
        raise SourceError(f"{path}: expected {_WHAT.format(', '.join(_AXES))}; found {','.join(names)[:60]!r}")
    stamps, values = [], []
    for cells in rows:
        try:
            row = dict(zip(names, cells, strict=True))
            stamps.append(nanoseconds(row[time]) if time == "t_ns" else seconds_to_ns(row[time]))
            values.append([float(row.get(name, "nan")) for name in (_TICKS if ticks else _AXES)])
        except ValueError as error:
            raise SourceError(f"{path}: {','.join(cells)[:60]!r} does not fit {','.join(names)[:60]}") from error
    t_ns, measured = (
        np.array(stamps, np.int64),
        np.array(values, np.float64).reshape(-1, len(_TICKS) if ticks else len(_AXES)),
    )
    newest = np.concatenate([[-(2**63)], np.maximum.accumulate(t_ns)[:-1]]) if len(t_ns) else t_ns
    t_ns, measured = t_ns[t_ns > newest], measured[t_ns > newest]
    sigma = [yaml_number(table, "velocity_sigma_m_s", beside, VELOCITY_SIGMA_M_S)]
    sigma.append(yaml_number(table, "rate_sigma_rad_s", beside, RATE_SIGMA_RAD_S))
    if ticks:
        rolled_m = measured * yaml_number(table, "metres_per_tick", beside)
        batch = _by_wheels(t_ns, rolled_m, yaml_number(table, "track_m", beside, 0.0), sigma[0])
    else:
        known = [name in names for name in _AXES]
        deviations = np.where(known, np.repeat(sigma, 3), np.inf)
        batch = _batch(t_ns, np.where(known, measured, 0.0), deviations)
    return odometry.in_body(batch, _mounting(table, beside, rig))


def _by_wheels(t_ns: I64, rolled_m: F64, track_m: float, sigma_m_s: float) -> OdometryBatch:
    """Mean velocities between samples, by what the left and the right wheel have rolled (n,2), at the middle times."""
    ends = [0]
    for k in range(len(t_ns)):
        if t_ns[k] - t_ns[ends[-1]] >= _LEAST_NS:
            ends.append(k)
    at_ns, rolled = t_ns[ends] if len(t_ns) else t_ns, rolled_m[ends] if len(t_ns) else rolled_m
    span_ns = np.diff(at_ns)
    known = span_ns <= _MOST_NS
    left, right = (np.diff(rolled, axis=0)[known] / (span_ns[known, None] * 1e-9)).T
    twist = np.zeros((len(left), 6))
    twist[:, 0] = 0.5 * (left + right)
    turn_sigma = np.inf
    if track_m > 0.0:
        twist[:, 5] = (right - left) / track_m
        turn_sigma = np.sqrt(2.0) * sigma_m_s / track_m
    sigma = np.array([sigma_m_s, _ACROSS_M_S, _ACROSS_M_S, _TILT_RAD_S, _TILT_RAD_S, turn_sigma])
    return _batch((at_ns[:-1] + span_ns // 2)[known], twist, sigma)


def _batch(t_ns: I64, twist: F64, sigma: F64) -> OdometryBatch:
    """Samples with the same deviations (6,); infinite where nothing is measured."""
    covariances = (np.tile(odometry.variances(part.tolist()), (len(t_ns), 1, 1)) for part in (sigma[:3], sigma[3:]))
    return OdometryBatch(t_ns, twist[:, :3], twist[:, 3:], *covariances)


def _mounting(table: Yaml, path: Path, rig: CameraRig) -> F64:
    """(4,4) odometer in the body. Raises SourceError."""
    told = table.get("T_b_d")
    if told is None:
        return rig.T_b_c @ se3.from_rt(_FORWARD_LEFT_UP, np.zeros(3))
    is_pose = isinstance(told, list) and len(told) == 16 and all(isinstance(value, int | float) for value in told)
    T = np.array(told if is_pose else np.zeros(16), np.float64).reshape(4, 4)
    if not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3) or np.linalg.det(T[:3, :3]) < 0.0:
        raise SourceError(f"{path}: expected T_b_d: [16 numbers], a pose by rows")
    return T


class _OdometryFileView(SourceView):
    def __init__(self, source: FrameSource, samples: OdometryBatch) -> None:
        super().__init__(source, mono=False, imu=True)
        self._samples = samples

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]:
        stream, begin = OdometerStream(self.report), 0
        for item in super().__iter__():
            if isinstance(item, Frame):
                end = int(np.searchsorted(self._samples.t_ns, item.t_ns, side="right"))
                stream.add(odometry.chosen(self._samples, slice(begin, end)))
                begin, batch = end, stream.take_until(item.t_ns)
                if batch is not None:
                    yield batch
            yield item
