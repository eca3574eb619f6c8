"""A pose as a line of text in the TUM format: `t x y z qx qy qz qw`, seconds and metres.

Stamps are written from integer nanoseconds, so that no digit of a stamp depends on floating point.
"""

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_NS_PER_S = 1_000_000_000


def stamp(t_ns: int) -> str:
    """Seconds with nine decimals of a time in ns."""
    whole, rest = divmod(abs(t_ns), _NS_PER_S)
    return f"{'-' if t_ns < 0 else ''}{whole}.{rest:09d}"


def line(t_ns: int, T_a_b: F64) -> str:
    """One line, newline included, of a pose (4,4)."""
    w, x, y, z = se3.quaternion_numbers(T_a_b[:3, :3])
    p = T_a_b[:3, 3].tolist()
    return f"{stamp(t_ns)} {p[0]:.9f} {p[1]:.9f} {p[2]:.9f} {x:.9f} {y:.9f} {z:.9f} {w:.9f}\n"
