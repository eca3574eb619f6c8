"""A Raspberry Pi needs no compiler and little room: what the drone needs comes as wheels for aarch64, and is small."""

import json
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# What a system with glibc 2.28 or newer takes: Raspberry Pi OS 11 has 2.31, Ubuntu 22.04 2.35. pip adds no older ones.
# Names that auditwheel gives: pip compares each file of an index with all of them, a fifth of its time with thirteen.
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in (28, 27, 26, 24, 17)] + ["manylinux2014_aarch64"]
UNREACHABLE = ("Name or service not known", "Temporary failure in name resolution", "Connection refused", "ProxyError",
               "Network is unreachable", "No route to host", "timed out", "Could not fetch URL")  # fmt: skip
LARGEST_MIB = 600  # of the packages on a Raspberry Pi, byte code included: an 8 GB card holds them beside the system
BYTE_CODE = 1.25  # size of byte code over that of its source: 1.22 with blocks of 4 kB


def ask_pip(requirements: list[str], python: str, *command: str) -> None:
    """Run a command of pip as on such a board. Skips without a network, fails if there is no wheel."""
    words = [*command, "--only-binary=:all:", "--implementation", "cp", "--python-version", python, *requirements]
    for platform in PLATFORMS:
        words += ["--platform", platform]
    run_pip(words)


def run_pip(words: list[str]) -> None:
    """Run pip. Skips without a network, fails if it does."""
    words = [sys.executable, "-m", "pip", *words, "--quiet", "--retries", "1"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode != 0:
        if any(text in done.stderr for text in UNREACHABLE):
            pytest.skip("no network: the registry cannot be asked for wheels")
        pytest.fail(done.stderr)


def resolve(requirements: list[str], python: str, folder: Path) -> list[str]:
    """File names that pip would install."""
    report = folder / "report.json"
    ask_pip(requirements, python, "install", "--dry-run", "--ignore-installed", "--target", str(folder),
            "--report", str(report))  # fmt: skip
    return names_in(report)


def names_in(report: Path) -> list[str]:
    """File names in a report of pip."""
    installed: list[dict[str, Any]] = json.loads(report.read_text())["install"]
    return [one["download_info"]["url"].rsplit("/", 1)[1] for one in installed]


@pytest.mark.timeout(320)
def test_the_drone_installs_from_wheels_alone_on_the_newest_python(tmp_path: Path) -> None:
    names = resolve(PROJECT["dependencies"], "3.13", tmp_path)
    assert len(names) >= len(PROJECT["dependencies"])
    assert all(name.endswith(("aarch64.whl", "-any.whl")) for name in names), names


@pytest.mark.timeout(320)
def test_no_source_is_newer_than_its_wheel(tmp_path: Path) -> None:
    """pip takes the newest version, also if that one comes as source alone: here it may choose, as on a board."""
    report = tmp_path / "report.json"
    run_pip(["install", "--dry-run", "--ignore-installed", "--report", str(report), *PROJECT["dependencies"]])
    assert [name for name in names_in(report) if not name.endswith(".whl")] == []


@pytest.mark.timeout(320)
def test_the_drones_wheels_for_the_oldest_python_are_small(tmp_path: Path) -> None:
    """Sizes are read from the archives: unpacking and compiling them takes six times as long."""
    ask_pip(PROJECT["dependencies"], "3.11", "download", "--dest", str(tmp_path))
    wheels = [path for path in tmp_path.iterdir() if path.name.endswith(("aarch64.whl", "-any.whl"))]
    assert len(wheels) == len(list(tmp_path.iterdir())) >= len(PROJECT["dependencies"])
    blocks, source = 0, 0
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            for file in archive.infolist():
                blocks += -(-file.file_size // 4096)
                source += -(-file.file_size // 4096) * file.filename.endswith(".py")
    size_mib = (blocks + BYTE_CODE * source) * 4096 / 2**20
    print(f"installed size of what the drone needs on aarch64: {size_mib:.0f} MiB")
    assert 100 < size_mib < LARGEST_MIB


def test_a_package_without_such_a_wheel_is_found(tmp_path: Path) -> None:
    """pyceres has wheels for x86-64 alone: the check must be able to fail."""
    with pytest.raises(pytest.fail.Exception, match="No matching distribution"):
        resolve(["pyceres==2.6"], "3.11", tmp_path)
