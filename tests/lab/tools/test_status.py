"""`kiteline status`: a base's answer as lines of text, and its exit status."""

import json
import threading
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.grid.grid_view import GridView
from kiteline_basestation.web import messages
from kiteline_basestation.web.snapshot import AgentStatus, PageSnapshot
from kiteline_cli.main import main as kiteline
from kiteline_core.ids import AgentId
from kiteline_hw.ports import LinkError
from kiteline_lab.tools import maps, status

S = 1_000_000_000


def report(**changes: Any) -> dict[str, Any]:
    """What a base with two agents answers, after 7500 s."""
    agents = (
        AgentStatus(AgentId(0), 7499 * S, 80, np.eye(4), np.zeros((3, 3)), 3, 40, 1, 120_000, 5000),
        AgentStatus(AgentId(7), 7300 * S, 90, None, np.zeros((0, 3)), 2, 30, 1, 1000, 500),
    )
    page = PageSnapshot(7500 * S, 0, agents, np.zeros((0, 3)), np.zeros(0, np.uint8), GridView(0.05), 7, {"loops": 2})
    base = {"link": "zenoh:tcp/0.0.0.0:7447", "session": 5, "memory_mib": 267.4, "troubles": []}
    return {**messages.status(page), **base, "store": {"folder": "maps", "up_to_date": True}, **changes}


def test_lines_tell_agents_map_and_store() -> None:
    base, totals, head, first, second = status.lines(report())
    assert base == "base on zenoh:tcp/0.0.0.0:7447, session 5, up 2 h 05 min; store maps"
    assert totals.startswith("keyframes 5, landmarks 70, loops 2, merges 0, mapped 0.0 m²") and "267 MiB" in totals
    assert head.split()[:3] == ["agent", "link", "quality"]
    assert first.split() == ["0", "live", "80", "0.00", "0.00", "0.00", "3", "40", "1", "120", "5", "-"]
    own = report()
    own["agents"][0]["unit"] = "own"
    assert status.lines(own)[3].split()[3:8] == ["0.00", "0.00", "0.00", "(own", "unit)"]
    assert second.split()[:7] == ["7", "lost,", "3", "min", "-", "not", "placed"]  # what was long ago says nothing


def test_what_is_wrong_has_a_line_each() -> None:
    told = status.lines(report(troubles=["store maps: not written: disk full"], store=None, agents=[]))
    assert told[0].endswith("the map is not saved")
    assert told[2:] == ["no agent yet", "wrong: store maps: not written: disk full"]
    assert status.lines(report(store={"folder": "maps", "up_to_date": False}))[0].endswith("store maps not up to date")


def test_rates_are_of_the_time_between_two_reports_of_one_start() -> None:
    before, now = report(), report(up_s=7502.0)
    now["agents"] = deepcopy(before["agents"])
    now["agents"][0]["bytes_up"] += 16_000
    assert status.lines(now, before)[3].endswith("8.0, 0.0")
    assert status.lines(now, {**before, "session": 4})[3].endswith("-")
    assert status.lines(now, {**before, "agents": []})[3].endswith("-")


@pytest.mark.parametrize(
    ("answer", "expected"),
    [((True, json.dumps(report())), 0), ((True, json.dumps(report(troubles=["log: there is none"]))), 1),
     ((False, '{"error": "only with the right to change maps"}'), 1)],
)  # fmt: skip
@pytest.mark.parametrize("more", [[], ["--json"]])
def test_the_exit_status_says_whether_all_is_well(
    answer: tuple[bool, str], expected: int, more: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maps, "ask", lambda *_, **__: answer)
    monkeypatch.setattr(maps, "default_path", lambda: Path("no keys"))
    assert status.main(more) == expected


@pytest.mark.parametrize("answer", [(True, "{}"), (True, '{"store": 3}'), (False, "{}"), (True, "[]")])
def test_another_program_is_told_in_a_line(answer: tuple[bool, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "ask", lambda *_, **__: answer)
    monkeypatch.setattr(maps, "default_path", lambda: Path("no keys"))
    with pytest.raises(LinkError, match="answers"):
        status.main([])


@pytest.mark.parametrize("period", ["0", "nan", "inf"])
def test_a_period_that_is_no_time_is_refused(period: str) -> None:
    with pytest.raises(SystemExit):
        status.main(["--watch", period])


def test_the_help_names_the_exit_status_of_a_base_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(*_: Any, **__: Any) -> None:
        raise LinkError("no base station answers")

    monkeypatch.setattr(maps, "ask", silent)
    monkeypatch.setattr(maps, "default_path", lambda: Path("no keys"))
    assert kiteline(["status"]) == 2 and "2 no base answers" in status.parser().format_help().replace("\n", " ")


def test_a_base_that_does_not_answer_is_waited_for_with_a_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = threading.Event()

    def slow(*_: object, **__: object) -> tuple[bool, str]:
        assert told.wait(10.0)
        return True, json.dumps({"maps": []})

    def tell(lines: list[str]) -> None:
        print(*lines)
        told.set()

    monkeypatch.setattr("kiteline_hw.system.process._PATIENCE_S", 0.01)
    monkeypatch.setattr("kiteline_hw.system.process.print_lines", tell)
    monkeypatch.setattr(maps, "ask", slow)
    monkeypatch.setattr(maps, "default_path", lambda: Path("no keys"))
    assert maps.main(["list", "--base", "tcp/10.0.0.1:7447"]) == 0
    assert "waiting for a base at tcp/10.0.0.1:7447" in capsys.readouterr().out


def test_maps_are_listed_in_columns() -> None:
    made = {"agents": [0], "keyframes": 26, "points": 1246, "placed": True, "unit": "metre", "submaps": []}
    names = ["hangar", "a name of more than sixteen letters"]
    listed = [{"id": f"0.100140.{428 + i}", "name": name, **made} for i, name in enumerate(names)]
    head, *rows = maps.table({"maps": listed}).splitlines()
    for title, value in (("name", "hangar"), ("keyframes", "26"), ("unit", "metre")):
        assert head.index(title) == rows[0].index(value)
    assert names[1] in rows[1]


def test_replies_about_maps_are_sentences() -> None:
    assert maps.table({"maps": []}) == "no map yet"
    assert maps.table({"deleted": ["0.1.0", "0.2.1"]}) == "deleted: 0.1.0 0.2.1"
    assert maps.table({"merged": False, "looking": 60}).startswith("60 keyframes are searched for in the other map")
    with pytest.raises(KeyError):
        maps.table({"what": "else"})
