"""`kiteline maps` meets something that is no base where it asks."""

from pathlib import Path

import pytest

from kiteline_hw.ports import LinkError
from kiteline_lab.tools import maps


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
