"""The drone's install: the wheel holds the repository's code, which flies with no package but those that it names."""

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path
from shutil import copy, copytree, ignore_patterns

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ROOMS = ("core", "codec", "hw", "agent", "basestation", "lab", "bench", "cli")
UNREACHABLE = ("NewConnectionError", "resolution", "Connection", "timed out")


def run(*command: object, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "KITELINE"))}
    return subprocess.run(
        [*map(str, command)], cwd=folder, env={**kept, "OMP_NUM_THREADS": "1", **variables}, capture_output=True,
        text=True, timeout=500, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel that was built from a copy of the source: what an earlier build left behind does not get into it."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for room in (*ROOMS, "systemd"):
        copytree(ROOT / room, source / room, ignore=ignore_patterns("__pycache__", "*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        copy(ROOT / name, source / name)
    done = run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "--retries", "1", "--wheel-dir", out,
               source, folder=out)  # fmt: skip
    if done.returncode != 0:
        if any(text in done.stderr for text in UNREACHABLE):
            pytest.skip("no network: what builds a wheel cannot be installed")
        pytest.fail(done.stderr)
    (made,) = out.glob("*.whl")
    return made


def needed(name: str, found: dict[str, Distribution]) -> None:
    """Add a distribution to `found`, and all that it needs without extras."""
    from packaging.requirements import Requirement

    found[name] = one = distribution(name)
    for text in one.requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            wanted = re.sub(r"[-_.]+", "-", requirement.name).lower()
            if wanted not in found:
                needed(wanted, found)


@pytest.fixture(scope="module")
def plain(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of an environment with the wheel and what it names as needed, linked from this environment."""
    environment = tmp_path_factory.mktemp("plain") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True, timeout=100)
    (packages,) = environment.glob("lib/python*/site-packages")
    found: dict[str, Distribution] = {}
    for text in PROJECT["dependencies"]:
        needed(re.match(r"[\w.-]+", text)[0].lower(), found)  # type: ignore[index]
    for one in found.values():
        for top in {file.parts[0] for file in one.files or () if file.parts[0] not in ("..", "__pycache__")}:
            if not (packages / top).exists():
                (packages / top).symlink_to(Path(str(one.locate_file(top))))
    assert not {"gtsam", "matplotlib", "websockets", "hypothesis", "scipy"} & {p.name for p in packages.iterdir()}
    python = environment / "bin" / "python"
    done = run(sys.executable, "-m", "pip", "--python", python, "install", "--no-index", "--no-deps", "--no-compile",
               "--quiet", wheel,
               folder=environment)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return environment / "bin"


def test_the_wheel_holds_all_code_and_data_as_they_are_here(wheel: Path) -> None:
    here = {
        str(file.relative_to(ROOT / room)): file.read_bytes()
        for room in ROOMS
        for file in (ROOT / room).glob("kiteline_*/**/*")
        if file.is_file() and not {"__pycache__"} & set(file.parts) and ".egg-info" not in str(file)
    }
    units = {file.name for file in (ROOT / "systemd").rglob("*.*") if file.is_file()}
    with zipfile.ZipFile(wheel) as archive:
        there = {n: archive.read(n) for n in archive.namelist() if n.startswith("kiteline_")}
        shared = {Path(n).name for n in archive.namelist() if ".data/data/share/kiteline/systemd/" in n}
        (head,) = (archive.read(n).decode() for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
    assert sum(name.endswith((".bin", ".html", ".js")) for name in there) >= 3
    assert {n: code for n, code in there.items() if ".data/" not in n and ".dist-info/" not in n} == here
    assert shared == units
    named = {line.removeprefix("Requires-Dist: ") for line in head.splitlines() if line.startswith("Requires-Dist: ")}
    plain = {re.sub(r"[<>=].*", "", n) for n in named if "extra ==" not in n}
    assert plain == {re.sub(r"[<>=].*", "", n) for n in PROJECT["dependencies"]}


def test_the_installed_commands_work_and_tell_what_they_go_without(
    plain: Path, recording: Path, tmp_path: Path
) -> None:
    done = run(plain / "kiteline", "--version", folder=tmp_path)
    assert done.stdout == f"kiteline {PROJECT['version']}\n", done.stderr
    units = run(plain / "kiteline", "install-units", "--root", "image", folder=tmp_path)
    assert units.returncode == 0, units.stderr
    unit = (tmp_path / "image/etc/systemd/system/kiteline-agent.service").read_text()
    assert f"Environment=PATH={plain}:" in unit
    asked = run(plain / "kiteline", "eval", "live.tum", recording, "--plot", "a.png", folder=tmp_path)
    assert asked.returncode == 2
    assert "pip install 'kiteline[lab]'" in asked.stderr


def test_a_flight_needs_no_more_packages(plain: Path, recording: Path, tmp_path: Path) -> None:
    """The code is read from the repository, where its kernels are compiled already: it is that of the wheel."""
    code = {"PYTHONPATH": os.pathsep.join(str(ROOT / room) for room in ROOMS)}
    words = ("-m", "kiteline_cli", "fly", recording, "--mode", "tracker", "--out", "out")
    done = run(plain / "python", *words, folder=tmp_path, **code)
    assert done.returncode == 0, done.stderr
    assert "matplotlib is not installed: no trajectory.png" in done.stderr.partition("flying")[0]
    agent = json.loads((tmp_path / "out" / "report.json").read_text())["agents"][0]
    assert agent["tracked"] == agent["frames"] == 30


def test_a_base_needs_no_web_server(plain: Path, tmp_path: Path) -> None:
    code = {"PYTHONPATH": os.pathsep.join(str(ROOT / room) for room in ROOMS)}
    done = run(plain / "python", "-c", "import kiteline_basestation.__main__", folder=tmp_path, **code)
    assert done.returncode == 0, done.stderr
