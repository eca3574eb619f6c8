"""`kiteline rig show|export STORE|FILE`: what a base or a rig file knows of cameras, also in the forms of other tools.

The cameras are the rectified ones of the calibration that was told. Errors of disparities and rows are written as a
right camera that is turned, and whose focal length and centre differ.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.imaging import row_alignment
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.known_rig import KnownRigConfig, known_rig
from kiteline_agent.runtime import rig_file
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.refinement.disparity_calibration import CALIBRATED_PX
from kiteline_core.arrays import F64
from kiteline_core.errors import KitelineError
from kiteline_core.geometry import disparity_offset, se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, RectifiedCamera
from kiteline_core.ids import AgentId
from kiteline_lab.outputs.out_file import write_files
from kiteline_lab.tools.export import load

FORMATS = ("kalibr", "euroc", "kiteline")
_LIKELY = np.array([1.0, 1.0, 0.5, 1e-3, 1e-3, 1e-3])  # px, px, px, rad: what mounts and lenses change by
_NONE_KNOWN = "no camera is known: expected a store or a rig file that a flight has written"
_FIT_PX = 0.005  # rms misfit that is accepted for a likelier rig


class RigError(KitelineError):
    """A rig that is not known or cannot be exported."""


def found_rig(camera: RectifiedCamera, offset_px: F64, rows_px: F64 | None) -> CameraRig:
    """The rectified pair whose disparities are off by `offset_px` (5,), and the right image's rows by `rows_px` (5,).

    rows_px: None if no agent told it. The right camera is turned, and its focal length and centre differ: the most
    likely ones that explain both.
    """
    f = camera.fx
    left = CameraModel(camera.width, camera.height, f, camera.fy, camera.cx, camera.cy)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9) * camera.width / f, np.linspace(-0.5, 0.5, 7) * camera.height / f)
    xy = np.stack([x.ravel(), y.ravel()], 1)
    # a point far away: the right image is left of where it should be by the excess disparity, and lower by the rows
    across = -disparity_offset.terms(xy) @ offset_px
    down = across if rows_px is None else row_alignment.terms(xy) @ rows_px
    wanted = np.stack([across, down], 1)[:, : 1 + (rows_px is not None)]
    x, y = xy.T
    none = np.zeros_like(x)
    # by the centre, the focal length, and the turn about x, y, z of the right camera
    shift = np.stack([
        np.stack([none + 1.0, none], 1), np.stack([none, none + 1.0], 1), np.stack([x, y], 1),
        f * np.stack([x * y, 1.0 + y * y], 1), f * np.stack([-1.0 - x * x, -x * y], 1), f * np.stack([y, -x], 1),
    ])  # fmt: skip
    columns = shift[:, :, : wanted.shape[1]].reshape(6, -1).T * _LIKELY
    normal = columns.T @ columns + len(columns) * _FIT_PX**2 * np.eye(6)
    cx, cy, df, *turn = np.linalg.solve(normal, columns.T @ wanted.ravel()) * _LIKELY
    right = CameraModel(camera.width, camera.height, f + df, camera.fy + df, camera.cx + cx, camera.cy + cy)
    T_c_r = se3.from_rt(se3.so3_exp(np.array(turn)), np.array([camera.baseline_m, 0.0, 0.0]))
    return CameraRig(left, right, camera.T_b_c, T_c_r)


class KnownCameras:
    """What a store or a rig file knows of cameras, by agent, and a rig file of the IMU."""

    def __init__(self) -> None:
        self.cameras: dict[AgentId, RectifiedCamera] = {}
        self.disparity_px: dict[AgentId, F64] = {}
        self.rows_px: dict[AgentId, F64] = {}
        self.rows_read: set[AgentId] = set()
        self.calibrated: set[AgentId] = set()
        self.sigma_px: dict[AgentId, float] = {}  # of disparity_px, where the rig is not a good calibration's
        self.imu = KnownImuConfig()  # of a rig file
        self.readout_s: tuple[float, ...] = ()  # of a rig file, as KnownRigConfig has it

    @classmethod
    def of_base(cls, mapper: Mapper) -> "KnownCameras":
        """Of a base."""
        out = cls()
        out.cameras.update(mapper.map.cameras)
        out.disparity_px.update(mapper.map.disparity_offset_px)
        sure_px = CALIBRATED_PX  # a store says only whose deviation is smaller
        out.sigma_px.update(dict.fromkeys(mapper.map.disparity_calibrated, sure_px) | mapper.map.disparity_sigma_px)
        out.rows_px.update(mapper.map.rows_px)
        out.rows_read.update(mapper.map.rows_read)
        out.calibrated.update(mapper.map.disparity_calibrated)
        return out

    @classmethod
    def of_file(cls, known: KnownRigConfig) -> "KnownCameras":
        """Of a rig file, as agent 0; empty if it says nothing."""
        out, agent = cls(), AgentId(0)
        camera = known.rectified()
        if camera is not None:
            out.cameras[agent], out.disparity_px[agent] = camera, known.disparity
            if known.rows_px:
                out.rows_px[agent] = known.rows
            out.rows_read.update([agent] if known.rows_read else [])
            if known.disparity_sigma_px > 0.0:
                out.sigma_px[agent] = known.disparity_sigma_px
            out.imu, out.readout_s = known.imu, known.readout_s
        return out

    def offset_px(self, agent: AgentId) -> F64:
        """Disparity offset (5,) of an agent, zero if none is known."""
        return self.disparity_px.get(agent, disparity_offset.none())

    def rig(self, agent: AgentId) -> CameraRig:
        """An agent's rectified pair as it was found."""
        rig = found_rig(self.cameras[agent], self.offset_px(agent), self.rows_px.get(agent))
        if not self.readout_s:
            return rig
        left = dataclasses.replace(rig.left, readout_s=self.readout_s[0])
        return dataclasses.replace(
            rig, left=left, right=rig.right and dataclasses.replace(rig.right, readout_s=left.readout_s)
        )


def opened(path: Path) -> KnownCameras:
    """What the store of a base (a folder) or a rig file knows. Raises KitelineError."""
    if not path.exists():
        raise RigError(
            f"{path}: no such file or folder; expected a rig file, which `kiteline agent --rig FILE` writes, or the "
            "folder given to `kiteline base --store`"
        )
    return KnownCameras.of_file(rig_file.load(str(path))) if path.is_file() else KnownCameras.of_base(load(path))


def summary(known: KnownCameras) -> dict[str, Any]:
    """Camera, disparity offset and rows of each agent, by its number."""
    out: dict[str, Any] = {}
    for agent, camera in sorted(known.cameras.items()):
        rig, rows = known.rig(agent), known.rows_px.get(agent)
        turned = np.zeros(3) if rig.T_c_r is None else se3.so3_log(rig.T_c_r[:3, :3])
        out[str(int(agent))] = {
            "size_px": [camera.width, camera.height],
            "focal_px": [camera.fx, camera.fy],
            "centre_px": [camera.cx, camera.cy],
            "baseline_m": camera.baseline_m if camera.stereo else None,
            "disparity_offset_px": known.offset_px(agent).tolist(),
            "rows_px": None if rows is None else rows.tolist(),
            "disparity_sigma_px": known.sigma_px.get(agent),
            "calibrated": agent in known.calibrated or agent in known.sigma_px,
            "right_camera_turned_deg": np.degrees(turned).tolist(),
            "readout_s": list(known.readout_s),
            "imu": {name: list(values) for name, values in dataclasses.asdict(known.imu).items()},
        }
    return out


def _shutter_and_imu_lines(rig: dict[str, Any]) -> list[str]:
    """What is known of shutter and IMU, beside the deviations of a sensor whose axes are unknown."""
    imu, lines = rig["imu"], []
    if rig["readout_s"]:
        lines.append("  rolling shutter: {:.1f} ms from the first row to the last (deviation {:.1f} ms)".format(
            *(1000.0 * v for v in rig["readout_s"])))  # fmt: skip
    if imu["offset_s"]:
        lines.append("  camera stamps + {:.2f} ms are the IMU's time (deviation {:.2f} ms)".format(
            *(1000.0 * v for v in imu["offset_s"])))  # fmt: skip
    for sensor, name in (("gyro", "gyro"), ("accel", "accelerometer")):
        if imu[sensor]:
            measured = np.linalg.inv(np.reshape(imu[sensor], (3, 3)))
            u, _, vt = np.linalg.svd(measured)
            scale = " ".join(f"{100.0 * (v - 1.0):+.2f}" for v in np.diag(measured))
            turn = " ".join(f"{v:+.2f}" for v in np.degrees(se3.so3_log(u @ vt)))
            sigma = float(np.sqrt(np.mean(np.square(imu[f"{sensor}_sigma"]))))
            lines.append(f"  {name}: scales off by {scale} %, turned by {turn} degrees against the camera "
                         f"(deviation {100.0 * sigma:.2f} %, {np.degrees(sigma):.2f} degrees)")  # fmt: skip
    return lines


def table(rigs: dict[str, Any]) -> str:
    """The summary as text."""
    lines = []
    for agent, rig in rigs.items():
        width, height = rig["size_px"]
        lines.append(f"agent {agent}: {width}x{height} px, focal length {rig['focal_px'][0]:.2f} px (rectified)")
        if rig["baseline_m"] is None:
            lines += ["  no right camera", *_shutter_and_imu_lines(rig)]
            continue
        offset = " ".join(f"{c:+.3f}" for c in rig["disparity_offset_px"])
        turned = " ".join(f"{a:+.4f}" for a in rig["right_camera_turned_deg"])
        lines.append(f"  baseline {1000.0 * rig['baseline_m']:.2f} mm")
        lines.append(f"  disparities too large by {offset} px of 1, x, y, x^2, x y"
                     f"{'' if rig['calibrated'] else ' (uncertain)'}")  # fmt: skip
        if rig["rows_px"] is not None:
            rows = " ".join(f"{c:+.3f}" for c in rig["rows_px"])
            lines.append(f"  rows of the right image too low by {rows} px of 1, x, y, x y, y^2")
        lines.append(f"  like a right camera turned by {turned} degrees about x, y, z")
        lines += _shutter_and_imu_lines(rig)
    return "\n".join(lines)


def exported(known: KnownCameras, agent: int | None, kind: str) -> dict[str, str]:
    """Texts of the files of one format by name.

    kalibr: a camera chain; euroc: a sensor.yaml of each camera; kiteline: a rig file for `kiteline agent --rig`.
    """
    cameras = known.cameras
    if not cameras:
        raise RigError(_NONE_KNOWN)
    if agent is None and len(cameras) != 1:
        raise RigError(f"{len(cameras)} agents: choose one with --agent")
    chosen = AgentId(agent) if agent is not None else next(iter(cameras))
    camera = cameras.get(chosen)
    if camera is None:
        raise RigError(f"no agent {chosen}: expected one of {', '.join(str(int(a)) for a in sorted(cameras))}")
    if kind == "kiteline" and not camera.stereo:
        one_camera = KnownRigConfig().updated(camera, None, known.imu, known.readout_s)
        assert one_camera is not None
        return {"rig.toml": rig_file.text_of(one_camera)}
    if kind == "kiteline":
        rows = known.rows_px.get(chosen, np.zeros(row_alignment.TERMS))
        read = chosen in known.rows_read
        found = known_rig(camera, rows, known.offset_px(chosen), known.sigma_px.get(chosen), rows_read=read)
        return {"rig.toml": rig_file.text_of(dataclasses.replace(found, imu=known.imu, readout_s=known.readout_s))}
    rig = known.rig(chosen)
    pair = [(rig.left, rig.T_b_c)]
    if camera.stereo and rig.right is not None and rig.T_c_r is not None:
        pair.append((rig.right, rig.T_b_c @ rig.T_c_r))
    if kind == "euroc":
        return {f"cam{k}/sensor.yaml": _euroc(model, T_b_c) for k, (model, T_b_c) in enumerate(pair)}
    lines = []
    for k, (model, T_b_c) in enumerate(pair):
        lines += [f"cam{k}:", "  camera_model: pinhole", f"  intrinsics: {_four(model)}", "  distortion_model: radtan",
                  "  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]", f"  resolution: [{model.width}, {model.height}]",
                  f"  rostopic: /cam{k}/image_rect", "  T_cam_imu:", *_rows(se3.inverse(T_b_c))]  # fmt: skip
        if model.readout_s:
            lines.append(f"  line_delay: {model.readout_s / model.height!r}")
        if known.imu.offset_s:
            lines.append(f"  timeshift_cam_imu: {known.imu.offset_s[0]!r}")
        if k:
            lines += ["  T_cn_cnm1:", *_rows(se3.inverse(T_b_c) @ pair[k - 1][1])]
    return {"camchain-imucam.yaml": "\n".join(lines) + "\n"}


def _four(model: CameraModel) -> str:
    return f"[{model.fx!r}, {model.fy!r}, {model.cx!r}, {model.cy!r}]"


def _rows(T: F64) -> list[str]:
    return ["  - [" + ", ".join(repr(float(v)) for v in row) + "]" for row in T]


def _euroc(model: CameraModel, T_b_c: F64) -> str:
    data = ", ".join(repr(float(v)) for v in T_b_c.ravel())
    readout = f"readout_s: {model.readout_s!r}\n" if model.readout_s else ""
    return (
        "sensor_type: camera\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n"
        f"rate_hz: 20\nresolution: [{model.width}, {model.height}]\ncamera_model: pinhole\nintrinsics: {_four(model)}\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
        f"{readout}"
    )


def main(argv: Sequence[str]) -> int:
    """Run `kiteline rig`; the exit status. Raises KitelineError."""
    parser = argparse.ArgumentParser(prog="kiteline rig", description="What flights found of cameras and IMU.")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    show = verbs.add_parser("show", help="cameras, IMU and what was found of them")
    show.add_argument("--json", action="store_true", help="print JSON")
    export = verbs.add_parser("export", help="write the rectified pair as it was found; kiteline: a rig file")
    export.add_argument("--format", choices=FORMATS, required=True)
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write to")
    export.add_argument("--agent", type=int, help="whose rig; needed if there are several")
    export.add_argument("--force", action="store_true", help="overwrite files in DIR")
    for verb in (show, export):
        verb.add_argument(
            "known", type=Path, metavar="STORE|FILE",
            help="the folder given to `kiteline base --store`, or the file given to `kiteline agent --rig`",
        )  # fmt: skip
    args = parser.parse_args(argv)
    known = opened(args.known)
    if args.verb == "show":
        rigs = summary(known)
        sys.stdout.write((json.dumps(rigs, indent=2) if args.json else table(rigs) or _NONE_KNOWN) + "\n")
        return 0
    made = exported(known, args.agent, args.format)
    for path in write_files(args.out, {name: text.encode() for name, text in made.items()}, force=args.force):
        print(path)
    return 0
