"""Checks of the computer on a vehicle: time, disk, temperature, and what a Raspberry Pi says of its power."""

import shutil
from collections.abc import Iterable
from pathlib import Path

from kiteline_lab.tools.checks.check import DoctorCheck, Severity

LEAST_DISK_MIB, GOOD_DISK_MIB = 500, 5_000  # a log with images takes 1 to 3 MB a second
HOT_C, WARM_C = 80.0, 70.0  # a Raspberry Pi slows down at 80 and stops its turbo
SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
TIMESYNCD = Path("/run/systemd/timesync")
THERMAL = Path("/sys/class/thermal")
CLOCK_DEVICES = Path("/sys/class/rtc")
THROTTLED = (
    Path("/sys/devices/platform/soc/soc:firmware/get_throttled"),
    Path("/sys/devices/platform/soc@107c000000/soc@107c000000:firmware/get_throttled"),
)
_THROTTLING = {  # bits of get_throttled: now; 16 higher: since the start
    0: "under-voltage",
    1: "clock capped",
    2: "throttled",
    3: "at its soft temperature limit",
}


def check_time() -> Iterable[DoctorCheck]:
    """Check whether the wall clock is set by the network, and goes on without power."""
    has_clock = CLOCK_DEVICES.is_dir() and any(CLOCK_DEVICES.iterdir())
    if SYNCHRONISED.exists():
        yield DoctorCheck(Severity.OK, "time", "the wall clock is synchronised")
    elif TIMESYNCD.is_dir():
        text = "the wall clock is not synchronised" + (
            "" if has_clock else ", and there is none that runs without power"
        )
        remedy = "connect a network once (timedatectl), or add a battery clock: logs and signatures need the date"
        yield DoctorCheck(Severity.NOTE, "time", text, remedy)
    elif not has_clock:
        yield DoctorCheck(Severity.NOTE, "time", "no clock that runs without power", "set the date before a flight")


def check_disk() -> Iterable[DoctorCheck]:
    """Check that there is room for logs."""
    from kiteline_hw.system.process import state_folder

    folder = state_folder()
    place = next(p for p in (folder, *folder.parents) if p.exists())
    free_mib = shutil.disk_usage(place).free // 2**20
    text = f"{free_mib} MiB free for logs in {folder}"
    if free_mib < LEAST_DISK_MIB:
        yield DoctorCheck(Severity.FAIL, "disk", text, "remove old logs, or choose another place with --log")
    elif free_mib < GOOD_DISK_MIB:
        yield DoctorCheck(Severity.NOTE, "disk", text, "a log with images takes 1 to 3 MB a second: remove old ones")
    else:
        yield DoctorCheck(Severity.OK, "disk", text)


def check_temperature() -> Iterable[DoctorCheck]:
    """Check the processor's temperature."""
    read = []
    for zone in THERMAL.glob("thermal_zone*/temp"):
        try:
            read.append(int(zone.read_text()) / 1000.0)
        except (OSError, ValueError):
            continue
    plausible = [t for t in read if -40.0 < t < 150.0]
    if not plausible:
        return
    hottest = max(plausible)
    text = f"{hottest:.0f} degrees"
    remedy = "a heat sink and a fan, or less load (--cpu)"
    if hottest >= HOT_C:
        yield DoctorCheck(Severity.FAIL, "temperature", f"{text}: the processor slows down", remedy)
    elif hottest >= WARM_C:
        yield DoctorCheck(Severity.NOTE, "temperature", f"{text}; it slows down at {HOT_C:.0f}", remedy)
    else:
        yield DoctorCheck(Severity.OK, "temperature", text)


def check_power() -> Iterable[DoctorCheck]:
    """Check what a Raspberry Pi says of under-voltage and throttling; nothing elsewhere."""
    path = next((p for p in THROTTLED if p.exists()), None)
    if path is None:
        return
    bits = int(path.read_text().strip(), 16)
    now = [text for bit, text in _THROTTLING.items() if bits >> bit & 1]
    before = [text for bit, text in _THROTTLING.items() if bits >> (bit + 16) & 1]
    remedy = "a supply of 5.1 V and 3 A (5 A for a Pi 5) with short wires, not the flight controller's; and cooling"
    if now:
        yield DoctorCheck(Severity.FAIL, "power", f"now: {', '.join(now)}", remedy)
    elif before:
        yield DoctorCheck(Severity.NOTE, "power", f"since the start: {', '.join(before)}", remedy)
    else:
        yield DoctorCheck(Severity.OK, "power", "no under-voltage or throttling since the start")
