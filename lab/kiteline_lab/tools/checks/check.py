"""The result of one check of `kiteline doctor`."""

from dataclasses import dataclass
from enum import Enum


class Severity(Enum):
    """How bad the result of a check is."""

    OK = "ok"
    NOTE = "note"  # good to know
    FAIL = "FAIL"  # kiteline, or a part of it, will not work


@dataclass(frozen=True, slots=True)
class DoctorCheck:
    """Result of one check. remedy: what to do about it, empty if nothing."""

    severity: Severity
    name: str
    text: str
    remedy: str = ""
