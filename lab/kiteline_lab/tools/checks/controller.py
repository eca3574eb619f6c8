"""`kiteline doctor --mavlink URL`: check a flight controller."""

from kiteline_lab.tools.checks.check import DoctorCheck, Severity


def check_controller(url: str, key: str = "") -> list[DoctorCheck]:
    """Ask the flight controller at a URL for all that decides whether it can fly on poses. Raises LinkError.

    key: a file with the key of MAVLink's signatures; "": none.
    """
    from kiteline_hw.mavlink.surveyor import survey_controller
    from kiteline_hw.mavlink.watch.findings import FindingLevel
    from kiteline_hw.mavlink.watch.presence import RETRIED  # an agent tries again, this check does not
    from kiteline_hw.system.clock import MonotonicClock

    severities = {
        FindingLevel.ERROR: Severity.FAIL,
        FindingLevel.WARNING: Severity.NOTE,
        FindingLevel.INFO: Severity.OK,
    }
    found = survey_controller(url, MonotonicClock(), key)
    return [DoctorCheck(severities[f.level], f.topic, f.text, f.remedy.removesuffix(f". {RETRIED}")) for f in found]
