"""Fly agent and base on small file systems that are filled at random instants. Run in a mount name space of its own."""

import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from kiteline_lab.flights.processes import free_endpoint

_TOLD = "log: it waits for the disk"
_SIZE_MIB = {"agent": 64, "base": 24, "store": 12}
_TRACKED = re.compile(r"over: (\d+) frames: (\d+) tracked")
_KEYFRAMES = re.compile(r"stopped: (\d+) keyframe")


class SmallDisks:
    """A tmpfs each for the agent's log, the base's log and the store."""

    def __init__(self, root: Path) -> None:
        self.folders = {name: root / name for name in _SIZE_MIB}
        for name, folder in self.folders.items():
            folder.mkdir(parents=True)
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_SIZE_MIB[name]}m", "none", folder], check=True)

    def fill(self) -> None:
        """Leave no byte free."""
        for folder in self.folders.values():
            fd = os.open(folder / "ballast", os.O_WRONLY | os.O_CREAT)
            with contextlib.suppress(OSError):
                while True:
                    os.write(fd, bytes(1 << 16))
            with contextlib.suppress(OSError):
                while True:
                    os.write(fd, bytes(1))
            os.close(fd)

    def empty(self) -> None:
        """Free what `fill` took."""
        for folder in self.folders.values():
            (folder / "ballast").unlink(missing_ok=True)


def _start(out: Path, name: str, *words: object) -> subprocess.Popen[bytes]:
    with (out / f"{name}.txt").open("wb") as said:
        return subprocess.Popen(
            [sys.executable, "-m", "kiteline_cli", *map(str, words)], stderr=said, stdout=said,
            env={**os.environ, "XDG_STATE_HOME": str(out / "disks" / "agent" / "state")},
        )  # fmt: skip


def _pair(out: Path, disks: SmallDisks, name: str, recording: str) -> tuple[subprocess.Popen[bytes], ...]:
    link = f"zenoh:{free_endpoint()}"
    base = _start(out, f"base{name}", "base", "--link", link, "--store", disks.folders["store"] / "map",
                  "--log", disks.folders["base"], "--log-mib", 0)  # fmt: skip
    _await(out / f"base{name}.txt", "base on", base)
    agent = _start(out, f"agent{name}", "agent", recording, "--link", link, "--log", disks.folders["agent"],
                   "--log-mib", 0)  # fmt: skip
    _await(out / f"agent{name}.txt", "first pose", agent)
    return agent, base


def _await(path: Path, text: str, process: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + 200.0
    while text not in path.read_text(errors="replace"):
        if process.poll() is not None or time.monotonic() > end_s:
            raise SystemExit(f"{path.name}: no {text!r}: {path.read_text(errors='replace')[-300:]}")
        time.sleep(0.05)


def main(recording: str, out: Path, instants: int) -> None:
    """Fly once with disks that are full now and then, and once from the start on full disks."""
    disks, draw = SmallDisks(out / "disks"), random.Random(1)
    agent, base = _pair(out, disks, "", recording)
    begin_s, full_s, fills = time.monotonic(), 0.0, 0
    while fills < instants and agent.poll() is None:
        time.sleep(draw.uniform(0.05, 0.8))
        held_s = draw.uniform(0.05, 0.5)
        disks.fill()
        time.sleep(held_s)
        disks.empty()
        full_s, fills = full_s + held_s, fills + 1
    codes = [agent.wait(200)]
    flown_s = time.monotonic() - begin_s
    time.sleep(2.0)
    base.send_signal(signal.SIGTERM)
    codes.append(base.wait(60))
    for name in ("agent", "base"):
        shutil.copytree(disks.folders[name], out / "logs" / name)
    shutil.copytree(disks.folders["store"] / "map", out / "store")
    disks.fill()
    agent, base = _pair(out, disks, "_full", recording)
    codes.append(agent.wait(200))
    base.send_signal(signal.SIGTERM)
    base.wait(60)  # with status 1: what it learned could not be stored
    said = {name: (out / f"{name}.txt").read_text(errors="replace") for name in ("agent", "base")}
    again = (out / "agent_full.txt").read_text(errors="replace")
    lines = {name: [*text.splitlines(), *(out / f"{name}_full.txt").read_text(errors="replace").splitlines()]
             for name, text in said.items()}  # fmt: skip
    kept = _KEYFRAMES.search(said["base"])
    flown = _TRACKED.search(again)
    (out / "found.json").write_text(
        json.dumps({
            **lines, "codes": codes, "fills": fills, "full_s": full_s, "flown_s": flown_s,
            "told": [said["agent"].count(_TOLD), said["base"].count(_TOLD)],
            "keyframes": 0 if kept is None else int(kept[1]), "restarted": 0 if flown is None else int(flown[2]),
        })
    )  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
