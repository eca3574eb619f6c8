"""KITTI 06's path in a simulated street, with a stereo camera like KITTI's, at 10 Hz."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue

from kiteline_bench.harness.bars import Bench
from kiteline_core.frame import Frame
from kiteline_hw.logs.mcap_log import GROUND_TRUTH, LogWriter
from kiteline_hw.sim.sensors.camera import SimCamera
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_lab.flights.progress import Progress
from kiteline_lab.flights.simulate import encode
from kiteline_lab.outputs.out_file import whole_file

_BASELINE_M = 0.54  # of KITTI's cameras
_EVERY = 2  # frames of the simulator at 20 Hz


def street_recording(bench: Bench) -> Path:
    """The street, 1.2 km in 1101 stereo pairs without IMU; rendered unless the bench's folder has it."""
    out = bench.folder / "street_10hz.mcap"
    if out.exists():
        return out
    trajectory = bench.source("trajectories/KITTI_06.txt")
    source = open_sim("street", trajectory=trajectory, baseline=_BASELINE_M, imu=False, rest=0.0)
    bench.folder.mkdir(parents=True, exist_ok=True)
    truth = source.ground_truth
    with (
        whole_file(out, force=True) as part,
        LogWriter(part, {"role": "recording", "source": source.name}) as log,
        Progress("rendering a street", len(range(0, source.frame_count, _EVERY)), "frames") as progress,
    ):
        log.rig(int(truth.t_ns[0]), source.rig, None)
        for k, frame in enumerate(_frames(source)):
            log.pose(GROUND_TRUTH, frame.t_ns, "world", truth.T_w_b[k * _EVERY])
            log.frame(replace(frame, encoded=encode(frame, False)))
            progress.update(k + 1)
    return out


def _frames(source: SimSource) -> Iterator[Frame]:
    """Every n-th frame, rendered on all cores."""
    cores = os.cpu_count() or 1
    free: SimpleQueue[list[SimCamera]] = SimpleQueue()
    for _ in range(cores):
        free.put(source.cameras())

    def render(k: int) -> Frame:
        cameras = free.get()
        try:
            return source.render(k, cameras)
        finally:
            free.put(cameras)

    wanted = range(0, source.frame_count, _EVERY)
    with ThreadPoolExecutor(cores) as pool:
        for first in range(0, len(wanted), 4 * cores):  # few at a time: images are large
            yield from pool.map(render, wanted[first : first + 4 * cores])
