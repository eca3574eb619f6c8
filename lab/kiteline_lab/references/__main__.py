"""`make refs`: replay the kept logs, say what changed, and write the expected outputs anew.

`make refs LOGS=new` simulates and flies the kept flights anew first; `make refs NAMES="rgbd ekf"` takes only some.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

import cv2

from kiteline_hw.logs.machine import machine
from kiteline_lab.references.comparison import TOLERANCE, differences
from kiteline_lab.references.flights import FOLDER, KeptFlight, by_name, make_logs
from kiteline_lab.references.observation import Observation, from_text, to_text
from kiteline_lab.references.replays import replay


def expected_file(folder: Path, flight: KeptFlight) -> Path:
    """The expected outputs of a flight."""
    return folder / f"{flight.name}.txt"


def changes(folder: Path, flight: KeptFlight, found: Observation) -> list[str]:
    """What a replay computed differently: every digit on the machine of the kept text, else beyond the tolerance."""
    kept = from_text(expected_file(folder, flight).read_text(encoding="utf-8"))
    return differences(kept, found, None if kept.machine == found.machine else TOLERANCE)


def renew(folder: Path, flight: KeptFlight) -> bool:
    """Replay a flight twice and write its expected outputs; True if both replays agree."""
    found = replay(folder, flight)
    if unequal := differences(found, replay(folder, flight), None):
        print(f"{flight.name}: two replays differ, nothing is written", *unequal, sep="\n  ")
        return False
    file = expected_file(folder, flight)
    kept = from_text(file.read_text(encoding="utf-8")) if file.exists() else None
    lines = ["new"] if kept is None else differences(kept, found, None)
    if kept is not None and not lines:
        lines = ["as kept"] if to_text(found) == to_text(kept) else ["as kept, but for what it was made with"]
    print(f"{flight.name}: {lines[0]}", *lines[1:], sep="\n  ")
    file.write_text(to_text(found), encoding="utf-8")
    return True


def check(folder: Path, flight: KeptFlight) -> bool:
    """Compare a replay with the kept text; True if it is as kept."""
    lines = changes(folder, flight, replay(folder, flight))
    print(f"{flight.name}: {lines[0] if lines else 'as kept'}", *lines[1:], sep="\n  ")
    return not lines


def main(argv: list[str]) -> int:
    """Run the command; 1 where a flight differs from its kept text (--check), or from a second replay."""
    p = argparse.ArgumentParser(prog="make refs", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    p.add_argument("names", metavar="NAME", nargs="*", help="of kept flights (default: all)")
    p.add_argument("--folder", type=Path, default=FOLDER, help="of logs and expected outputs (default: %(default)s)")
    p.add_argument("--logs", choices=("kept", "new"), default="kept", help="new: simulate and fly them anew")
    p.add_argument("--out", metavar="DIR", type=Path, help="only replay once and write the outputs here")
    p.add_argument("--check", action="store_true", help="only compare")
    a = p.parse_args(argv)
    try:
        flights = tuple(by_name(a.names))
    except ValueError as error:
        p.error(str(error))
    cv2.setNumThreads(1)
    if a.out is not None:
        a.out.mkdir(parents=True, exist_ok=True)
        for flight in flights:
            expected_file(a.out, flight).write_text(to_text(replay(a.folder, flight)), encoding="utf-8")
        return 0
    if a.check:
        return int(not all(list(map(partial(check, a.folder), flights))))
    if a.logs == "new":
        make_logs(a.folder, flights, images=not a.names)
    agree = all(list(map(partial(renew, a.folder), flights)))
    print(f"made with: {machine()}\nwanted? Commit {a.folder} alone, with these lines as the message.")
    return int(not agree)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
