"""`make demo`: simulate a short flight, run agent and base on it over a real link, and evaluate the result."""

import argparse
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from kiteline_lab.evaluation.metrics import Evaluation
from kiteline_lab.tools.doctor import WARMING
from kiteline_lab.tools.evaluate import evaluate_files

SCENE = "room"  # four walls, furniture, a window: similar to EuRoC's Vicon room
SECONDS = 8.0  # long enough to see the room, short enough to wait for
SEED = 7


def demo(folder: Path, seconds: float = SECONDS) -> str:
    """Record, fly and evaluate in `folder`; returns the table of results."""
    from kiteline_lab.flights import fly, simulate

    folder.mkdir(parents=True, exist_ok=True)
    recording, out = folder / "flight.mcap", folder / "flight"
    _step(f"1/3  a drone flies {seconds:g} s through a simulated {SCENE}: {recording}")
    with _compiling():
        _must(simulate.main([f"{SCENE}?seed={SEED}&seconds={seconds:g}", "--out", str(recording)]), "simulation")
    _step(f"2/3  the recording is flown again: an agent and a base, two processes with a link between: {out}")
    _must(fly.main([f"mcap:{recording}", "--out", str(out), "--mode", "distributed"]), "flight")
    _step("3/3  the estimated trajectories against ground truth")
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    truth = f"mcap:{recording}"
    live = evaluate_files(str(out / "agent0" / "live.tum"), truth)
    base = evaluate_files(str(out / "base" / "agent0.tum"), truth)
    return summary(report["agents"][0], live, base)


def summary(agent: dict[str, object], live: Evaluation, base: Evaluation) -> str:
    """Table of the errors, frames and bytes. agent: the agent's part of report.json."""
    rows = [f"{'':22}{'ATE rmse':>10}{'max':>9}{'per frame':>11}{'':>10}"]
    for name, e in (("live, on the drone", live), ("refined, on the base", base)):
        step = e.rpe_frame
        relative = f"{1e3 * step.translation_m.rmse:7.1f} mm{step.rotation_deg.rmse:8.3f}°" if step else ""
        rows.append(f"{name:22}{1e3 * e.ate_m.rmse:7.1f} mm{1e3 * e.ate_m.max:6.0f} mm {relative}")
    kilobytes = float(str(agent["bytes_per_keyframe"])) / 1e3
    rows.append(f"{agent['tracked']} of {agent['frames']} frames tracked over {base.path_m:.1f} m of path")
    rows.append(f"{agent['keyframes']} keyframes went up the link, {kilobytes:.1f} kB each")
    return "\n".join(rows)


def main(argv: list[str]) -> int:
    """Run the demo; the exit status."""
    p = argparse.ArgumentParser(prog="make demo", description=(__doc__ or "").strip())
    p.add_argument("--out", type=Path, default=Path("demo"), help="output folder (default %(default)s)")
    p.add_argument("--seconds", type=float, default=SECONDS, help="length of the flight (default %(default)s)")
    a = p.parse_args(argv)
    start_s = time.monotonic()
    text = demo(a.out, a.seconds)
    print(f"\n{text}\n\nplot    {(a.out / 'flight' / 'trajectory.png').resolve()}")
    print(f"folder  {(a.out / 'flight').resolve()}   ({time.monotonic() - start_s:.0f} s)")
    return 0


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    """Compile the kernels during the block, and wait for them at its end. If it fails, the flight compiles them."""
    with subprocess.Popen([sys.executable, "-m", "kiteline_hw.system.kernel_compilation", *WARMING]) as compiler:
        try:
            yield
            compiler.wait()
        finally:
            compiler.kill()


def _step(text: str) -> None:
    print(f"\n{text}", flush=True)


def _must(status: int | None, what: str) -> None:
    if status:
        raise SystemExit(f"kiteline: error: the {what} ended with status {status}; see its messages above")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
