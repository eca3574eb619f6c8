"""`kiteline rig show|export STORE`: what a base knows of the agents' cameras, also in the forms of other tools.

The cameras are the rectified ones of the calibration that was told. The base's disparity offset is written as a right
camera that is turned, and whose focal length and centre differ: its five numbers are those of such a camera.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.mapper import Mapper
from kiteline_core.errors import KitelineError
from kiteline_core.geometry import disparity_offset, se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, RectifiedCamera
from kiteline_core.ids import AgentId
from kiteline_lab.tools.export import load

F64 = NDArray[np.float64]

FORMATS = ("kalibr", "euroc")


class RigError(KitelineError):
    """A rig that is not known or cannot be exported."""


def found_rig(camera: RectifiedCamera, offset_px: F64) -> CameraRig:
    """The rectified pair in which disparities are off by `offset_px` (5,): its right camera is not quite parallel."""
    c0, c1, c2, c3, c4 = (float(c) for c in offset_px)
    f = camera.fx
    left = CameraModel(camera.width, camera.height, f, camera.fy, camera.cx, camera.cy)
    right = CameraModel(camera.width, camera.height, f - c1, camera.fy, camera.cx + c3 - c0, camera.cy)
    turned = se3.so3_exp(np.array([-c4 / f, c3 / f, -c2 / f]))
    return CameraRig(left, right, camera.T_b_c, se3.from_rt(turned, np.array([camera.baseline_m, 0.0, 0.0])))


def summary(mapper: Mapper) -> dict[str, Any]:
    """Camera and disparity offset of each agent, by its number."""
    out: dict[str, Any] = {}
    for agent, camera in sorted(mapper.map.cameras.items()):
        offset = mapper.map.disparity_offset_px.get(agent, disparity_offset.none())
        rig = found_rig(camera, offset)
        turned = np.zeros(3) if rig.T_c_r is None else se3.so3_log(rig.T_c_r[:3, :3])
        out[str(int(agent))] = {
            "size_px": [camera.width, camera.height],
            "focal_px": [camera.fx, camera.fy],
            "centre_px": [camera.cx, camera.cy],
            "baseline_m": camera.baseline_m if camera.stereo else None,
            "disparity_offset_px": offset.tolist(),
            "calibrated": agent in mapper.map.disparity_calibrated,
            "right_camera_turned_deg": np.degrees(turned).tolist(),
        }
    return out


def table(rigs: dict[str, Any]) -> str:
    """The summary as text."""
    lines = []
    for agent, rig in rigs.items():
        width, height = rig["size_px"]
        lines.append(f"agent {agent}: {width}x{height} px, focal length {rig['focal_px'][0]:.2f} px (rectified)")
        if rig["baseline_m"] is None:
            lines.append("  no right camera")
            continue
        offset = " ".join(f"{c:+.3f}" for c in rig["disparity_offset_px"])
        turned = " ".join(f"{a:+.4f}" for a in rig["right_camera_turned_deg"])
        lines.append(f"  baseline {1000.0 * rig['baseline_m']:.2f} mm")
        lines.append(f"  disparities too large by {offset} px of 1, x, y, x^2, x y"
                     f"{'' if rig['calibrated'] else ' (uncertain)'}")  # fmt: skip
        lines.append(f"  like a right camera turned by {turned} degrees about x, y, z")
    return "\n".join(lines)


def exported(mapper: Mapper, agent: int | None, kind: str) -> dict[str, str]:
    """Texts of the files of one format by name. kalibr: a camera chain; euroc: a sensor.yaml of each camera."""
    cameras = mapper.map.cameras
    if agent is None and len(cameras) != 1:
        raise RigError(f"{len(cameras)} agents: choose one with --agent")
    chosen = AgentId(agent) if agent is not None else next(iter(cameras))
    camera = cameras.get(chosen)
    if camera is None:
        raise RigError(f"no agent {chosen}: expected one of {', '.join(str(int(a)) for a in sorted(cameras))}")
    rig = found_rig(camera, mapper.map.disparity_offset_px.get(chosen, disparity_offset.none()))
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
        if k:
            lines += ["  T_cn_cnm1:", *_rows(se3.inverse(T_b_c) @ pair[k - 1][1])]
    return {"camchain-imucam.yaml": "\n".join(lines) + "\n"}


def _four(model: CameraModel) -> str:
    return f"[{model.fx!r}, {model.fy!r}, {model.cx!r}, {model.cy!r}]"


def _rows(T: F64) -> list[str]:
    return ["  - [" + ", ".join(repr(float(v)) for v in row) + "]" for row in T]


def _euroc(model: CameraModel, T_b_c: F64) -> str:
    data = ", ".join(repr(float(v)) for v in T_b_c.ravel())
    return (
        "sensor_type: camera\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n"
        f"rate_hz: 20\nresolution: [{model.width}, {model.height}]\ncamera_model: pinhole\nintrinsics: {_four(model)}\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )


def main(argv: Sequence[str]) -> int:
    """Run `kiteline rig`; the exit status. Raises KitelineError."""
    parser = argparse.ArgumentParser(prog="kiteline rig", description="What a base knows of the agents' cameras.")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    show = verbs.add_parser("show", help="cameras and what the base found of them")
    show.add_argument("--json", action="store_true", help="print JSON")
    export = verbs.add_parser("export", help="write the rectified pair, as the base found it")
    export.add_argument("--format", choices=FORMATS, required=True)
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write to")
    export.add_argument("--agent", type=int, help="whose rig; needed if there are several")
    for verb in (show, export):
        verb.add_argument("store", type=Path, metavar="STORE", help="the folder given to `kiteline base --store`")
    args = parser.parse_args(argv)
    mapper = load(args.store)
    if args.verb == "show":
        rigs = summary(mapper)
        sys.stdout.write((json.dumps(rigs, indent=2) if args.json else table(rigs)) + "\n")
        return 0
    for name, text in exported(mapper, args.agent, args.format).items():
        path = args.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        print(path)
    return 0
