"""An agent's process with a modelled pair of cameras in place of real ones, and what a vehicle's bench starts."""

import contextlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from kiteline_core.frame import Frame
from kiteline_hw.cameras import v4l2
from kiteline_hw.sim.sensors.video_device import ModelDevice, ModelKernel
from kiteline_hw.sources.open import open_source

FPS = 20.0
OUT, BACK = "cameras unplugged at ", "cameras plugged in at "  # ns follow
_SHOWN = 200  # frames of the recording that the cameras show, to and fro
_WARM_FRAMES = 40  # delivered before the times of faults count
_NICE = -10  # as in systemd/kiteline-agent.service: what else this machine does counts little


def command(recording: str, faults_s: str, options: list[str]) -> list[str]:
    """Arguments of Python. faults_s: "A,B": both cameras are unplugged from A to B; "": they are not."""
    return ["-m", __name__, recording, faults_s, *options]


def start(
    stack: contextlib.ExitStack, arguments: list[str], text: Path, cores: set[int] | None = None, *, prefer: bool = True
) -> subprocess.Popen[bytes]:
    """Start Python, on some cores; what it prints goes to a file. It ends with the stack."""
    out = stack.enter_context(text.open("wb"))
    child = subprocess.Popen([sys.executable, *arguments], stdout=out, stderr=out)
    if cores:
        os.sched_setaffinity(child.pid, cores)
    if prefer:
        favour(child.pid)

    def end() -> None:
        child.kill()
        child.wait()

    stack.callback(end)
    return child


def favour(pid: int) -> None:
    """Give a process the priority of the service, where that is allowed."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, pid, _NICE)


def main(recording: str, faults_s: str, options: list[str]) -> int:
    """Fly with modelled devices that show a recording."""
    from kiteline_agent.__main__ import main as fly

    frames: list[Frame] = []
    for item in open_source(recording):
        if isinstance(item, Frame):
            frames.append(item)
        if len(frames) == _SHOWN:
            break
    height, width = frames[0].left.shape
    around = [*frames, *frames[-2:0:-1]]
    images = [[np.asarray(side).tobytes() for side in (f.left, f.right)] for f in around[:_SHOWN]]

    def of(side: int, k: int) -> bytes:
        turn = k % len(around)
        return images[min(turn, len(around) - turn)][side]

    left = ModelDevice(lambda k: of(0, k), {"GREY": [(width, height)]}, FPS)
    right = ModelDevice(lambda k: of(1, k), {"GREY": [(width, height)]}, FPS)
    left.begin_ns = right.begin_ns = time.monotonic_ns()
    v4l2.KERNEL = ModelKernel({"/dev/video0": left, "/dev/video2": right})
    if faults_s:
        out_s, back_s = (float(text) for text in faults_s.split(","))
        threading.Thread(target=_fail, args=([left, right], out_s, back_s), daemon=True).start()
    return fly([f"v4l2:/dev/video0,/dev/video2?fps={FPS:g}&calibration={recording}", *options])


def _fail(devices: list[ModelDevice], out_s: float, back_s: float) -> None:
    while devices[0].delivered < _WARM_FRAMES:
        time.sleep(0.01)
    begin_s = time.monotonic()
    time.sleep(out_s)
    for device in devices:
        device.unplug()
    print(f"{OUT}{time.monotonic_ns()}", flush=True)
    time.sleep(max(0.0, begin_s + back_s - time.monotonic()))
    print(f"{BACK}{time.monotonic_ns()}", flush=True)
    for device in devices:
        device.plug()


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1], sys.argv[2], sys.argv[3:]))
