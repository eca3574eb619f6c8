import os
import re
import signal
import subprocess
import sys
import types
from pathlib import Path
from textwrap import dedent, indent

import pytest

from kiteline_cli import commands
from kiteline_cli import main as cli
from kiteline_cli.commands import machine
from kiteline_core.geometry.cameras import CalibrationError


def _stand_in(monkeypatch: pytest.MonkeyPatch, run: object) -> None:
    module = types.ModuleType("kiteline_cli.commands.flights.fly")
    vars(module).update(run=run, EXAMPLES=())
    monkeypatch.setitem(sys.modules, "kiteline_cli.commands.flights.fly", module)


def test_every_group_has_a_heading_and_every_command_a_line_of_help() -> None:
    folders = {p.name for p in Path(commands.__file__).parent.iterdir() if (p / "__init__.py").is_file()}
    assert set(commands.GROUPS) == folders
    groups = cli.find_commands()
    names = [c.name for group in groups.values() for c in group]
    assert len(names) == len(set(names)) == len(list(Path(commands.__file__).parent.glob("*/[!_]*.py"))) >= 15
    text = cli.parser().format_help()
    for title, group in groups.items():
        block = text.partition(f"\n{title}:\n")[2].partition("\n\n")[0].splitlines()
        assert [line.split()[0] for line in block] == [c.name for c in group]


def test_a_new_command_is_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = 'SUMMARY = "a toy"\nEXAMPLES = ("kiteline toy",)\n\ndef run(argv):\n    print("ran", argv)\n'
    (tmp_path / "toy.py").write_text(text)
    monkeypatch.setattr(machine, "__path__", [*machine.__path__, str(tmp_path)])
    assert re.search(r"^  toy +a toy$", cli.parser().format_help(), re.MULTILINE)
    assert cli.main(["toy", "--fast"]) == 0
    assert capsys.readouterr().out == "ran ['--fast']\n"


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
        (NotADirectoryError(20, "Not a directory", "out.txt/base"), "a file stands where a folder is expected"),
        (PermissionError(13, "Permission denied", "/root/out"), "name another place"),
        (OSError(28, "No space left on device"), "No space left on device: free some"),  # a write names no file
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


@pytest.mark.parametrize("words", [("base", "--help"), ("fly", "--help"), ("--help",), ("config",)])
def test_a_reader_that_goes_away_ends_a_command_quietly(words: tuple[str, ...]) -> None:
    """As `kiteline base --help | head -1` does; it ended in a traceback."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "kiteline_cli", *words], stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert done.stderr == ""
    assert done.returncode in (0, 2)  # argparse swallows the error where its text is longer than a buffer


@pytest.mark.parametrize("words", [("keys", "--help"), ("--help",), ("config",), ("--version",)])
def test_output_that_no_disk_takes_is_one_line_of_error(words: tuple[str, ...]) -> None:
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "kiteline_cli", *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.stderr.count("\n") == 1 and "No space left on device" in done.stderr
    assert done.returncode == 2


def test_ctrl_c_while_a_command_loads_exits_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(self: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.Command, "load", interrupt)
    assert cli.main(["fly"]) == 130


LOADS = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "kiteline_lab.replay.replay":
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                print("swallowed")
sys.meta_path.insert(0, Finder())
sys.argv[1:] = ["replay", "none.mcap"]
from kiteline_cli.entry import run
run()
"""


def test_ctrl_c_is_not_swallowed_by_what_loads() -> None:
    """A library that does so while it is imported let the command go on."""
    done = subprocess.run([sys.executable, "-c", LOADS], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


# A process whose command `fly` runs the text that follows.
STAND_IN = """\
import os, signal, sys, types

from kiteline_cli import main as cli

def run(argv):
{text}

fly = types.ModuleType("kiteline_cli.commands.flights.fly")
fly.run, fly.EXAMPLES, sys.argv = run, (), ["kiteline", "fly"]
sys.modules[fly.__name__] = fly
cli.run()
"""


def _run_stand_in(text: str, **options: object) -> subprocess.CompletedProcess[bytes]:
    code = STAND_IN.format(text=indent(dedent(text), "    "))
    return subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, timeout=60, check=False, **options)


@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", -signal.SIGTERM)])
def test_a_signal_leaves_nothing_half_written(name: str, status: int, tmp_path: Path) -> None:
    done = _run_stand_in(
        f"""
        try:
            open("part", "w").close()
            os.kill(os.getpid(), signal.{name})
            print("ignored")
        finally:
            os.unlink("part")
        """,
        cwd=tmp_path, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (status, b"", b"")
    assert list(tmp_path.iterdir()) == []


def test_a_signal_in_a_finaliser_is_not_lost() -> None:
    done = _run_stand_in(
        """
        import time
        class Native:
            def __del__(self):
                os.kill(os.getpid(), signal.SIGINT)
                sum(range(100))
        Native()
        time.sleep(30)
        """,
        stdout=subprocess.PIPE,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"")


def test_a_terminal_that_lacks_letters_is_no_fault() -> None:
    done = _run_stand_in(
        r'print("9.5 m\N{SUPERSCRIPT TWO}", "\udcff.mcap")',
        stdout=subprocess.PIPE, env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, rb"9.5 m\xb2 \udcff.mcap" + b"\n", b"")


def test_output_that_is_closed_is_no_fault() -> None:
    code = STAND_IN.format(text="    print('into the void')")
    done = subprocess.run(
        ["sh", "-c", '"$0" -c "$1" >&-', sys.executable, code], capture_output=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, b"")


def test_errors_that_are_closed_are_no_fault() -> None:
    code = STAND_IN.format(text="    sys.stderr.write('into the void')")
    done = subprocess.run(
        ["sh", "-c", '"$0" -c "$1" 2>&-', sys.executable, code], capture_output=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout) == (0, b"")


def test_no_file_takes_the_number_of_a_stream_that_is_closed() -> None:
    """A live base had sockets and pipes where libraries print, and ended with status 1 as it had no output."""
    text = "    from kiteline_hw.system import process\n    process.exit_now(open('/dev/null').fileno())"
    command = ["sh", "-c", '"$0" -c "$1" <&- >&- 2>&-', sys.executable, STAND_IN.format(text=text)]
    assert subprocess.run(command, check=False, timeout=60).returncode > 2
