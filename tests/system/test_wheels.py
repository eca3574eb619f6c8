"""A Raspberry Pi needs no compiler: the registry has a wheel for aarch64 of everything that the plain install needs."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# What a system with glibc 2.28 or newer takes: Raspberry Pi OS 11 has 2.31, Ubuntu 22.04 2.35. pip adds no older ones.
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in range(28, 16, -1)] + ["manylinux2014_aarch64"]
UNREACHABLE = ("Name or service not known", "Temporary failure in name resolution", "Connection refused", "ProxyError",
               "Network is unreachable", "No route to host", "timed out", "Could not fetch URL")  # fmt: skip


def resolve(requirements: list[str], python: str, folder: Path) -> list[str]:
    """File names that pip would install on such a board. Skips without a network, fails if there is no wheel."""
    report = folder / "report.json"
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--retries", "1",
               "--only-binary=:all:", "--implementation", "cp", "--python-version", python, "--target", str(folder),
               "--report", str(report), *requirements]  # fmt: skip
    for platform in PLATFORMS:
        command += ["--platform", platform]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode != 0:
        if any(text in done.stderr for text in UNREACHABLE):
            pytest.skip("no network: the registry cannot be asked for wheels")
        pytest.fail(done.stderr)
    installed: list[dict[str, Any]] = json.loads(report.read_text())["install"]
    return [one["download_info"]["url"].rsplit("/", 1)[1] for one in installed]


@pytest.mark.timeout(320)
@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
def test_the_drone_installs_from_wheels_alone(python: str, tmp_path: Path) -> None:
    names = resolve(PROJECT["dependencies"], python, tmp_path)
    assert len(names) >= len(PROJECT["dependencies"])
    assert all(name.endswith(("aarch64.whl", "-any.whl")) for name in names), names


def test_a_package_without_such_a_wheel_is_found(tmp_path: Path) -> None:
    """pyceres has wheels for x86-64 alone: the check must be able to fail."""
    with pytest.raises(pytest.fail.Exception, match="No matching distribution"):
        resolve(["pyceres==2.6"], "3.11", tmp_path)
