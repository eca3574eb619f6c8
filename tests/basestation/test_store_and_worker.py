"""What a base keeps for its next start, and the process that does its long work."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.flight_log import fingerprint
from kiteline_basestation.grid import GridConfig
from kiteline_basestation.jobs import GridInputs, Job, JobDone, run_job
from kiteline_basestation.store import Codes, pack, unpack
from kiteline_basestation.worker import Worker
from kiteline_codec.schema import Key, WireError
from kiteline_core.ids import AgentId

keys = st.builds(Key, st.integers(0, 255), st.integers(0, 2**62), st.integers(0, 65535))
values = st.dictionaries(keys, st.binary(max_size=30), max_size=4)


@given(st.dictionaries(st.integers(0, 63).map(AgentId), st.builds(Codes, values, values), max_size=3))
def test_a_store_gives_back_what_it_was_given(agents: dict[AgentId, Codes]) -> None:
    assert unpack(pack(agents)) == agents


@given(st.binary(max_size=80))
def test_any_other_bytes_are_refused(noise: bytes) -> None:
    with pytest.raises(WireError):
        unpack(noise)


def test_a_flipped_bit_is_found() -> None:
    content = bytearray(pack({AgentId(1): Codes({Key(3, 5): b"head"}, {})}))
    content[12] ^= 1
    with pytest.raises(WireError, match="damaged"):
        unpack(bytes(content))


def grid_job(number: int) -> Job:
    random = np.random.default_rng(number)
    points = np.column_stack([random.uniform(1.0, 4.0, (200, 2)), random.uniform(-1.0, 0.5, 200)])
    pairs = np.column_stack([np.zeros(200, np.int64), np.arange(200)])
    return Job(number, "grid", GridInputs(GridConfig(), np.zeros((1, 3)), points, pairs))


def collected(worker: Worker, number: int) -> list[JobDone]:
    done: list[JobDone] = []
    deadline_s = time.monotonic() + 60.0
    while len(done) < number:
        assert time.monotonic() < deadline_s
        done += worker.done(0)
        time.sleep(0.005)
    return done


def test_a_worker_gives_the_results_in_order_and_survives_being_killed() -> None:
    worker = Worker()
    try:
        worker.add([grid_job(1), grid_job(2)], 0)
        assert not worker.idle
        done = collected(worker, 2)
        assert [d.id for d in done] == [1, 2]
        assert [fingerprint(d) for d in done] == [fingerprint(run_job(grid_job(n))) for n in (1, 2)]
        assert len(worker.cpu_ms["grid"]) == 2
        assert worker.idle
        worker._process.kill()
        worker._process.join()
        worker.add([grid_job(3)], 0)
        assert [d.id for d in collected(worker, 1)] == [3]
        assert worker.deaths == 1
    finally:
        worker.close()


def test_fingerprints_tell_results_apart() -> None:
    assert fingerprint(run_job(grid_job(1))) != fingerprint(run_job(grid_job(2)))
