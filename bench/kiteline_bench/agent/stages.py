"""CPU time of an agent's stages, in frames and in keyframes, flown again from the log of a flight."""

from pathlib import Path

import cv2
import numpy as np

from kiteline_agent.onboard import OnboardAgent
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.harness.profiler import Profiler
from kiteline_codec import warm as codec_warm
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_lab.replay.logged_steps import Step
from kiteline_lab.replay.replay import replay_agent

TITLE = "Stages"

# Functions that are timed, and what they are called in the table: a stage's own time, without that of stages inside.
STAGES: tuple[tuple[str, str], ...] = (
    ("kiteline_agent.agent:Agent.step", "all else"),
    ("kiteline_core.geometry.cameras:Rectifier.rectify", "rectification"),  # of raw images, in keyframes
    ("kiteline_agent.tracking.frame_images:build_pyramid", "pyramids"),
    ("kiteline_agent.tracking.tracker:Tracker.track", "tracking, but for:"),
    ("kiteline_agent.imaging.alignment_kernels:align", "alignment"),
    ("kiteline_agent.imaging.stereo_kernels:refine_rows", "stereo, sub-pixel"),
    ("kiteline_core.pose.pose_kernels:optimise_pose", "pose"),
    ("kiteline_agent.mapping.camera_state:CameraState.predict", "IMU, prediction"),
    ("kiteline_agent.mapping.camera_state:CameraState.fuse", "IMU, fusion"),
    ("kiteline_agent.keyframes.depth_from_motion:DepthFromMotion.update_landmarks", "depths of landmarks"),
    ("kiteline_agent.keyframes.slant_from_motion:SlantFromMotion.update", "slants of landmarks"),
    ("kiteline_agent.keyframes.depth_from_motion:DepthFromMotion.search_seeds", "depth from motion"),
    ("kiteline_agent.mapping.right_camera:RightCamera.add", "rows and disparities"),
    ("kiteline_agent.keyframes.keyframe_maker:KeyframeMaker.make", "keyframe, but for:"),
    ("kiteline_agent.imaging.features:detect", "corners"),
    ("kiteline_agent.imaging.features:describe", "descriptors"),
    ("kiteline_agent.imaging.stereo_kernels:search_rows", "stereo, search"),
    ("kiteline_agent.tracking.frame_images:RightImage.coarse", "right image, half"),
    ("kiteline_agent.imaging.alignment_kernels:cut_templates", "templates"),
    ("kiteline_agent.scans.scan_stage:ScanStage.step", "scans"),
    ("kiteline_agent.mapping.pose_report:PoseReport.report", "pose, covariance"),
    ("kiteline_agent.exchange.corrections:Corrections.take", "corrections"),
    ("kiteline_codec.channel:CodedChannel.receive", "codec, in"),
    ("kiteline_codec.channel:CodedChannel.put", "codec, records"),
    ("kiteline_codec.channel:CodedChannel.poll", "codec, packets"),
)


def profile(log_path: Path) -> dict[str, list[dict[str, int]]]:
    """Fly an agent again from its log. Own times in ns by stage, of every "frame" and every "keyframe"."""
    found: dict[str, list[dict[str, int]]] = {"frame": [], "keyframe": []}
    profiler = Profiler(STAGES)

    def watch(step: Step, agent: OnboardAgent) -> None:
        if step.head["frame_ns"] is not None:
            found["keyframe" if agent.work.keyframes else "frame"].append(profiler.own_ns)
        profiler.clear()

    codec_warm.warm()
    with LogReader(log_path) as log, profiler.running():
        replay_agent(log, watch=watch)
    return found


def table(found: dict[str, list[dict[str, int]]]) -> str:
    """Means in ms as Markdown, a line a stage."""
    lines = ["| stage | a frame, ms | a keyframe, ms |", "|---|---|---|"]
    for _, stage in STAGES:
        cells = (np.mean([own.get(stage, 0) for own in found[kind]] or [0]) / 1e6 for kind in ("frame", "keyframe"))
        lines.append(f"| {stage} | {' | '.join(f'{cell:.2f}' for cell in cells)} |")
    sums = (_mean_ms(found[kind]) for kind in ("frame", "keyframe"))
    return "\n".join([*lines, f"| **together** | {' | '.join(f'**{ms:.2f}**' for ms in sums)} |"])


def _mean_ms(steps: list[dict[str, int]]) -> float:
    return float(np.mean([sum(own.values()) / 1e6 for own in steps] or [0.0]))


def run(bench: Bench) -> list[Bar]:
    """One table a recording."""
    cv2.setNumThreads(1)
    bench.warm()
    bars = []
    for name in ("room_flight.mcap", "kitti_straight"):
        flown = bench.fly(bench.source(name), f"stages_{Path(name).stem}")
        found = profile(flown.folder / "agent0" / "log.mcap")
        bench.more.append(f"{name}: own CPU time of stages, means over {len(found['frame'])} frames and "
                          f"{len(found['keyframe'])} keyframes\n\n{table(found)}")  # fmt: skip
        bars.append(at_most(f"{name}: a keyframe's step, mean", _mean_ms(found["keyframe"]), 12.0, "ms", 2))
        bars.append(at_most(f"{name}: a frame's step, mean", _mean_ms(found["frame"]), 5.0, "ms", 2))
    return bars
