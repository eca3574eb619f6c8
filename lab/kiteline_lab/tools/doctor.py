"""`kiteline doctor`: is this machine fit to fly, and what would mend it?"""

from __future__ import annotations

import argparse
import glob
import importlib
import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

PLAIN = {  # distribution: module, for what the drone needs
    "numpy": "numpy",
    "numba": "numba",
    "opencv-python-headless": "cv2",
    "eclipse-zenoh": "zenoh",
    "mcap": "mcap",
    "mcap-ros2-support": "mcap_ros2",
    "mcap-protobuf-support": "mcap_protobuf",
    "foxglove-schemas-protobuf": "foxglove_schemas_protobuf",
    "protobuf": "google.protobuf",
    "lz4": "lz4",
    "zstandard": "zstandard",
    "pymavlink": "pymavlink",
    "pyserial": "serial",
    "PyYAML": "yaml",
    "cobs": "cobs",
    "cryptography": "cryptography",
}
EXTRAS = {
    "base": {"gtsam": "gtsam", "websockets": "websockets"},
    "lab": {"matplotlib": "matplotlib"},
}
WARMING = (
    "kiteline_codec.warm",
    "kiteline_agent.runtime.warm",
    "kiteline_basestation.runtime.warm",
)
MIN_MEMORY_MIB = 400  # an agent takes 250 MiB, and compiling its kernels half as much again
OLDEST_CLOCK_S = 1_735_689_600  # 2025-01-01: a Pi without a network starts in the past
SERIAL_PORTS = ("/dev/serial0", "/dev/ttyAMA*", "/dev/ttyACM*", "/dev/ttyUSB*", "/dev/ttyS0", "/dev/ttyTHS*")


class Level(Enum):
    """How bad a finding is."""

    OK = "ok"
    NOTE = "note"  # good to know
    FAIL = "FAIL"  # kiteline, or that part of it, will not work


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check saw. mend: what to do about it, or empty."""

    level: Level
    name: str
    text: str
    mend: str = ""


def check_python() -> Iterable[Finding]:
    """The interpreter."""
    text = f"{platform.python_version()} on {platform.machine()}, {platform.system()} {platform.release()}"
    yield Finding(Level.OK, "python", text)  # an older one could not have installed or parsed this


def check_packages() -> Iterable[Finding]:
    """What is installed: the plain part must load, extras may be absent."""
    versions, broken = [], []
    for distribution, module in PLAIN.items():
        try:
            importlib.import_module(module)
            versions.append(f"{distribution} {importlib.metadata.version(distribution)}")
        except Exception as error:  # a wheel for another processor fails in its own way
            broken.append(f"{distribution} ({error})")
    if broken:
        yield Finding(Level.FAIL, "packages", "; ".join(broken), "pip install --force-reinstall kiteline")
    else:
        yield Finding(Level.OK, "packages", ", ".join(versions))
    for extra, packages in EXTRAS.items():
        missing = [d for d, module in packages.items() if importlib.util.find_spec(module) is None]
        if missing:
            yield Finding(Level.NOTE, extra, f"without {', '.join(missing)}", f"pip install 'kiteline[{extra}]'")
        else:
            yield Finding(Level.OK, extra, "extra installed")


def check_kernel_cache() -> Iterable[Finding]:
    """Where numba keeps compiled kernels: without a cache each start compiles for many seconds."""
    spec = importlib.util.find_spec("kiteline_core")
    beside = Path(spec.submodule_search_locations[0] if spec and spec.submodule_search_locations else ".")
    named = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    for folder in [Path(named)] if named else [beside / "__pycache__", user]:
        if _writable(folder):
            yield Finding(Level.OK, "kernel cache", f"{folder} can be written; fill it with: kiteline doctor --warm")
            return
    yield Finding(
        Level.FAIL,
        "kernel cache",
        f"cannot write {named or beside}: each start would compile for many seconds",
        "set NUMBA_CACHE_DIR to a folder that this user may write",
    )


def check_processor() -> Iterable[Finding]:
    """Cores, clock governor, OpenCV's threads."""
    cores = len(os.sched_getaffinity(0))
    try:
        import cv2

        cv = f"; OpenCV {cv2.__version__} would take {cv2.getNumThreads()} threads, an agent sets 1"
    except ImportError:
        cv = ""
    yield Finding(Level.OK, "processor", f"{cores} of {os.cpu_count()} cores{cv}")
    governor = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if governor.exists() and (name := governor.read_text().strip()) == "powersave":
        yield Finding(
            Level.NOTE, "governor", f"{name}: frames may take longer", "sudo cpupower frequency-set -g performance"
        )


def check_memory() -> Iterable[Finding]:
    """Room for an agent."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free_mib = next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) // 1024
    except (OSError, StopIteration, ValueError):
        return
    if free_mib >= MIN_MEMORY_MIB:
        yield Finding(Level.OK, "memory", f"{free_mib} MiB available")
    else:
        yield Finding(
            Level.FAIL, "memory", f"{free_mib} MiB available, {MIN_MEMORY_MIB} are needed", "end other programs"
        )


def check_zenoh() -> Iterable[Finding]:
    """A real session on loopback, in a process of its own: a broken one may hang."""
    code = (
        "from kiteline_hw.links.zenoh_session import open_session, close_session\n"
        "close_session(open_session('tcp/127.0.0.1:0', 'base'))"
    )
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        yield Finding(Level.FAIL, "zenoh", "a session on loopback hangs", "is the lo interface up?")
        return
    if done.returncode == 0:
        yield Finding(Level.OK, "zenoh", "opens and closes a session on loopback")
    else:
        last = (done.stderr.strip().splitlines() or ["no word"])[-1]
        yield Finding(Level.FAIL, "zenoh", last[:160], "is the lo interface up, and may this user open TCP ports?")


def check_serial() -> Iterable[Finding]:
    """Serial ports, and whether this user may open them."""
    ports = sorted({p for pattern in SERIAL_PORTS for p in glob.glob(pattern)})
    closed = [p for p in ports if not os.access(p, os.R_OK | os.W_OK)]
    if not ports:
        yield Finding(Level.NOTE, "serial", "no port found: fine unless a flight controller or radio is to be attached")
        return
    if closed:
        yield Finding(
            Level.NOTE,
            "serial",
            f"may not open {', '.join(closed)}",
            "sudo usermod -aG dialout $USER, then log in again",
        )
    if usable := [p for p in ports if p not in closed]:
        yield Finding(Level.OK, "serial", ", ".join(usable))
    yield Finding(
        Level.NOTE,
        "flight controller",
        "one that forwards ODOMETRY to its telemetry radio drowns it",
        "ArduPilot: set bit 1024 of SERIALx_OPTIONS of the port to this computer; PX4: MAV_x_FORWARD = 0",
    )


def check_cgroup() -> Iterable[Finding]:
    """Whether `--cpu` can be enforced by the kernel."""
    root = Path("/sys/fs/cgroup")
    two, one = (root / "cgroup.controllers"), (root / "cpu")
    if two.exists():
        usable = "cpu" in two.read_text().split() and os.access(root, os.W_OK)
        kind = "version 2"
    elif one.is_dir():
        usable, kind = os.access(one, os.W_OK), "version 1"
    else:
        usable, kind = False, "none"
    how = "may be set" if usable else "may not be set by this user: replay --cpu uses the virtual CPU"
    yield Finding(Level.OK if usable else Level.NOTE, "cgroup", f"{kind}; a CPU limit {how}")


def check_clock() -> Iterable[Finding]:
    """The wall clock names logs and, on the base, certificates; flight time is monotonic and needs no date."""
    resolution_ns = time.clock_getres(time.CLOCK_MONOTONIC) * 1e9
    today = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    if resolution_ns > 1e6:
        yield Finding(
            Level.FAIL, "clock", f"monotonic clock steps by {resolution_ns / 1e6:.0f} ms", "use another kernel"
        )
    elif time.time() < OLDEST_CLOCK_S:
        yield Finding(
            Level.NOTE, "clock", f"says {today}: logs will bear a wrong date", "sudo timedatectl set-ntp true"
        )
    else:
        yield Finding(Level.OK, "clock", f"{today}, monotonic to {resolution_ns:.0f} ns")


def check_systemd() -> Iterable[Finding]:
    """Whether the units could run, and whether they do."""
    if not Path("/run/systemd/system").is_dir():
        yield Finding(Level.NOTE, "systemd", "does not run here: start kiteline by hand or by another supervisor")
        return
    folders = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
    units = [u for u in ("kiteline-agent", "kiteline-base") if any(Path(f, f"{u}.service").exists() for f in folders)]
    yield Finding(Level.OK, "systemd", f"runs; units installed: {', '.join(units) or 'none'}")


CHECKS: tuple[Callable[[], Iterable[Finding]], ...] = (
    check_python,
    check_packages,
    check_kernel_cache,
    check_processor,
    check_memory,
    check_zenoh,
    check_serial,
    check_cgroup,
    check_clock,
    check_systemd,
)


def examine() -> list[Finding]:
    """All checks; one that itself breaks is a finding, not a traceback."""
    findings: list[Finding] = []
    for check in CHECKS:
        try:
            findings.extend(check())
        except Exception as error:
            findings.append(
                Finding(Level.NOTE, check.__name__.removeprefix("check_"), f"could not be checked: {error}")
            )
    return findings


def warm() -> list[Finding]:
    """Compile and cache the kernels of every room that is installed here."""
    from kiteline_hw.system import kernel_cache

    findings = []
    for name in WARMING:
        room = name.split(".")[0]
        if importlib.util.find_spec(room) is None or importlib.util.find_spec(name) is None:
            continue
        start_s = time.perf_counter()
        importlib.import_module(name).warm()
        findings.append(Finding(Level.OK, "warm", f"{room}: {time.perf_counter() - start_s:.1f} s"))
    kernel_cache.mark()
    return findings


def main(argv: list[str]) -> int:
    """Run `kiteline doctor`; 1 when something will not work."""
    p = argparse.ArgumentParser(prog="kiteline doctor", description="Check this machine, and say what would mend it.")
    p.add_argument("--warm", action="store_true", help="compile all kernels and cache them, so that a start is quick")
    a = p.parse_args(argv)
    findings = examine() + (warm() if a.warm else [])
    width = max(len(f.name) for f in findings)
    for f in findings:
        print(f"{f.level.value:>4}  {f.name:{width}}  {f.text}")
        if f.mend:
            print(f"{'':>4}  {'':{width}}  -> {f.mend}")
    return 1 if any(f.level is Level.FAIL for f in findings) else 0


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
