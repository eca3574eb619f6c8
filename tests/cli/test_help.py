from __future__ import annotations

import pytest

from kiteline_cli import main as cli


@pytest.mark.parametrize("name", [c.name for c in cli.COMMANDS])
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = cli.main([name, "--help"])
    except SystemExit as left:
        status = int(left.code or 0)
    assert status == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: kiteline {name}")


@pytest.mark.parametrize("name", ["fly", "eval", "convert", "agent", "replay"])
def test_a_command_without_its_arguments_exits_2_and_says_what_is_missing(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([name])
    assert left.value.code == 2
    assert "required" in capsys.readouterr().err
