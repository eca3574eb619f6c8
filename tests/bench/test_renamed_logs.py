"""Logs of an earlier version are copied under today's names."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_bench.system import renamed_logs
from kiteline_bench.system.renamed_logs import copy_renamed, renamed_config
from kiteline_core import config as configuration
from kiteline_hw.logs.mcap_log import LogReader, LogWriter

SPEC = {"agent": 0, "kill_at_s": -1.0}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    metadata = {"role": "base", "spec": json.dumps(SPEC), "config": configuration.describe(BaseConfig())}
    with LogWriter(path, metadata) as writer:
        for n in range(200):
            writer.json("/step", n, {"now_ns": n, "jobs": [[n, "old"]]})
            writer.blob("/agent0/packets/in", n, bytes([n]) * 700)
            writer.json("/job", n, {"id": n, "cost_ops": 0.1 * n, "result": "old"})
    return path


def test_without_rules_a_copy_holds_the_same_messages_in_the_same_order(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIELDS", "TOPICS", "JOB_KINDS"):
        monkeypatch.setattr(renamed_logs, name, {})
    for name in ("CONFIG", "SPEC"):
        monkeypatch.setattr(renamed_logs, name, {"agent": {}, "base": {}})
    copy_renamed(log, tmp_path / "new.mcap")
    with LogReader(log) as a, LogReader(tmp_path / "new.mcap") as b:
        assert a.metadata == b.metadata
        assert list(a.messages()) == list(b.messages())
        assert sum(b.topics.values()) == 600
        assert b.cut is None


def test_names_are_mapped_and_all_else_stays(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renamed_logs, "CONFIG", {"base": {"intake": "input", "cull.landmark_age": None}})
    monkeypatch.setattr(renamed_logs, "SPEC", {"base": {"kill_at_s": ("end_s", lambda v: None if v < 0 else v)}})
    monkeypatch.setattr(renamed_logs, "FIELDS", {"/job": {"cost_ops": "cost"}})
    monkeypatch.setattr(renamed_logs, "TOPICS", {"/packets/in": "/received"})
    monkeypatch.setattr(renamed_logs, "JOB_KINDS", {"old": "new"})
    log.with_name("log.job_values.json").write_text(json.dumps([f"result {n}" for n in range(200)]))
    copy_renamed(log, tmp_path / "new.mcap")
    with LogReader(log) as a, LogReader(tmp_path / "new.mcap") as b:
        old, new = list(a.messages()), list(b.messages())
        old_config, new_config = (tomllib.loads(reader.metadata["config"]) for reader in (a, b))
        assert json.loads(b.metadata["spec"]) == {"agent": 0, "end_s": None}
    assert len(old) == len(new) == 600
    assert new[0].json() == {"now_ns": 0, "jobs": [[0, "new"]]}
    assert new[1].topic == "/agent0/received"
    assert [m.data for m in new[1::3]] == [m.data for m in old[1::3]]
    assert new[5].json() == {"id": 1, "cost": 0.1, "result": "result 1"}
    old_config["input"] = old_config.pop("intake")
    del old_config["cull"]["landmark_age"]
    assert new_config == old_config


def test_the_longest_name_counts_and_values_keep_every_bit() -> None:
    text = '[a]\nx = 0.1\ny = [1, 2.5e-05]\nz = "q\\"\\\\"\n\n[a.b]\ngood = true\nw = 1e-300\n'
    assert tomllib.loads(renamed_config(text, {})) == tomllib.loads(text)
    new = tomllib.loads(renamed_config(text, {"a": "c", "a.b": "d.e", "a.x": ("c.half", lambda v: v / 2)}))
    assert new == {
        "c": {"half": 0.05, "y": [1, 2.5e-05], "z": 'q"\\'},
        "d": {"e": {"good": True, "w": 1e-300}},
    }
