"""`kiteline doctor`: check whether this machine can run kiteline, and say how to mend what is missing."""

import argparse
import glob
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path

from kiteline_hw.system import process
from kiteline_lab.tools.checks.check import DoctorCheck, Severity
from kiteline_lab.tools.checks.controller import check_controller
from kiteline_lab.tools.checks.keys import check_keys
from kiteline_lab.tools.checks.vehicle import check_disk, check_power, check_temperature, check_time

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
EXTRAS = {"base": {"gtsam": "gtsam", "websockets": "websockets"}, "lab": {"matplotlib": "matplotlib"}}
WARMING = ("kiteline_codec.warm", "kiteline_agent.runtime.warm", "kiteline_basestation.runtime.warm")
MIN_MEMORY_MIB = 400  # an agent takes 250 MiB; compiling its kernels takes half as much again
OLDEST_CLOCK_S = 1_735_689_600  # 2025-01-01: without a network, a Raspberry Pi starts in the past
SERIAL_PORTS = ("/dev/serial0", "/dev/ttyAMA*", "/dev/ttyACM*", "/dev/ttyUSB*", "/dev/ttyS0", "/dev/ttyTHS*")


def check_python() -> Iterable[DoctorCheck]:
    """Report version and platform of the interpreter."""
    text = f"{platform.python_version()} on {platform.machine()}, {platform.system()} {platform.release()}"
    yield DoctorCheck(Severity.OK, "python", text)  # an older one could not have installed or parsed this


def check_packages() -> Iterable[DoctorCheck]:
    """Import every plain dependency; extras may be absent."""
    versions, broken = [], dict[str, str]()
    for distribution, module in PLAIN.items():
        try:
            importlib.import_module(module)
            versions.append(f"{distribution} {importlib.metadata.version(distribution)}")
        except Exception as error:  # a wheel for another processor fails in its own way
            broken[distribution] = f"{distribution} ({error})"
    if broken:
        remedy = f"pip install --force-reinstall {' '.join(broken)}"
        yield DoctorCheck(Severity.FAIL, "packages", "; ".join(broken.values()), remedy)
    else:
        yield DoctorCheck(Severity.OK, "packages", ", ".join(versions))
    for extra, packages in EXTRAS.items():
        missing = [d for d, module in packages.items() if importlib.util.find_spec(module) is None]
        if missing:
            yield DoctorCheck(Severity.NOTE, extra, f"without {', '.join(missing)}", f"pip install 'kiteline[{extra}]'")
        else:
            yield DoctorCheck(Severity.OK, extra, "extra installed")


def check_kernel_cache() -> Iterable[DoctorCheck]:
    """Check that numba can keep compiled kernels, and whether it has: without them a start compiles for a minute."""
    from kiteline_hw.system import kernel_cache

    beside = [path for path in map(_folder_of, ("kiteline_core", "kiteline_codec", "kiteline_agent")) if path]
    named = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    for folder in [Path(named)] if named else [beside[0] / "__pycache__", user]:
        if not _writable(folder):
            continue
        if kernel_cache.holds_current(beside if folder.parent == beside[0] else [folder]):
            yield DoctorCheck(Severity.OK, "kernel cache", f"{folder}: kernels are compiled")
        else:
            text = f"{folder}: kernels are not compiled yet, so the next start takes a minute, several on a small board"
            yield DoctorCheck(Severity.NOTE, "kernel cache", text, "kiteline doctor --warm")
        return
    yield DoctorCheck(
        Severity.FAIL,
        "kernel cache",
        f"cannot write {named or beside[0]}: each start would compile for many seconds",
        "set NUMBA_CACHE_DIR to a folder that this user may write",
    )


def _folder_of(package: str) -> Path | None:
    spec = importlib.util.find_spec(package)
    return Path(spec.submodule_search_locations[0]) if spec and spec.submodule_search_locations else None


def check_processor() -> Iterable[DoctorCheck]:
    """Report cores, OpenCV's threads and a power-saving clock governor."""
    cores = len(os.sched_getaffinity(0))
    try:
        import cv2

        cv = f"; OpenCV {cv2.__version__} would take {cv2.getNumThreads()} threads, an agent sets 1"
    except ImportError:
        cv = ""
    yield DoctorCheck(Severity.OK, "processor", f"{cores} of {os.cpu_count()} cores{cv}")
    governor = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if governor.exists() and (name := governor.read_text().strip()) == "powersave":
        yield DoctorCheck(
            Severity.NOTE, "governor", f"{name}: frames may take longer", "sudo cpupower frequency-set -g performance"
        )


def check_memory() -> Iterable[DoctorCheck]:
    """Check that there is memory for an agent."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free_mib = next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) // 1024
    except (OSError, StopIteration, ValueError):
        return
    if free_mib >= MIN_MEMORY_MIB:
        yield DoctorCheck(Severity.OK, "memory", f"{free_mib} MiB available")
    else:
        yield DoctorCheck(
            Severity.FAIL, "memory", f"{free_mib} MiB available, {MIN_MEMORY_MIB} are needed", "end other programs"
        )


def check_zenoh() -> Iterable[DoctorCheck]:
    """Open a Zenoh session on loopback, in a process of its own, since a broken one may hang."""
    code = (
        "from kiteline_hw.links.zenoh_session import open_session, close_session\n"
        "close_session(open_session('tcp/127.0.0.1:0', 'base'))"
    )
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        yield DoctorCheck(Severity.FAIL, "zenoh", "a session on loopback hangs", "is the lo interface up?")
        return
    if done.returncode == 0:
        yield DoctorCheck(Severity.OK, "zenoh", "opens and closes a session on loopback")
    else:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        yield DoctorCheck(
            Severity.FAIL, "zenoh", last[:160], "is the lo interface up, and may this user open TCP ports?"
        )


_NOT_ASKED = DoctorCheck(
    Severity.NOTE, "flight controller", "not asked here", "kiteline doctor --mavlink serial:DEVICE:BAUD"
)


def check_serial() -> Iterable[DoctorCheck]:
    """List serial ports, and whether this user may open them."""
    ports = sorted({p for pattern in SERIAL_PORTS for p in glob.glob(pattern)})
    closed = [p for p in ports if not os.access(p, os.R_OK | os.W_OK)]
    if not ports:
        yield DoctorCheck(Severity.NOTE, "serial", "no port found: needed only for a flight controller or a radio")
        return
    if closed:
        yield DoctorCheck(
            Severity.NOTE,
            "serial",
            f"may not open {', '.join(closed)}",
            "sudo usermod -aG dialout $USER, then log in again",
        )
    if usable := [p for p in ports if p not in closed]:
        yield DoctorCheck(Severity.OK, "serial", ", ".join(usable))
    yield _NOT_ASKED


def check_cgroup() -> Iterable[DoctorCheck]:
    """Check whether the kernel can enforce `--cpu`."""
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
    yield DoctorCheck(Severity.OK if usable else Severity.NOTE, "cgroup", f"{kind}; a CPU limit {how}")


def check_clock() -> Iterable[DoctorCheck]:
    """Check the clocks. The wall clock dates logs and checks certificates; flight time is monotonic."""
    resolution_ns = time.clock_getres(time.CLOCK_MONOTONIC) * 1e9
    today = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    if resolution_ns > 1e6:
        yield DoctorCheck(
            Severity.FAIL, "clock", f"monotonic clock steps by {resolution_ns / 1e6:.0f} ms", "use another kernel"
        )
    elif time.time() < OLDEST_CLOCK_S:
        yield DoctorCheck(
            Severity.NOTE, "clock", f"says {today}: logs will bear a wrong date", "sudo timedatectl set-ntp true"
        )
    else:
        yield DoctorCheck(Severity.OK, "clock", f"{today}, monotonic to {resolution_ns:.0f} ns")


def check_systemd() -> Iterable[DoctorCheck]:
    """Check whether systemd runs here, and which units are installed."""
    if not Path("/run/systemd/system").is_dir():
        yield DoctorCheck(Severity.NOTE, "systemd", "not running: start kiteline by hand or by another supervisor")
        return
    folders = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
    units = [u for u in ("kiteline-agent", "kiteline-base") if any(Path(f, f"{u}.service").exists() for f in folders)]
    yield DoctorCheck(Severity.OK, "systemd", f"runs; units installed: {', '.join(units) or 'none'}")


CHECKS: tuple[Callable[[], Iterable[DoctorCheck]], ...] = (
    check_python,
    check_packages,
    check_kernel_cache,
    check_processor,
    check_memory,
    check_zenoh,
    check_serial,
    check_keys,
    check_cgroup,
    check_clock,
    check_time,
    check_disk,
    check_temperature,
    check_power,
    check_systemd,
)


def run_checks() -> list[DoctorCheck]:
    """Run all checks; one that raises becomes a note."""
    results: list[DoctorCheck] = []
    for check in CHECKS:
        try:
            results.extend(check())
        except Exception as error:
            results.append(
                DoctorCheck(Severity.NOTE, check.__name__.removeprefix("check_"), f"could not be checked: {error}")
            )
    return results


def warm() -> list[DoctorCheck]:
    """Compile and cache the kernels of every installed room, each `warm` then runs from the cache."""
    from kiteline_hw.system import kernel_cache

    start_s = time.perf_counter()
    names = [name for name in WARMING if importlib.util.find_spec(name.split(".")[0]) is not None]
    modules = [importlib.import_module(name) for name in names]
    kernel_cache.fill(names)
    results = []
    for name, module in zip(names, modules):
        module.warm()
        results.append(DoctorCheck(Severity.OK, "warm", f"{name.split('.')[0]}: {time.perf_counter() - start_s:.1f} s"))
        start_s = time.perf_counter()
    kernel_cache.mark()
    return results


def main(argv: list[str]) -> int:
    """Run `kiteline doctor`; exit status 1 if a check fails."""
    p = argparse.ArgumentParser(
        prog="kiteline doctor", description="Check this machine, and say how to mend what fails."
    )
    p.add_argument(
        "--warm", action="store_true", help="compile and cache all kernels, so that agent and base start quickly"
    )
    p.add_argument("--mavlink", metavar="URL", help="check the flight controller there too; the agent must not run")
    p.add_argument("--mavlink-key", metavar="FILE", default="", help="key of its signatures, as the agent's")
    p.add_argument("--camera", metavar="SOURCE", help="watch these cameras for some seconds; the agent must not run")
    p.add_argument("--calibration", metavar="FILE[,FILE]", default="", help="of the cameras, as the agent's")
    p.add_argument("--json", action="store_true", help="print the results as JSON")
    a = p.parse_args(argv)
    warmed = warm() if a.warm else []  # first, so that the checks find the kernels compiled
    results = [found for found in run_checks() if not (a.mavlink and found == _NOT_ASKED)]
    if a.mavlink:
        process.print_lines(["asking the flight controller, for some ten seconds"])
        results += check_controller(a.mavlink, a.mavlink_key)
    if a.camera:
        process.print_lines(["watching the cameras, for some seconds"])
        results += _cameras(a.camera, a.calibration)
    results += warmed
    if a.json:
        lines = [{**asdict(f), "severity": f.severity.name.lower()} for f in results]
        print(json.dumps({"failed": any(f.severity is Severity.FAIL for f in results), "checks": lines}, indent=1))
    else:
        _print(results)
    return 1 if any(f.severity is Severity.FAIL for f in results) else 0


def _cameras(spec: str, calibration: str) -> list[DoctorCheck]:
    from kiteline_hw.ports import SourceError
    from kiteline_lab.tools.checks.cameras import check_cameras

    try:
        return check_cameras(spec, calibration)
    except SourceError as error:
        return [DoctorCheck(Severity.FAIL, "cameras", str(error))]


def _print(results: list[DoctorCheck]) -> None:
    width = max(len(f.name) for f in results)
    for f in results:
        print(f"{f.severity.value:>4}  {f.name:{width}}  {f.text}")
        if f.remedy:
            print(f"{'':>4}  {'':{width}}  -> {f.remedy}")


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
