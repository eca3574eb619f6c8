"""Keys and answers of the base's maps on the command line."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from kiteline_codec.transport.seal import fingerprint
from kiteline_core.ids import MAX_AGENTS
from kiteline_hw.ports import LinkError
from kiteline_hw.system.key_store import MAPS, new_key, read_file
from kiteline_lab.tools import keys, maps


def test_a_base_that_pairs_before_its_first_start_has_the_keys_of_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base, agent = tmp_path / "base", tmp_path / "agent"
    keys.main(["pair", "3", "--file", str(base)])
    code = capsys.readouterr().out.split("pair 3 ")[1].split()[0]
    keys.main(["--file", str(agent), "pair", "3", code])
    held = read_file(base)
    assert len(held.agents) == MAX_AGENTS and held.maps is not None
    assert read_file(agent).agents == {3: held.agents[3]} and read_file(agent).maps is None
    keys.main(["pair", "4", "--file", str(base)])
    again = read_file(base)
    assert again.agents[4] != held.agents[4] and {**again.agents, 4: held.agents[4]} == held.agents


def test_keys_are_shown_as_fingerprints_and_on_demand_as_lines_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "keys"
    for agent in ("7", MAPS):
        assert keys.main(["--file", str(file), "new", agent]) == 0
        capsys.readouterr()
        held = read_file(file)
        assert keys.main(["--file", str(file), "show"]) == 0
        shown = capsys.readouterr().out.splitlines()
        named = {"agent 7": held.agents[7]} | ({} if held.maps is None else {"the right to change maps": held.maps})
        assert [line.split("  ")[1] for line in shown] == [fingerprint(key) for key in named.values()]
        assert not any(key.hex() in "".join(shown) for key in named.values())
    assert held.maps is not None
    assert keys.main(["--file", str(file), "show", "--secret", MAPS]) == 0
    assert capsys.readouterr().out == f"{MAPS} {held.maps.hex()}\n"
    with pytest.raises(SystemExit):
        keys.main(["--file", str(file), "show", "--secret", "8"])
    assert "agent 8 has no key" in capsys.readouterr().err


def test_no_file_is_made_for_an_agent_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        keys.main(["pair", str(MAX_AGENTS), "--file", str(tmp_path / "keys")])
    assert not list(tmp_path.iterdir())


def test_keys_made_at_one_time_are_all_kept(tmp_path: Path) -> None:
    file = tmp_path / "new" / "keys"
    with ThreadPoolExecutor(16) as pool:
        made = list(pool.map(lambda agent: new_key(file, agent), range(64)))
    assert read_file(file).agents == dict(enumerate(made))
    assert [path.name for path in file.parent.iterdir()] == ["keys"]


@pytest.mark.parametrize("agent", ["9" * 5000, "-1", "٣", "1.5", ""])
def test_what_is_no_number_of_an_agent(agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        keys.main(["--file", str(tmp_path / "keys"), "pair", "--", agent])
    assert "no agent's number" in capsys.readouterr().err


@pytest.mark.parametrize("asked_for", [["list"], ["--json", "list"]])
@pytest.mark.parametrize(
    "answer",
    [(True, "<html>"), (False, "go away"), (False, "[]"), (True, "3"), (True, '{"maps": 3}'), (False, "{}"),
     (True, '{"maps": [{"id": "0.0.0"}]}'), (True, "[" * 100_000)],
)  # fmt: skip
def test_an_answer_of_another_program_is_told_in_a_line(
    answer: tuple[bool, str], asked_for: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maps, "ask", lambda *_, **__: answer)
    monkeypatch.setattr(maps, "default_path", lambda: Path("no keys"))
    with pytest.raises(LinkError, match="answers"):
        maps.main(asked_for)


def test_options_may_follow_the_verb() -> None:
    given = maps.parser().parse_args(["--base", "a", "--json", "get", "hangar", "--base", "b", "--key", "k"])
    assert (given.base, given.key, given.json) == ("b", Path("k"), True)
    given = maps.parser().parse_args(["--base", "a", "--key", "k", "list"])
    assert (given.base, given.key, given.json) == ("a", Path("k"), False)
