"""A constant error of all disparities is found from motion, and taken off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, DisparityConfig
from kiteline_basestation.disparity import _intercept, estimate
from kiteline_basestation.jobs import JobDone, run_job
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.schema import Births, Camera, Record, Sightings
from kiteline_core.ids import AgentId

MakeFlight = Callable[..., Any]
BF = 420.0 * 0.11


def shifted(record: Record, offset_px: float) -> Record:
    if isinstance(record, Births | Sightings):
        deep = record.inv_depth > 0
        return replace(record, inv_depth=np.where(deep, record.inv_depth + offset_px / BF, 0.0).astype(np.float32))
    return record


@pytest.mark.parametrize("offset_px", [0.0, 0.12, -0.1])
def test_an_offset_is_found_and_the_scale_comes_right(
    make_flight: MakeFlight, words: Any, ring: Any, offset_px: float
) -> None:  # fmt: skip
    flight = make_flight(keyframes=60, turns=0.3, scene=ring, drift_m=0.001, noise_px=0.2)
    mapper = Mapper(BaseConfig(), words)
    done: tuple[JobDone, ...] = ()
    for n in range(90):
        records = flight.records[n] if n < len(flight.records) else []
        first = [Camera(flight.agent, flight.camera)] if n == 0 else []
        given = tuple(first) + tuple(shifted(r, offset_px) for r in records)
        output = mapper.step(MapperInput(((flight.agent, given),), done), n * 250_000_000)
        done = tuple(run_job(job) for job in output.jobs)
    applied = mapper.map.disparity_offset_px.get(AgentId(0), 0.0)
    assert abs(applied - offset_px) < 0.045
    left = estimate(mapper.map, AgentId(0), applied, DisparityConfig(min_points=100))
    assert left is not None and abs(left.value_px) < 0.07


def test_the_line_is_found_among_outliers() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(3, 20, 800)
    y = 0.07 - 0.006 * x + rng.normal(0, 0.05, 800)
    y[:80] += rng.uniform(1, 4, 80)
    found = _intercept(x, y)
    assert abs(found.value_px - 0.07) < 4 * found.sigma_px + 0.01
    assert found.sigma_px < 0.01
