"""Checks of the files of keys that seal packets: the user's own, and those that the services name."""

import os
from collections.abc import Iterable
from pathlib import Path

from kiteline_hw.ports import LinkError
from kiteline_hw.system.key_store import default_path, read_file
from kiteline_lab.tools.checks.check import DoctorCheck, Severity

OF_SERVICES = (Path("/etc/kiteline/agent.key"), Path("/etc/kiteline/base.key"))


def check_keys() -> Iterable[DoctorCheck]:
    """Check that files of keys can be read by this user alone, and name agents."""
    files = [path for path in (default_path(), *OF_SERVICES) if os.path.lexists(path)]
    if not files:
        text = f"none in {default_path()}: needed for links beyond this machine"
        yield DoctorCheck(Severity.NOTE, "keys", text, "kiteline keys pair N, at the base first")
    for path in files:
        try:
            keys = read_file(path)
        except LinkError as error:
            yield DoctorCheck(Severity.FAIL, "keys", str(error))
            continue
        agents = f"{len(keys.agents)} agents" if len(keys.agents) != 1 else f"agent {next(iter(keys.agents))}"
        maps = "" if keys.maps is None else ", and of the right to change maps"
        yield DoctorCheck(Severity.OK, "keys", f"{path}: of {agents}{maps}")
