"""Sets of byte positions as sorted, disjoint, half-open ranges. Immutable; most values have one range or none."""

Ranges = tuple[tuple[int, int], ...]

NONE: Ranges = ()


def add(ranges: Ranges, start: int, stop: int) -> Ranges:
    """The union with [start, stop); ranges that touch are joined."""
    if start >= stop:
        return ranges
    out = []
    for a, b in ranges:
        if b < start or a > stop:
            out.append((a, b))
        else:
            start, stop = min(a, start), max(b, stop)
    out.append((start, stop))
    return tuple(sorted(out))


def cut(ranges: Ranges, start: int, stop: int) -> Ranges:
    """The difference to [start, stop)."""
    if start >= stop:
        return ranges
    out = []
    for a, b in ranges:
        if a < min(b, start):
            out.append((a, min(b, start)))
        if max(a, stop) < b:
            out.append((max(a, stop), b))
    return tuple(out)
