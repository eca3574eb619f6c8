"""The calibrated stereo rig of a simulated vehicle (EuRoC's), and the true one that differs a little."""

from dataclasses import replace

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens

# Rotations of the left and right camera in the body frame (x up, z forward), and lens coefficients left and right.
_R_B_C = np.array([[0.0149, -0.9999, 0.0041], [0.9996, 0.0150, 0.0257], [-0.0258, 0.0038, 0.9997]])
_R_B_R = np.array([[0.0126, -0.9998, 0.0182], [0.9996, 0.0130, 0.0252], [-0.0254, 0.0179, 0.9995]])
WIDTH_PX, HEIGHT_PX, _FOCAL_PX = 752, 480, 458.2
_RADTAN = ((-0.2831, 0.0739, 1.9e-4, 1.8e-5), (-0.2839, 0.0746, -1.0e-4, -3.6e-5))
_EQUIDISTANT = ((-0.0036, 0.0012, -0.0013, 0.0002), (-0.0041, 0.0016, -0.0014, 0.0003))


def perturb(rig: CameraRig, rng: np.random.Generator, amount: float) -> CameraRig:
    """The true cameras for which `rig` is a good calibration: the error is about a tenth of a pixel."""

    def camera(c: CameraModel) -> CameraModel:
        e = amount * rng.standard_normal(4 + len(c.distortion))
        centre = 0.1 * c.width / 752  # px
        k = tuple(value * (1.0 + 1e-3 * error) for value, error in zip(c.distortion, e[4:], strict=True))
        fx, fy = c.fx * (1.0 + 2e-4 * e[0]), c.fy * (1.0 + 2e-4 * e[1])
        return replace(c, fx=fx, fy=fy, cx=c.cx + centre * e[2], cy=c.cy + centre * e[3], distortion=k)

    def moved(t: F64, angle_rad: float, shift_m: float) -> F64:
        e = amount * rng.standard_normal(6)
        return t @ se3.exp(np.concatenate([shift_m * e[:3], angle_rad * e[3:]]))

    left, T_b_c = camera(rig.left), moved(rig.T_b_c, 4e-4, 5e-4)
    if rig.right is None or rig.T_c_r is None:
        return replace(rig, left=left, T_b_c=T_b_c)
    return replace(rig, left=left, right=camera(rig.right), T_b_c=T_b_c, T_c_r=moved(rig.T_c_r, 1e-4, 1e-5))


def make_rig(
    lens: Lens = Lens.RADTAN, stereo: bool = True, depth: bool = False, baseline_m: float = 0.11, scale: float = 1.0,
    size: tuple[int, int] = (WIDTH_PX, HEIGHT_PX), fov_deg: float = 0.0,
) -> CameraRig:  # fmt: skip
    """Cameras like EuRoC's: 752x480, body x up and z forward; `scale` shrinks images and focal lengths for tests.

    size: width and height in px before `scale`. fov_deg: angle of view along the width, by the focal length alone; 0:
    that of EuRoC's lens, whatever the size.
    """
    width, height = size
    zoom = width / WIDTH_PX  # of the focal length
    if fov_deg:
        half = np.radians(fov_deg) / 2
        zoom = width / 2 / float(half if lens is Lens.EQUIDISTANT else np.tan(half)) / _FOCAL_PX
    across, down = width / WIDTH_PX, height / HEIGHT_PX
    coefficients = {Lens.RADTAN: _RADTAN, Lens.EQUIDISTANT: _EQUIDISTANT, Lens.NONE: ((), ())}[lens]

    def camera(fx: float, fy: float, cx: float, cy: float, k: tuple[float, ...]) -> CameraModel:
        focal = zoom * scale
        centre = across * cx * scale, down * cy * scale
        return CameraModel(round(width * scale), round(height * scale), fx * focal, fy * focal, *centre, lens, k)

    left = camera(_FOCAL_PX, 457.0, 367.0, 248.5, coefficients[0])
    right = camera(457.4, 456.2, 379.5, 254.8, coefficients[1])
    T_b_c = se3.orthonormalise(se3.from_rt(_R_B_C, np.array([-0.0216, -0.0647, 0.0098])))
    T_b_r = se3.orthonormalise(se3.from_rt(_R_B_R, np.array([-0.0198, 0.0454, 0.0079])))
    T_c_r = se3.inverse(T_b_c) @ T_b_r
    T_c_r[:3, 3] *= baseline_m / np.linalg.norm(T_c_r[:3, 3])
    return CameraRig(left, right if stereo else None, T_b_c, T_c_r if stereo else None, depth, True)
