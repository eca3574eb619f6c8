"""Read a kiteline log into numpy arrays: images, inertial samples and live poses.

python examples/read_log.py out/agent0/log.mcap
"""

import sys

import numpy as np

from kiteline_core.errors import KitelineError
from kiteline_core.frame import Frame, ImuBatch
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.sources.open import open_source


def main(path: str) -> None:
    """Print the shapes of what a log holds."""
    items = list(open_source(f"mcap:{path}"))
    frames = [item for item in items if isinstance(item, Frame)]
    images = np.stack([frame.left for frame in frames])
    print(f"left images    {images.shape} {images.dtype}, t_ns {frames[0].t_ns} to {frames[-1].t_ns}")

    batches = [item for item in items if isinstance(item, ImuBatch)]
    gyro = np.concatenate([np.zeros((0, 3)), *(batch.gyro for batch in batches)])  # rad/s
    accel = np.concatenate([np.zeros((0, 3)), *(batch.accel for batch in batches)])  # m/s^2
    print(f"gyro, accel    {gyro.shape}, {accel.shape}")

    with LogReader(path) as log:  # every other topic: `kiteline log info` lists them
        poses = [message.pose() for message in log.messages(["/odometry"])]  # T_o_b
    T_o_b = np.array(poses).reshape(-1, 4, 4)
    print(f"odometry       {T_o_b.shape}, path {np.linalg.norm(np.diff(T_o_b[:, :3, 3], axis=0), axis=1).sum():.2f} m")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        main(sys.argv[1])
    except KitelineError as error:
        sys.exit(str(error))
