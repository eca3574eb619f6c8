"""What a base says of itself: each thing that is wrong is named while it is, and imported agents are not in contact."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.jobs import Job, JobDone, set_aside
from kiteline_basestation.runtime import base_runtime
from kiteline_basestation.runtime.base_runtime import BaseRuntime
from kiteline_basestation.runtime.options import BaseOptions
from kiteline_basestation.station import Import, Station
from kiteline_basestation.store import keeper as keeper_module
from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.store import Batch, Store
from kiteline_basestation.web.messages import status
from kiteline_basestation.web.snapshot import take_numbers
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import messages
from kiteline_codec.sync.config import SyncConfig

S = 1_000_000_000
MakeFlight = Callable[..., Any]


@pytest.fixture
def make_base(monkeypatch: pytest.MonkeyPatch) -> Callable[..., BaseRuntime]:
    """Makes a base without loops, which needs no vocabulary, from options."""
    monkeypatch.setattr(base_runtime, "load_vocabulary", lambda: None)

    def made(**options: Any) -> BaseRuntime:
        return BaseRuntime(BaseOptions(**options), lambda _: CodedChannel(SyncConfig(), 1))

    return made


def test_nothing_is_wrong_with_a_base_that_writes_its_log_and_its_store(
    make_base: Callable[..., BaseRuntime], tmp_path: Path
) -> None:
    base = make_base(folder=str(tmp_path / "log"), store=str(tmp_path / "maps"), session=4)
    base.restore_maps(0)
    base.step({}, (), 0)
    state = base.state()
    assert state["troubles"] == [] and state["store"]["folder"] == str(tmp_path / "maps")
    assert (state["link"], state["session"]) == ("none", 4) and state["memory_mib"] > 10
    base.close()


def test_a_log_that_cannot_be_made_and_one_that_loses_messages_are_named(
    make_base: Callable[..., BaseRuntime], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("no folder")
    without = make_base(folder=str(tmp_path / "file"), log_optional=True)
    assert without.state()["troubles"] == ["log: there is none of this start"]
    assert make_base(folder=str(tmp_path), log_name="").state()["troubles"] == []  # nobody asked for one
    base = make_base(folder=str(tmp_path / "log"))
    base._log.why = os.strerror(errno.ENOSPC)
    assert base.state()["troubles"] == ["log: messages are lost: No space left on device"]
    base.close()


def test_a_store_is_named_while_it_cannot_be_written(
    make_base: Callable[..., BaseRuntime], make_flight: MakeFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper_module, "_RETRY_S", 0.001)
    write, full = Store.write, True

    def sometimes(store: Store, batch: Batch) -> None:
        if full:
            raise StoreError("the disk is full")
        write(store, batch)

    monkeypatch.setattr(Store, "write", sometimes)
    base = make_base(folder="", log_name="", store=str(tmp_path))
    base.restore_maps(0)
    flight = make_flight(keyframes=4, turns=0.1)
    base._imports = [imported(flight)]
    base.step({}, (), 0)
    base.step({}, (), keeper_module.WRITE_NS)
    assert base.keeper is not None
    for _ in range(10_000):
        if base.keeper.fault:
            break
        base.keeper._closing.wait(0.001)
    assert base.state()["troubles"] == [f"store {tmp_path}: not written: the disk is full"]
    assert not base.state()["store"]["up_to_date"]
    full = False
    assert base.close()
    assert base.state()["troubles"] == []


def test_a_failed_job_is_named_until_the_next_of_its_kind_succeeds(
    make_base: Callable[..., BaseRuntime], tmp_path: Path
) -> None:
    base = make_base(folder="", log_name="")
    base.step({}, [set_aside(Job(7, "scan", None), "ValueError: no image"), JobDone(8, "bundle", None, 0)], 0)
    expected = "job scan: the last one failed, and its part of the map stays as it was: ValueError: no image"
    assert base.state()["troubles"] == [expected]
    base.step({}, [JobDone(9, "bundle", None, 0)], S)
    assert base.state()["troubles"] == [expected], "of another kind"
    base.step({}, [JobDone(10, "scan", None, 0)], 2 * S)
    assert base.state()["troubles"] == [] and base.station.mapper.jobs_failed == 1


def imported(flight: Any) -> Import:
    """A flight's records as the log of its agent gives them."""
    return Import(flight.agent, tuple((messages.key(r), messages.encode(r)) for r in flight.all_records()))


def test_an_imported_agent_was_never_in_contact(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=4, turns=0.1)
    agent = CodedChannel(SyncConfig(), 1)
    station = Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1))

    def link(now_ns: int) -> str:
        (shown,) = status(take_numbers(station, now_ns, 0))["agents"]
        return str(shown["link"])

    station.step({}, (), S, [imported(flight)])
    assert link(S) == "never" and len(station.mapper.map) == 4
    for record in make_flight(keyframes=6, turns=0.1).all_records():
        agent.put(record)
    for now_ns in (2 * S, 2 * S + S // 10):  # the first packets agree on the session
        for _, packets in station.step({flight.agent: agent.poll(now_ns)}, (), now_ns).packets:
            agent.receive(packets, now_ns)
    assert link(now_ns) == "live"
