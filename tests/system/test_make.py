"""Errors of `make` on a machine that lacks a tool."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    if shutil.which("make") is None:
        pytest.skip("make is not installed here")
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def make(folder: Path, target: str, python: str) -> subprocess.CompletedProcess[str]:
    command = ["make", "--no-print-directory", target, f"PYTHON={python}"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)


def test_a_missing_venv_module_names_the_package_to_install(checkout: Path) -> None:
    python = checkout / "python-without-venv"
    python.write_text('#!/bin/sh\ncase "$*" in *venv*) exit 1;; esac\nexec python3 "$@"\n')
    python.chmod(0o755)
    done = make(checkout, "test", str(python))
    assert done.returncode != 0
    assert "sudo apt install python3-venv" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_missing_or_old_python_is_reported(checkout: Path) -> None:
    assert "no nowhere-python found" in make(checkout, "demo", "nowhere-python").stderr
    old = checkout / "old-python"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.9.2 && exit 0\nexit 1\n')
    old.chmod(0o755)
    assert "Python 3.9.2 found, 3.11 or newer is needed" in make(checkout, "demo", str(old)).stderr


def test_help_lists_the_targets_and_installs_nothing(checkout: Path) -> None:
    done = make(checkout, "help", "nowhere-python")
    assert done.returncode == 0
    assert all(f"make {target} " in done.stdout for target in ("demo", "test", "check", "format", "bench"))
    assert not (checkout / ".venv").exists()
