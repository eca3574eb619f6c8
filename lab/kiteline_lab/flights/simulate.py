"""`kiteline sim SCENE --trajectory F --out F.mcap`: record a flight through a simulated world, with its truth."""

import argparse
import json
import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from kiteline_core.frame import EncodedImage, Frame, ImuBatch, OdometryBatch
from kiteline_core.wording import counted
from kiteline_hw.logs.mcap_log import GROUND_TRUTH, IMU, ODOMETER, LogWriter
from kiteline_hw.sensors.images import encode_depth, encode_image
from kiteline_hw.sim.config import RIGS, SimConfig, read_config
from kiteline_hw.sim.sensors.wear import KINDS
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sim.truth.sight import CELL_M, look
from kiteline_hw.sim.world.world import World
from kiteline_hw.system.process import told_if_slow
from kiteline_lab.flights.progress import Progress
from kiteline_lab.grids.truth import write_truth
from kiteline_lab.outputs.out_file import expect_new, expect_nothing_lost, whole_file

JPEG_QUALITY = 92
FIRST_USE = "at the first use of this version kernels are compiled, for some ten seconds"
COURSE = "course"  # in place of a trajectory: the scene's own course


def main(argv: list[str]) -> int:
    """Run the command. Raises SourceError."""
    p = argparse.ArgumentParser(
        prog="kiteline sim",
        description="Record a simulated flight: images, inertial samples and true poses as a log that flies like any "
        "other. Beside it the true occupancy (F.yaml, F.pgm), what could be seen of it from the true poses "
        "(F_seen.yaml, by height band F_seen_LOW-HIGH.yaml), and the true rig (F.rig_truth.json).",
        epilog="The same scene, seed and trajectories give the same bytes.",
    )
    p.add_argument("scene", metavar="SCENE", help="room, hall, corridor or street, perhaps with options: room?seed=3")
    p.add_argument("--trajectory", metavar="F", help="TUM or KITTI file to fly; without it the scene's own course")
    p.add_argument("--out", metavar="F.mcap", type=Path, required=True, help="the log; more agents get F-1.mcap, …")
    p.add_argument("--also", metavar="F", nargs="+", action="extend", default=[],
                   help=f"what further agents fly in the same world; {COURSE!r}: the scene's own course")  # fmt: skip
    p.add_argument("--seed", type=int, help="of textures, furniture and noise (default 0)")
    p.add_argument("--seconds", type=float, help="length of the flight (default: all of F, or 20 of the course)")
    p.add_argument("--start", type=float, help="s into the trajectory (default 0)")
    p.add_argument("--lens", choices=("radtan", "equidistant", "none"), help="default radtan")
    p.add_argument("--rig", choices=RIGS, help="worn: cameras, IMU and stamps that differ from the told calibration as "
                   "they do in the field (default true)")  # fmt: skip
    p.add_argument("--rig-seed", metavar="N", type=int, help="of a worn rig (default: the seed)")
    p.add_argument("--wear", metavar="KIND", nargs="+", help=f"only these kinds of wear: {', '.join(KINDS)}")
    p.add_argument("--mono", action="store_true", default=None, help="no right camera")
    p.add_argument("--depth", action="store_true", default=None, help="true depth in place of the right camera")
    p.add_argument("--no-imu", dest="imu", action="store_false", default=None, help="no inertial samples")
    p.add_argument("--odometry", metavar="HZ", type=float, help="record an odometer's velocities at this rate; options "
                   "of SCENE make it worse: room?odometry_scale=1.05&odometry_slip=0.2&odometry_noise=0.1, or that of "
                   "wheels: odometry_wheels=1")  # fmt: skip
    p.add_argument("--png", action="store_true", help=f"images without loss (default JPEG {JPEG_QUALITY})")
    p.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="threads that render (default: all cores)")
    p.add_argument("--force", action="store_true", help="overwrite F.mcap and what lies beside it")
    o = p.parse_args(argv)
    names = ("trajectory", "seed", "seconds", "start", "lens", "mono", "depth", "imu", "odometry", "rig", "rig_seed")
    options: dict[str, object] = {name: getattr(o, name) for name in names if getattr(o, name) is not None}
    if o.wear:
        options["wear"] = tuple(o.wear)
    if o.also:
        options["also"] = tuple("" if name == COURSE else name for name in o.also)
    config = read_config(o.scene, **options)
    outs = [o.out, *(o.out.with_name(f"{o.out.stem}-{k}{o.out.suffix}") for k in range(1, 1 + len(config.also)))]
    beside = [out.with_suffix(suffix) for out in outs for suffix in (".yaml", ".rig_truth.json")]
    expect_new([*outs, *beside], force=o.force)  # before minutes of rendering
    world: World | None = None
    poses = []
    for agent, out in enumerate(outs):
        with told_if_slow(f"making the scene; {FIRST_USE}"):
            source = SimSource(replace(config, agent=agent), o.workers, world)
        world = source.world
        with whole_file(out, force=True) as part:
            samples = record(source, part, o.png)
        truth = out.with_suffix(".rig_truth.json")
        truth.write_text(
            json.dumps({"rig": config.rig, "readout_s": config.readout_s, **source.worn.to_json()}, indent=1) + "\n"
        )
        poses.append(source.ground_truth.T_w_b @ source.worn.true.T_b_c)
        frames = counted(source.frame_count, "frame")
        print(f"{out}: {frames}, {counted(samples, 'imu sample')}, {out.stat().st_size / 1e6:.1f} MB")
    assert world is not None
    seen = look(world, source.worn.true.left, np.concatenate(poses), cell_m=cell_m(config))
    for file in write_truth(seen, o.out.with_suffix("")):
        print(f"{file}: true occupancy")
    return 0


def cell_m(config: SimConfig) -> float:
    """Side of a cell of the true grid: a street is too large for fine ones."""
    return 0.2 if config.scene == "street" else CELL_M


def record(source: SimSource, path: Path, png: bool = False) -> int:
    """Write a flight as a log; returns the number of inertial samples. Raises SourceError."""
    truth = source.ground_truth
    assert truth is not None
    frames = samples = 0
    with (
        ExitStack() as until_first_frame,
        LogWriter(path, {"role": "recording", "source": source.name}) as log,
        Progress(f"rendering {path.stem.strip('.').removesuffix('.mcap')}", source.frame_count, "frames") as progress,
    ):
        until_first_frame.enter_context(told_if_slow(f"rendering the first frame; {FIRST_USE}"))
        log.rig(int(truth.t_ns[0]), source.rig, source.imu)
        for item in source:
            if isinstance(item, ImuBatch):
                log.imu(IMU, int(item.t_ns[-1]), item)
                samples += len(item.t_ns)
                continue
            if isinstance(item, OdometryBatch):
                log.odometer(ODOMETER, int(item.t_ns[-1]), item)
                continue
            log.pose(GROUND_TRUTH, item.t_ns, "world", truth.T_w_b[frames])
            log.frame(replace(item, encoded=encode(item, png)))
            frames += 1
            until_first_frame.close()
            progress.update(frames)
            expect_nothing_lost(log, path)
    expect_nothing_lost(log, path)
    return samples


def encode(frame: Frame, png: bool) -> tuple[EncodedImage, ...]:
    """Encode the images of a frame for a log: left, then right and depth if it has them."""
    images = [image for image in (frame.left, frame.right) if image is not None]
    coded = []
    for image in images:
        if png:
            coded.append(encode_image(image))
        else:
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            coded.append(EncodedImage(data.tobytes(), "jpeg"))
    if frame.depth_m is not None:
        coded.append(encode_depth(frame.depth_m))
    return tuple(coded)
