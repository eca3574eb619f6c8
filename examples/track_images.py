"""Feed stereo images to an agent and print its poses.

    python examples/track_images.py FOLDER

FOLDER/left and FOLDER/right hold the images of a rectified stereo camera, named in order of time.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from kiteline_agent.embed import standalone_agent
from kiteline_agent.step import StepInput
from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import CameraModel, CameraRig

FOCAL_PX, BASELINE_M, RATE_HZ = 200.0, 0.1, 20.0  # put in the values of your camera


def main(folder: Path) -> None:
    """Track all images of a folder."""
    pairs = [[cv2.imread(str(folder / side / p.name), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")]
             for p in sorted((folder / "left").glob("*.png"))]  # fmt: skip
    if not pairs:
        sys.exit(f"{folder / 'left'} holds no PNG images")
    height, width = pairs[0][0].shape
    camera = CameraModel(width, height, FOCAL_PX, FOCAL_PX, (width - 1) / 2, (height - 1) / 2)
    T_left_right = np.eye(4)
    T_left_right[0, 3] = BASELINE_M
    agent = standalone_agent(CameraRig(camera, camera, T_b_c=np.eye(4), T_c_r=T_left_right, has_body=False))
    for i, (left, right) in enumerate(pairs):
        t_ns = round(i * 1e9 / RATE_HZ)
        estimate = agent.step(StepInput(Frame(t_ns, left, right)), t_ns).estimate
        if estimate is not None and estimate.tracked:
            x, y, z = estimate.T_o_b[:3, 3]  # in the odometry frame: forward, left, up, m
            print(f"{t_ns / 1e9:.3f} s  x {x:+.3f}  y {y:+.3f}  z {z:+.3f} m  quality {estimate.quality} %")


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
