from __future__ import annotations

import subprocess
import sys
import types
from pathlib import Path

import pytest

from kiteline_cli import main as cli
from kiteline_core.geometry.cameras import CalibrationError


def _stand_in(monkeypatch: pytest.MonkeyPatch, run: object) -> None:
    module = types.ModuleType("kiteline_cli.commands.fly")
    module.run = run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "kiteline_cli.commands.fly", module)


def test_every_command_has_a_file_and_a_line_of_help() -> None:
    files = {p.stem for p in (Path(cli.__file__).parent / "commands").glob("*.py")} - {"__init__"}
    assert {c.name for c in cli.COMMANDS} == files
    text = cli.parser().format_help()
    assert all(f"  {c.name} " in text for c in cli.COMMANDS)


def test_help_loads_nothing_heavy() -> None:
    code = "import sys; from kiteline_cli import main\nmain.parser().format_help()\nprint(sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not [m for m in ("numpy", "cv2", "numba", "zenoh", "matplotlib") if f"'{m}'" in loaded]


def test_a_mistyped_command_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["evla", "a", "b"]) == 2
    assert "did you mean 'eval'?" in capsys.readouterr().err


def test_arguments_after_the_command_are_handed_on_untouched(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[list[str]] = []
    _stand_in(monkeypatch, seen.append)
    assert cli.main(["fly", "--help", "--out", "x", "--version"]) == 0
    assert seen == [["--help", "--out", "x", "--version"]]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (CalibrationError("baseline is 0 m:\n expected more"), "baseline is 0 m: expected more"),
        (FileNotFoundError(2, "No such file or directory", "gone.tum"), "gone.tum: No such file or directory"),
        (ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib.figure"), "pip install 'kiteline[lab]'"),
    ],
)
def test_known_errors_are_one_line_and_exit_2(
    error: Exception, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(argv: list[str]) -> int:
        raise error

    _stand_in(monkeypatch, fail)
    assert cli.main(["fly"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("kiteline: error: ")
    assert words in err
    assert err.count("\n") == 1
    with pytest.raises(type(error)):
        cli.main(["--debug", "fly"])


def test_a_fault_of_the_program_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(argv: list[str]) -> int:
        raise KeyError("bug")

    _stand_in(monkeypatch, fail)
    with pytest.raises(KeyError):
        cli.main(["fly"])


def test_ctrl_c_exits_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(argv: list[str]) -> int:
        raise KeyboardInterrupt

    _stand_in(monkeypatch, interrupt)
    assert cli.main(["fly"]) == 130
