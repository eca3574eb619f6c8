"""The command line of an agent."""

import pytest

from kiteline_agent.__main__ import main


@pytest.mark.parametrize("agent", ["256", "-1"])
def test_a_number_that_no_agent_can_have_is_refused_before_anything_else(
    agent: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing", f"--agent={agent}", "--link", "zenoh:tcp/10.0.0.1:7447"])
    assert "expected 0 to 255" in capsys.readouterr().err


@pytest.mark.parametrize("given", [["--obstacles"], ["--imu", "controller"], ["--grid", "base"]], ids=" ".join)
def test_what_the_filter_has_no_use_for_is_refused(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing", "--tracker", "ekf", *given])
    assert f"--tracker ekf uses no {' '.join(given).removesuffix(' controller')}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--cpu", "-5"], "--cpu: -5: expected 0"),
        (["--cpu", "nan"], "--cpu: nan: expected 0"),
        (["--cpu", "half"], "--cpu: half: expected 0 (no limit) or more"),
        (["--up-bytes", "-1"], "--up-bytes: -1: expected 0"),
        (["--up-bytes", "1.5"], "--up-bytes: 1.5: expected a whole number, 0 (no limit) or more"),
        (["--obstacles"], "expected --mavlink URL"),
    ],
)
def test_what_has_no_meaning_is_refused(given: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing", *given])
    assert words in capsys.readouterr().err
