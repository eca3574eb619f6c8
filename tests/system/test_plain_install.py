"""The drone's install: a wheel, without extras, in an empty environment flies, and is small."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("core", "codec", "hw", "agent", "basestation", "lab", "bench", "cli")
LARGEST_MIB = 600  # of the packages on a Raspberry Pi, byte code included: an 8 GB card holds them beside the system
GLIBC = [f"--platform=manylinux_2_{minor}_aarch64" for minor in range(28, 16, -1)] + [
    "--platform=manylinux2014_aarch64"
]


def run(*command: object, folder: Path, cache: Path | None = None) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "KITELINE"))}
    variables = {**kept, "OMP_NUM_THREADS": "1", **({"NUMBA_CACHE_DIR": str(cache)} if cache else {})}
    return subprocess.run(
        [*map(str, command)], cwd=folder, env=variables, capture_output=True, text=True, timeout=500, check=False
    )


def pip(*arguments: object, folder: Path, python: Path | str = sys.executable) -> None:
    """Run pip. Skips if no package registry answers."""
    done = run(python, "-m", "pip", *arguments, "--quiet", "--retries", "1", folder=folder)
    if done.returncode != 0:
        if any(text in done.stderr for text in ("NewConnectionError", "resolution", "Connection", "timed out")):
            pytest.skip("no network: what kiteline needs cannot be installed into an empty environment")
        pytest.fail(done.stderr)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel that was built from a copy of the source: what an earlier build left behind does not get into it."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for room in (*ROOMS, "systemd"):
        shutil.copytree(ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    pip("wheel", "--no-deps", "--wheel-dir", out, source, folder=out)
    (made,) = out.glob("*.whl")
    return made


@pytest.mark.timeout(900)
def test_a_plain_install_flies_and_tells_what_it_goes_without(wheel: Path, recording: Path, tmp_path: Path) -> None:
    environment, cache = tmp_path / "venv", tmp_path / "cache"
    subprocess.run([sys.executable, "-m", "venv", environment], check=True, timeout=100)
    pip("install", "--no-compile", wheel, folder=tmp_path, python=environment / "bin" / "python")
    kiteline = environment / "bin" / "kiteline"
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert run(kiteline, "--version", folder=tmp_path).stdout == f"kiteline {version}\n"
    done = run(kiteline, "fly", recording, "--mode", "tracker", "--out", "out", folder=tmp_path, cache=cache)
    assert done.returncode == 0, done.stderr
    assert "matplotlib is not installed: no trajectory.png" in done.stderr.partition("flying")[0]
    agent = json.loads((tmp_path / "out" / "report.json").read_text())["agents"][0]
    assert agent["tracked"] == agent["frames"] == 30
    units = run(kiteline, "install-units", "--root", "image", folder=tmp_path)
    assert units.returncode == 0, units.stderr
    unit = (tmp_path / "image/etc/systemd/system/kiteline-agent.service").read_text()
    assert f"Environment=PATH={environment / 'bin'}:" in unit
    asked = run(kiteline, "eval", "out/agent0/live.tum", recording, "--plot", "a.png", folder=tmp_path)
    assert asked.returncode == 2
    assert "pip install 'kiteline[lab]'" in asked.stderr


@pytest.mark.timeout(900)
def test_the_drones_part_is_small_on_a_raspberry_pi(wheel: Path, tmp_path: Path) -> None:
    packages = tmp_path / "packages"
    pip("install", "--only-binary=:all:", "--implementation=cp", "--python-version=3.11", "--target", packages, *GLIBC,
        wheel, folder=tmp_path)  # fmt: skip
    size_mib = sum(file.stat().st_blocks * 512 for file in packages.rglob("*") if file.is_file()) / 2**20
    print(f"installed size of the drone's part on aarch64: {size_mib:.0f} MiB")
    assert 100 < size_mib < LARGEST_MIB
