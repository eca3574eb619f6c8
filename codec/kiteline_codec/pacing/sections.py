"""A keyframe's keypoints in sections that are useful alone, best first, each short enough for one packet."""

from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema import CachedLandmarks, NewLandmarks, Observations, messages
from kiteline_core.arrays import F64, I64

SECTION_BYTES = 1000  # leaves room for headers and a live pose in a packet of 1200 bytes

_Section = TypeVar("_Section", NewLandmarks, Observations, CachedLandmarks)


def split(record: _Section, value: F64, section_bytes: int = SECTION_BYTES) -> list[_Section]:
    """Split a record (n rows) into parts 0, 1, … by falling value (n,); within a part the index increases.

    Codes are shortest if neighbouring indices lie near each other in the image, or, for observations, if the order of
    indices is that of landmark ids. Raises ValueError when a single row does not fit, or for values that have no code.
    """
    best, codes = np.argsort(-np.asarray(value), kind="stable"), record.COLUMNS.codes(record)
    parts: list[_Section] = []
    start, rows = 0, max(1, section_bytes // 32)
    may_grow = True
    while start < len(best):
        chosen = best[start : start + rows]
        chosen = chosen[np.argsort(record.index[chosen], kind="stable")]
        out = Writer()
        record.write_rows(out, codes, chosen)
        size = len(out)
        if size > section_bytes:
            if len(chosen) == 1:
                raise ValueError(f"one keypoint takes {size} bytes, expected at most {section_bytes}")
            may_grow = False
            rows = min(len(chosen) - 1, max(1, len(chosen) * (section_bytes - 8) // size))
            continue
        more = len(chosen) * section_bytes // size
        if may_grow and start + len(chosen) < len(best) and more > len(chosen) * 1.15:
            rows = max(len(chosen) + 1, int(0.95 * more))  # enough larger to be worth another try
            continue
        parts.append(take(record, chosen, len(parts)))
        messages.keep(parts[-1], out.bytes())
        start += len(chosen)
        may_grow = True
    return parts


def take(record: _Section, rows: I64, part: int | None = None) -> _Section:
    """Some rows of a record, as this part; None for its own."""
    names = (f.name for f in fields(record) if f.name not in ("keyframe", "part"))
    arrays = {name: getattr(record, name).take(rows, 0) for name in names}
    return replace(record, **arrays, part=record.part if part is None else part)
