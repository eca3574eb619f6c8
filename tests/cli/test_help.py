import re

import pytest

from kiteline_cli import main as cli

WITH_VERBS = ("grid", "log", "maps", "rig", "keys", "calibrate")  # a verb's own help explains its flags


COMMANDS = {c.name: c for group in cli.find_commands().values() for c in group}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = cli.main([name, "--help"])
    except SystemExit as left:
        status = int(left.code or 0)
    assert status == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: kiteline {name}")
    explained, _, examples = text.partition("\nexamples:\n")
    assert len(examples.splitlines()) == len(COMMANDS[name].load().EXAMPLES) > 0
    for line in examples.splitlines():
        assert line.startswith(f"  kiteline {name}")
        flags = {word for word in line.split() if word.startswith("--")}
        assert name in WITH_VERBS or flags <= set(re.findall(r"--[a-z-]+", explained))


@pytest.mark.parametrize("name", ["fly", "eval", "convert", "agent", "replay"])
def test_a_command_without_its_arguments_exits_2_and_says_what_is_missing(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([name])
    assert left.value.code == 2
    assert "required" in capsys.readouterr().err
