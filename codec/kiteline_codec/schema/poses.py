"""Poses, directions, scales and standard deviations in codes."""

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_core.arrays import F64


def write_pose(out: Writer, pose: F64) -> None:
    """Append a rigid motion (4,4). Raises ValueError."""
    for code in quantise.pose_codes(pose):
        out.signed(code)


def read_pose(source: Reader) -> F64:
    """A rigid motion (4,4). Raises WireError."""
    translation = [source.signed(quantise.TRANSLATION_CODES - 1) for _ in range(3)]
    rotation = [source.signed(quantise.ROTATION_STEPS) for _ in range(3)]
    try:
        return quantise.pose((*translation, *rotation))
    except ValueError as e:
        raise WireError(str(e)) from None


def write_coarse_pose(out: Writer, pose: F64) -> None:
    """Append a rigid motion (4,4) in the steps of scans. Raises ValueError."""
    for code in quantise.coarse_pose_codes(pose):
        out.signed(code)


def read_coarse_pose(source: Reader) -> F64:
    """A rigid motion (4,4) in the steps of scans. Raises WireError."""
    translation = [source.signed(quantise.COARSE_TRANSLATION_CODES - 1) for _ in range(3)]
    rotation = [source.signed(quantise.COARSE_ROTATION_STEPS) for _ in range(3)]
    try:
        return quantise.coarse_pose((*translation, *rotation))
    except ValueError as e:
        raise WireError(str(e)) from None


def write_direction(out: Writer, direction: F64) -> None:
    """Append a unit vector (3,). Raises ValueError."""
    half, a, b = quantise.direction_codes(direction)
    out.u8(half)
    out.signed(a)
    out.signed(b)


def read_direction(source: Reader) -> F64:
    """A unit vector (3,). Raises WireError."""
    half = source.u8()
    if half > 1:
        raise WireError(f"a half is 0 or 1, found {half}")
    try:
        return quantise.direction(half, *(source.signed(quantise.DIRECTION_STEPS) for _ in range(2)))
    except ValueError as e:
        raise WireError(str(e)) from None


def write_scale(out: Writer, scale: float) -> None:
    """Append the ratio of two units of length. Raises ValueError."""
    if not quantise.MIN_SCALE <= scale <= quantise.MAX_SCALE:
        raise ValueError(f"found scale {scale}: expected a rigid motion, or a scale of 2^-20 to 2^20")
    out.f32(scale)


def read_scale(source: Reader) -> float:
    """The ratio of two units of length. Raises WireError."""
    scale = source.f32()
    if not quantise.MIN_SCALE <= scale <= quantise.MAX_SCALE:
        raise WireError(f"found scale {scale}: expected 2^-20 to 2^20")
    return scale


def write_deviation(out: Writer, sigma: float) -> None:
    """Append a standard deviation. Raises ValueError where none is known."""
    code = quantise.deviation_code(sigma)
    if code == 0:
        raise ValueError(f"found a deviation of {sigma}, expected one above 0")
    out.u8(code)


def read_deviation(source: Reader) -> float:
    """A standard deviation above 0. Raises WireError."""
    code = source.u8()
    if not 0 < code < quantise.DEVIATION_CODES:
        raise WireError(f"found the code {code} of a deviation, expected 1..{quantise.DEVIATION_CODES - 1}")
    return quantise.deviation(code)
