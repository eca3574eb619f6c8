"""A flight with a base, its grid, and the motion from the base's world to the true one."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_basestation.runtime.map_files import map_files
from kiteline_bench.grid.sparse import SparsePoints
from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.recording import Recording
from kiteline_bench.harness.run import RecordingRun, fly_recording
from kiteline_codec.channel import RecordChannel
from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import Rectifier
from kiteline_lab.evaluation import metrics
from kiteline_lab.grids.files import GridFile, planar, read_grid


@dataclass(frozen=True, slots=True)
class FlownGrid:
    """A flight and the grid at its end. T_true_w: (4,4), by the keyframes' positions; keyframe_m: their error."""

    run: RecordingRun
    grid: GridFile
    T_true_w: F64
    keyframe_m: float

    @property
    def T_plane(self) -> F64:
        """(3,3) motion of the plane that maps the grid onto the truth."""
        yaw_deg = float(np.degrees(np.arctan2(self.T_true_w[1, 0], self.T_true_w[0, 0])))
        return planar(float(self.T_true_w[0, 3]), float(self.T_true_w[1, 3]), yaw_deg)

    @property
    def sparse(self) -> SparsePoints:
        """The base's landmarks, and the keyframes that observe them."""
        mapper = self.run.station.mapper
        placed = placed_map(mapper.map, mapper.placements)
        return SparsePoints(placed.positions, placed.points, placed.rays)


def fly_grid(
    bench: Bench, name: str, recording: Recording, channels: Callable[[RecordChannel], RecordChannel] | None = None
) -> FlownGrid:  # fmt: skip
    """Fly a recording, in lock-step in this process, and write the base's grid into the bench's folder.

    channels: wraps the two ends of the link.
    """
    bench.say(f"flying {name}")
    run = fly_recording(recording, channels=channels)
    mapper = run.station.mapper
    folder = bench.folder / "grids" / name.replace(", ", "_").replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    for file, data in map_files(mapper).items():
        (folder / file).write_bytes(data)
    T_b_c = Rectifier(recording.rig).camera.T_b_c
    truth = {t: T for t, T in zip(run.agent.t_ns, run.agent.truth, strict=True) if T is not None}
    poses = {int(mapper.map.keyframes.t_ns[mapper.map.rows[k]]): T for k, T in keyframe_poses(mapper).items()}
    known = sorted(poses.keys() & truth.keys())
    ours = np.array([poses[t][:3, 3] for t in known]).reshape(-1, 3)
    theirs = np.array([(truth[t] @ T_b_c)[:3, 3] for t in known]).reshape(-1, 3)
    T_true_w = metrics.umeyama(ours, theirs, with_scale=False)[0]
    error = ours @ T_true_w[:3, :3].T + T_true_w[:3, 3] - theirs
    rmse = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return FlownGrid(run, read_grid(folder / "grid.yaml"), T_true_w, rmse)


def picture_path(bench: Bench, name: str) -> Path:
    """Where a picture of a flight's grid is written."""
    return bench.folder / "grids" / f"{name.replace(', ', '_').replace(' ', '_')}.png"
