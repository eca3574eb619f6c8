"""The agent's end of a lock-step flight: it waits for a base that compiles its kernels first."""

import time
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from kiteline_hw.links import zenoh_session
from kiteline_hw.lockstep.agent_end import AgentBarrier
from kiteline_hw.lockstep.zenoh_lockstep import LockstepServer
from tests.hw.processes import free_endpoint


class _NoParent:
    def send_event(self, event: str, **values: Any) -> None:
        raise AssertionError(f"{event} {values}")


def test_an_agent_waits_minutes_for_a_base_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint()
    open_zenoh, passed_s, servers = zenoh.open, [0.0], []

    def refused_once(config: zenoh.Config) -> zenoh.Session:
        if not passed_s[0]:
            passed_s[0] = 120.0
            monkeypatch.setattr(zenoh, "open", open_zenoh)
            servers.append(LockstepServer(endpoint))
            raise zenoh.ZError("nobody listens")
        return open_zenoh(config)

    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + passed_s[0], sleep=lambda _: None)
    monkeypatch.setattr(zenoh_session, "time", clock)
    monkeypatch.setattr(zenoh, "open", refused_once)
    barrier = AgentBarrier(endpoint, 3, _NoParent())  # type: ignore[arg-type]
    assert not barrier.lost
    barrier.close()
    servers[0].close()
