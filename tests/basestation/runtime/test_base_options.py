"""Options of a base: what is wrong is told at the start."""

from pathlib import Path

import pytest

from kiteline_basestation import __main__ as program
from kiteline_basestation.runtime.options import BaseOptions, coded_channels
from kiteline_codec.sync.config import BudgetError
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.system import process

LINK = "serial:/dev/ttyUSB0:57600"


def test_a_budget_that_is_too_small_is_told_before_an_agent_comes() -> None:
    with pytest.raises(BudgetError, match=r"10 B/s .* at least"):
        coded_channels(BaseOptions(folder="", agents=(), link=LINK, down_bytes_s=10), link_traits(LINK))


@pytest.mark.parametrize("quiet", [False, True])
def test_a_base_says_at_once_that_it_loads(
    quiet: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = []

    def begin(*_: object) -> bool:
        said.append(capsys.readouterr())
        raise KeyboardInterrupt

    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    monkeypatch.setattr(process, "outlive_terminal", lambda: None)
    monkeypatch.setattr(process, "StopSignal", lambda: None)
    monkeypatch.setattr(program, "fly_live", begin)
    with pytest.raises(KeyboardInterrupt):
        program.main(["--link", "zenoh:tcp/127.0.0.1:1", "--insecure", *(["--quiet"] if quiet else [])])
    assert said[0].out == "" and said[0].err.startswith("loading the base") != quiet
