"""Measured values to integers and back. Each pair is idempotent: encoding a decoded value gives the same integer.

Decoding uses only +, -, *, / and the square root of IEEE arithmetic, so every machine gets the same bits.
"""

from math import frexp, ldexp, sqrt

import numpy as np

from kiteline_codec.coding import quantise_kernels as kernels
from kiteline_core.arrays import F32, F64, I64
from kiteline_core.geometry import se3

PIXEL_STEPS = 16  # per px: error <= 1/32 px, below a corner's measurement error
PIXEL_ORIGIN = -64.0  # px: refined keypoints may lie a little outside the image
PIXEL_CODES = 1 << 16  # up to 4032 px

OFFSET_STEPS = 32  # per px: error <= 1/64 px, finer than keypoints since the base averages many
OFFSET_CODES = 1 << 12  # +-128 px: a larger offset is another point

CALIBRATION_STEPS = 1024  # per px: a tenth of the estimate's error
CALIBRATION_CODES = 1 << 14  # +-8 px; real ones are below two pixels, half a pixel in the middle
CALIBRATION_SIGMA_CODES = 1 << 13  # up to 8 px

DEPTH_SCALE = 2.0**-7  # 1/m: nearly linear below (farther than 128 m), nearly logarithmic above
DEPTH_MANTISSA = 1 << 10  # steps an octave: error <= 2^-11 (x + 2^-7) 1/m
DEPTH_CODES = 13 * DEPTH_MANTISSA  # up to 64 1/m, which is 16 mm

TRANSLATION_STEPS = 10_000  # per m: error <= 0.05 mm an axis
TRANSLATION_CODES = 1 << 40  # +-1.1e8 m

ROTATION_STEPS = 1 << 19  # per unit of the modified Rodrigues parameters: error <= 2 sqrt(3) / 2^19 = 6.7e-6 rad
_ROTATION_LIMIT = (1 << 38) - (1 << 12)  # squared length kept below that of half a turn, where two codes would meet
COARSE_TRANSLATION_STEPS = 256  # per m: error <= 2 mm an axis, less than half of what a range's is
COARSE_TRANSLATION_CODES = 1 << 18  # +-1024 m
COARSE_ROTATION_STEPS = 1 << 10  # error <= 3.4e-3 rad, 1.4e-3 in the mean: 7 mm at 5 m
_COARSE_ROTATION_LIMIT = (1 << 20) - 1

MIN_SCALE, MAX_SCALE = 2.0**-20, 2.0**20  # of one unit of length over another; an IEEE single: error <= 6e-8 of it

DEVIATION_CODES = 1 << 7  # of a relative standard deviation: 8.6e-6 to 0.47, error <= 6 percent
DIRECTION_STEPS = 8191  # per unit of the stereographic coordinates: error <= 2 sqrt(2) / 2 / 8191 = 1.8e-4 rad

RANGE_SCALE = 2.0  # m: nearly linear below, nearly logarithmic above
RANGE_MANTISSA = 1 << 7  # steps an octave: error <= 2^-8 (x + 2) m: 8 mm near the camera, 2 cm at 3 m
RANGE_CODES = 7 * RANGE_MANTISSA  # up to 253 m


def pixel_codes(uv: F32) -> I64:
    """Codes (2, n) of pixels (n, 2). Raises ValueError outside [-64, 4031.9] px."""
    codes = np.rint((np.asarray(uv, np.float64).T - PIXEL_ORIGIN) * PIXEL_STEPS)
    return _checked(codes, 0, PIXEL_CODES, "pixel")


def pixels(codes: I64) -> F32:
    """Pixels (n, 2) of codes (2, n)."""
    return np.ascontiguousarray((codes.T / PIXEL_STEPS + PIXEL_ORIGIN).astype(np.float32))


def offset_codes(offset: F32) -> I64:
    """Codes (2, n) of pixel offsets (n, 2), clipped to +-128 px. Raises ValueError where not a number."""
    codes = np.rint(np.asarray(offset, np.float64).T * OFFSET_STEPS)
    return _checked(np.clip(codes, 1 - OFFSET_CODES, OFFSET_CODES - 1), 1 - OFFSET_CODES, OFFSET_CODES, "offset")


def offsets(codes: I64) -> F32:
    """Pixel offsets (n, 2) of codes (2, n)."""
    return np.ascontiguousarray((codes.T / OFFSET_STEPS).astype(np.float32))


def inverse_depth_codes(inv_depth: F32) -> I64:
    """Codes (n,) of inverse depths (n,) in 1/m: a small float of x + DEPTH_SCALE. 0 means unknown (x <= 0 or NaN).

    Positive values below the least code take the least one: far, but known.
    """
    x = np.ascontiguousarray(inv_depth, np.float64)
    codes = np.empty(len(x), np.int64)
    kernels.inverse_depth_codes(x, DEPTH_SCALE, DEPTH_MANTISSA, DEPTH_CODES, codes)
    return codes


def inverse_depths(codes: I64) -> F32:
    """Inverse depths (n,) in 1/m of codes (n,)."""
    inv_depth = np.empty(len(codes), np.float32)
    kernels.inverse_depths(np.ascontiguousarray(codes, np.int64), DEPTH_SCALE, DEPTH_MANTISSA, inv_depth)
    return inv_depth


def pose_codes(pose: F64) -> tuple[int, ...]:
    """Six integers of a rigid motion (4,4): translation, then modified Rodrigues parameters q_v / (1 + q_w).

    The latter are a stereographic map of the rotation: finite for every rotation, one-to-one below half a turn, and an
    error of d in them turns the result by at most 4 d (J. Schaub, M. Junkins, "Stereographic orientation parameters
    for attitude dynamics", 1996). Raises ValueError when the matrix is no rigid motion or too far out.
    """
    return _motion_codes(pose, TRANSLATION_STEPS, TRANSLATION_CODES, ROTATION_STEPS, _ROTATION_LIMIT)


def coarse_pose_codes(pose: F64) -> tuple[int, ...]:
    """The same in larger steps. Raises ValueError when the matrix is no rigid motion or too far out."""
    return _motion_codes(
        pose, COARSE_TRANSLATION_STEPS, COARSE_TRANSLATION_CODES, COARSE_ROTATION_STEPS, _COARSE_ROTATION_LIMIT
    )


def _motion_codes(pose: F64, steps: int, most: int, rotation_steps: int, rotation_limit: int) -> tuple[int, ...]:
    if not (np.isfinite(pose).all() and se3.is_rotation(pose[:3, :3], 1e-3)):
        raise ValueError(f"a rigid motion (4,4) is expected, found\n{pose}")
    translation = [round(x * steps) for x in pose[:3, 3].tolist()]
    if max(map(abs, translation)) >= most:
        raise ValueError(f"a translation within +-{most / steps:g} m is expected, found {pose[:3, 3]}")
    w, x, y, z = se3.quaternion_numbers(pose[:3, :3])
    rotated = [round(c / (1.0 + w) * rotation_steps) for c in (x, y, z)]
    while sum(c * c for c in rotated) > rotation_limit:
        i = max(range(3), key=lambda k: abs(rotated[k]))
        rotated[i] -= 1 if rotated[i] > 0 else -1
    return (*translation, *rotated)


def pose(codes: tuple[int, ...]) -> F64:
    """The rigid motion (4,4) of six integers. Raises ValueError when the rotation's are too large."""
    return _motion(codes, TRANSLATION_STEPS, ROTATION_STEPS, _ROTATION_LIMIT)


def coarse_pose(codes: tuple[int, ...]) -> F64:
    """The same of six integers of `coarse_pose_codes`."""
    return _motion(codes, COARSE_TRANSLATION_STEPS, COARSE_ROTATION_STEPS, _COARSE_ROTATION_LIMIT)


def _motion(codes: tuple[int, ...], steps: int, rotation_steps: int, rotation_limit: int) -> F64:
    x, y, z = (c / rotation_steps for c in codes[3:])
    if sum(c * c for c in codes[3:]) > rotation_limit:
        raise ValueError("a rotation of less than half a turn is expected")
    s = x * x + y * y + z * z
    n = 1.0 + s
    w, x, y, z = (1.0 - s) / n, 2.0 * x / n, 2.0 * y / n, 2.0 * z / n
    norm = sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    tx, ty, tz = (c / steps for c in codes[:3])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), tx],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), ty],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), tz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def direction_codes(direction: F64) -> tuple[int, int, int]:
    """Three integers of a unit vector (3,): 1 where its y is positive, else 0; x and z over 1 + |y|.

    The latter are a stereographic map of the half of the sphere. Raises ValueError for another length.
    """
    x, y, z = (float(c) for c in direction)
    if not abs(x * x + y * y + z * z - 1.0) < 1e-3:
        raise ValueError(f"a unit vector is expected, found {direction}")
    mapped = [round(c / (1.0 + abs(y)) * DIRECTION_STEPS) for c in (x, z)]
    while mapped[0] ** 2 + mapped[1] ** 2 >= DIRECTION_STEPS**2:  # where the halves meet: each keeps codes of its own
        i = int(abs(mapped[1]) > abs(mapped[0]))
        mapped[i] -= 1 if mapped[i] > 0 else -1
    return int(y > 0.0), mapped[0], mapped[1]


def direction(half: int, a: int, b: int) -> F64:
    """The unit vector (3,) of three integers. Raises ValueError when they are too large."""
    if a * a + b * b >= DIRECTION_STEPS**2:
        raise ValueError("a direction within half of the sphere is expected")
    p, q = a / DIRECTION_STEPS, b / DIRECTION_STEPS
    s = p * p + q * q
    y = (1.0 - s) / (1.0 + s)
    return np.array([2.0 * p / (1.0 + s), y if half else -y, 2.0 * q / (1.0 + s)])


def range_codes(ranges_m: F64) -> I64:
    """Codes (n,) of ranges (n,) in m: a small float of r + RANGE_SCALE, clipped to the largest. 0 means none (r <= 0).

    Positive ranges below the least code take the least one. Raises ValueError where not a number.
    """
    r = np.asarray(ranges_m, np.float64)
    if np.isnan(r).any():
        raise ValueError("a range is expected, found NaN")
    mantissa, exponent = np.frexp(np.minimum(r, 1e6) / RANGE_SCALE + 1.0)  # mantissa in [1/2, 1)
    codes = (exponent.astype(np.int64) - 1) * RANGE_MANTISSA + np.rint((2.0 * mantissa - 1.0) * RANGE_MANTISSA)
    return np.where(r > 0.0, np.clip(codes, 1, RANGE_CODES - 1), 0).astype(np.int64)


def ranges(codes: I64) -> F64:
    """Ranges (n,) in m of codes (n,); 0 for 0."""
    octave, step = np.divmod(np.asarray(codes, np.int64), RANGE_MANTISSA)
    return np.asarray(RANGE_SCALE * (np.ldexp(1.0 + step / RANGE_MANTISSA, octave) - 1.0))


def _checked(codes: F64, low: int, high: int, what: str) -> I64:
    if codes.size and not (codes.min() >= low and codes.max() < high):  # NaN fails both
        raise ValueError(
            f"a {what} does not fit its code: found {codes.min()}..{codes.max()}, expected {low}..{high - 1}"
        )
    return codes.astype(np.int64)


def deviation_code(sigma: float) -> int:
    """Code of a relative standard deviation, clipped: three bits of mantissa, four of exponent. 0: not told (<= 0)."""
    if sigma <= 0.0:
        return 0
    mantissa, exponent = frexp(sigma)  # sigma = mantissa * 2^exponent, 0.5 <= mantissa < 1
    code = 8 * (exponent + 16) + round(16.0 * mantissa) - 8
    return min(max(code, 1), DEVIATION_CODES - 1)


def deviation(code: int) -> float:
    """The relative standard deviation of a code; 0 for 0."""
    return ldexp(8 + (code & 7), (code >> 3) - 20) if code else 0.0
