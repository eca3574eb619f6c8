"""Checks of calibration values that all readers share. All raise SourceError; `where` names the file and entry."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_core.wording import counted
from kiteline_hw.ports import SourceError

LONGEST_READOUT_S = 0.2  # no video camera is slower
_FAR_FROM_MIDDLE = 0.25  # of a side: centres of lenses and of cropped images lie nearer to the middle

_UNDISTORTED = ("", "none", "pinhole", "rectified", "undistorted")
_EQUIDISTANT = ("equidistant", "fisheye", "kannalabrandt", "kannalabrandt4", "kannalabrandt8", "kb4")
_RADTAN = ("radialtangential", "radtan", "plumbbob", "rationalpolynomial", "opencv", "browncornrady", "brown")


def checked_rigid(values: F64, where: str) -> F64:
    """A rigid motion (4,4), its rotation orthonormalised."""
    r = values[:3, :3]
    # far out numbers would overflow in the product
    finite = bool(np.isfinite(values).all()) and bool((np.abs(r) < 2.0).all())
    if not finite or not np.allclose(r @ r.T, np.eye(3), atol=1e-3) or np.linalg.det(r) < 0:
        raise SourceError(f"{where} is no rigid motion: expected a 4x4 matrix with an orthonormal rotation")
    if not np.allclose(values[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise SourceError(f"{where} is no rigid motion: its last row is {values[3].tolist()}: expected 0 0 0 1")
    return se3.orthonormalise(values)


def names_lens(model: str) -> bool:
    """True for the name of a distortion model, which has coefficients."""
    return _plain(model) not in _UNDISTORTED


def parse_lens(model: str, coefficients: list[float], where: str) -> tuple[Lens, tuple[float, ...]]:
    """The lens behind a distortion model's name, as data sets and ROS write it."""
    name = _plain(model)
    if not name and any(coefficients):
        raise SourceError(
            f"{where}: {counted(len(coefficients), 'coefficient')} of a lens whose distortion model is not named: "
            "expected radial-tangential or equidistant, or none with coefficients of 0; "
            "--calibration FILE takes another one"
        )
    if name in _UNDISTORTED or not any(coefficients):
        return (Lens.EQUIDISTANT, (0.0, 0.0, 0.0, 0.0)) if name in _EQUIDISTANT else (Lens.NONE, ())
    if name in _RADTAN:
        if len(coefficients) not in (4, 5, 8):
            raise SourceError(f"{where}: {model} has {counted(len(coefficients), 'coefficient')}: expected 4, 5 or 8")
        return Lens.RADTAN, tuple(coefficients)
    if name in _EQUIDISTANT:
        if len(coefficients) != 4:
            raise SourceError(f"{where}: {model} has {counted(len(coefficients), 'coefficient')}: expected 4")
        return Lens.EQUIDISTANT, tuple(coefficients)
    raise SourceError(f"{where}: lens model {model!r} is not known: expected radial-tangential or equidistant")


def _plain(model: str) -> str:
    return model.lower().replace("-", "").replace("_", "").replace(" ", "")


def checked_camera(camera: CameraModel, where: str) -> CameraModel:
    """The camera, if its intrinsics are usable."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    if not (np.isfinite(numbers).all() and camera.fx > 0 and camera.fy > 0 and camera.width > 0 and camera.height > 0):
        raise SourceError(
            f"{where}: no usable calibration (fx {camera.fx}, fy {camera.fy}, {camera.width}x{camera.height} px)"
        )
    return camera


def doubts(camera: CameraModel, name: str) -> list[str]:
    """Notes about intrinsics that can be used and are hardly right. name: of the camera."""
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if off < _FAR_FROM_MIDDLE:
        return []
    centre, size = f"({camera.cx:g}, {camera.cy:g}) px", f"{camera.width}x{camera.height} px"
    told = f"the centre of the {name} camera, {centre}, is far from the middle of {size}"
    return [f"calibration: {told}: are its intrinsics those of other images, or of another size?"]


def checked_readout(readout_s: float, where: str) -> float:
    """The read-out of a rolling shutter in s, 0 for a global one, below 0 for rows that are read from the bottom up."""
    if not abs(readout_s) < LONGEST_READOUT_S:
        raise SourceError(
            f"{where}: a read-out of {readout_s:g} s: expected readout_s or line_delay in s, 0 for a global shutter, "
            "below 0 if the image is turned upside down after it is read"
        )
    return readout_s


def checked_baseline(T_c_r: F64, where: str) -> F64:
    """T_c_r (4,4), if the distance between left and right camera is that of a stereo pair."""
    baseline_m = float(np.linalg.norm(T_c_r[:3, 3]))
    if not 1e-4 < baseline_m < 100.0:
        raise SourceError(
            f"{where}: the baseline between left and right camera is {baseline_m:g} m: expected the extrinsics of a "
            "stereo pair; with mono (--mono) the left camera alone can be used"
        )
    return T_c_r
