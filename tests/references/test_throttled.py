"""The kept flight again on a small share of a modelled core: within its budget, and still where it should be."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from kiteline_hw.logs.mcap_log import LogReader
from kiteline_lab.evaluation import metrics, trajectories
from kiteline_lab.flights.in_process import fly_in_process
from kiteline_lab.flights.plan import Options, plan
from kiteline_lab.references.flights import IMAGES

RECORDING = Path(__file__).parent / "kept" / IMAGES
SECOND_NS = 1_000_000_000


@pytest.mark.parametrize(
    ("mode", "percent", "least_tracked"), [("tracker", 3.0, 0.6), ("local", 5.0, 0.5)], ids=["alone", "one computer"]
)
def test_a_throttled_flight_keeps_budget_and_accuracy(
    tmp_path: Path, mode: str, percent: float, least_tracked: float
) -> None:
    made = plan(Options((str(RECORDING),), tmp_path, mode, cpu_percent=percent), quiet=True)
    with contextlib.closing(made):
        agent = fly_in_process(made, mode).agents[0]
    assert agent["tracked"] + agent["dropped"] + agent["lost"] == agent["frames"] == 32
    assert agent["lost"] == 0
    assert least_tracked <= agent["tracked"] / agent["frames"] < 0.9, "the budget should bind, and not choke"
    with LogReader(tmp_path / "agent0" / "log.mcap") as log:
        heads = [message.json() for message in log.messages(["/step"])]
    begun = np.array([head["now_ns"] for head in heads if head["frame_ns"] is not None])
    cost_ns = np.array([head["cpu_ns"] for head in heads if head["frame_ns"] is not None])[1:]  # of the frame before
    windows = [cost_ns[(begun[:-1] >= t) & (begun[:-1] < t + SECOND_NS)].sum() for t in begun]
    assert max(windows) <= 1.05 * percent / 100.0 * SECOND_NS
    truth = trajectories.read(f"mcap:{RECORDING}").trajectory
    live = trajectories.read(str(tmp_path / "agent0" / "live.tum")).trajectory
    assert metrics.evaluate(live, truth).ate_m.rmse < 0.02
