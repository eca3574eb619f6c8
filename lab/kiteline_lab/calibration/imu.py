"""`kiteline calibrate imu`: the IMU against the camera by a guided motion, into the rig file."""

import argparse
import json
import sys
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.runtime import rig_file
from kiteline_agent.runtime.agent_runtime import AgentRuntime, opened
from kiteline_agent.runtime.controller import controller_link, with_controller_imu
from kiteline_agent.runtime.options import AgentOptions, agent_config
from kiteline_agent.step import StepInput
from kiteline_core.arguments import duration
from kiteline_core.errors import KitelineError
from kiteline_core.geometry import se3
from kiteline_hw.sources.kinds import source_forms
from kiteline_hw.system import process
from kiteline_hw.system.clock import MonotonicClock
from kiteline_lab.calibration.imu_guide import ImuProgress
from kiteline_lab.calibration.verdict import overall
from kiteline_lab.outputs.out_file import expect_writable, whole_file

_IDLE_NS = 50_000_000  # ns that a live camera is awaited at most
_EVERY = 10  # frames between two looks
_SAID_EVERY = 4  # looks between two lines of guidance, unless another motion is wanted
# What is told of a rig that was never calibrated with its IMU is a drawing's or a ruler's.
_MOUNTED_RAD, _SCALE, _OFFSET_S = 0.03, 0.02, 0.03
_IMAGES = 2e-3  # of axes; by which images err in one direction all along: focal lengths, depths of a worn pair


class ImuMissing(KitelineError):
    """A source without inertial samples."""


def add_parser(verbs: Any) -> None:
    """Add the verb `imu`."""
    p = verbs.add_parser("imu", help="calibrate the IMU against the camera by a guided motion, into the rig file")
    p.add_argument("source", metavar="SOURCE", help=f"live, or a recording of such a motion: {source_forms()}")
    p.add_argument("--rig", type=Path, required=True, metavar="FILE",
                   help="the rig file to write, for `agent --rig`; what it says of the cameras is kept")  # fmt: skip
    p.add_argument("--calibration", default="", metavar="FILE[,FILE]", help="cameras, place and noise of the IMU")
    p.add_argument("--seconds", type=duration, default=120.0, metavar="S", help="at most (default: 120)")
    p.add_argument("--mavlink", default="", metavar="URL", help="take the IMU of this flight controller")
    p.add_argument("--axes", default="", metavar="XYZ", help="as of the agent, with --mavlink")
    p.add_argument("--config", default="", metavar="F.toml", help="as of the agent, with T_f_c for --mavlink")
    p.add_argument("--json", action="store_true", help="print the verdict as JSON")


def run(args: argparse.Namespace) -> int:
    """Guide, calibrate, write; the exit status. Raises KitelineError."""
    expect_writable(args.rig)
    options = AgentOptions(
        args.source, str(args.rig.parent), "", config=args.config, calibration=args.calibration, mavlink=args.mavlink,
        axes=args.axes, imu_of="controller" if args.mavlink else "", seconds=args.seconds,
    )  # fmt: skip
    kept = rig_file.load(str(args.rig))
    progress, known = None, None
    with closing(follow(options, config_of(options, kept))) as looks:
        told, since = "", 0
        for look in looks:
            progress, known = look
            wanted, since = progress.wanted(), since + 1
            if not args.json and (wanted != told or since >= _SAID_EVERY):
                print(f"{progress.frames:6} frames  {progress.note()}", flush=True)
                told, since = wanted, 0
            if not wanted:
                break
    if progress is None:
        raise ImuMissing(f"{args.source}: no frame came: expected a source with images and an IMU")
    findings = progress.findings()
    verdict = overall(findings)
    if verdict != "bad" and known is not None:
        with whole_file(args.rig, force=True) as part:
            part.write_text(rig_file.text_of(known))
    if args.json:
        imu = KnownImuConfig() if known is None else known.imu
        print(json.dumps({
            "file": str(args.rig), "verdict": verdict, "wanted": progress.wanted(), "frames": progress.frames,
            "findings": [{"level": f.level, "text": f.text, "mend": f.mend} for f in findings],
            "offset_s": imu.offset_s, "gyro": imu.gyro, "gyro_sigma": imu.gyro_sigma,
            "accel": imu.accel, "accel_sigma": imu.accel_sigma,
        }, indent=2))  # fmt: skip
    else:
        worth = {"good": "good", "poor": "usable; the lines above say how it gets better", "bad": "not written"}
        sys.stdout.write("\n".join(f.line() for f in findings) + f"\n{args.rig}: {worth[verdict]}\n")
    return 1 if verdict == "bad" else 0


def config_of(options: AgentOptions, kept: KnownRigConfig) -> AgentConfig:
    """The agent's configuration for a rig that was mounted by hand: wider priors, and nothing known of the IMU.

    What is found is not applied meanwhile: early estimates would bend the poses from which the later ones come.
    """
    config = agent_config(options.config)
    own = config.inertial.calibration
    wide = replace(
        own, misalignment_sigma=max(own.misalignment_sigma, _MOUNTED_RAD),
        sensor_scale_sigma=max(own.sensor_scale_sigma, _SCALE),
        offset_sigma_s=max(own.offset_sigma_s, _OFFSET_S), apply_axes=False,
    )  # fmt: skip
    return replace(
        config, inertial=replace(config.inertial, calibration=wide), known_rig=replace(kept, imu=KnownImuConfig())
    )


def follow(options: AgentOptions, config: AgentConfig) -> Generator[tuple[ImuProgress, KnownRigConfig | None]]:
    """Track a source alone; what is known every half second, as the guide and as the rig file have it."""
    with ExitStack() as stack:
        source = opened(options)
        stack.callback(source.close)
        source = with_controller_imu(options, source)
        if source.imu is None:
            raise ImuMissing(
                f"{source.name} has no IMU: expected a recording or ros2: topics with one, or --mavlink URL for the "
                "flight controller's; its noise and place are told by --calibration"
            )
        runtime = AgentRuntime(options, source, NoBaseChannel(), whole_process=False, config=config)
        stack.callback(runtime.close)
        R_c_b = se3.inverse(source.rig.T_b_c)[:3, :3]
        tracked = 0
        for frames, _ in enumerate(_frames(runtime, options, stack), 1):
            output = runtime.output
            tracked += output is not None and output.estimate is not None and output.estimate.tracked
            if frames % _EVERY == 0:
                known = runtime.agent.known_rig()
                if known is not None:
                    known = replace(known, imu=_doubted(known.imu))
                imu = None if known is None or not known.imu.gyro else known.imu
                # a monocular camera has its lengths from the accelerometer: they cannot be compared
                yield ImuProgress(imu, np.asarray(R_c_b), source.rig.right is not None, frames, tracked), known


def _doubted(imu: KnownImuConfig) -> KnownImuConfig:
    """With deviations that count what images err by all along."""
    gyro, accel = (tuple(round(float(np.hypot(v, _IMAGES)), 6) for v in s) for s in (imu.gyro_sigma, imu.accel_sigma))
    return replace(imu, gyro_sigma=gyro, accel_sigma=accel)


def _frames(runtime: AgentRuntime, options: AgentOptions, stack: ExitStack) -> Iterator[None]:
    """Step through the frames of a camera for some seconds, or of a recording."""
    if runtime.camera is None:
        while runtime.next_ns is not None:
            now_ns = runtime.next_ns
            frame, imu, odometry = runtime.reader.take()
            runtime.step(StepInput(frame, imu, odometry=odometry), now_ns)
            yield
        return
    clock, stop = MonotonicClock(), process.StopSignal()
    controller = controller_link(options, runtime.source, clock, stack)
    begin_ns = clock.now_ns()
    runtime.begin_at(begin_ns)
    if controller is not None:
        controller.take_imu(begin_ns)  # what was measured before
    while not stop and clock.now_ns() - begin_ns < options.seconds * 1e9:
        told = runtime.await_frame(clock.now_ns() + _IDLE_NS)
        process.print_lines(told)
        if runtime.next_ns is None:
            continue
        captured_ns = begin_ns + runtime.next_ns
        frame, imu, odometry = runtime.reader.take()
        samples = None if controller is None else controller.take_imu(captured_ns)
        runtime.step(StepInput(frame, samples or imu, odometry=odometry), clock.now_ns())
        yield
