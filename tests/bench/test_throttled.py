"""Tables and bars of throttled flights, from made-up ones."""

from pathlib import Path

import numpy as np
import pytest

from kiteline_bench.harness.bars import Bar, Bench, FlightFailed
from kiteline_bench.papers.ds_ptam import PERCENTS, _unless_failed, table, throttled_bars
from kiteline_bench.papers.throttled import MODES, NO_ERRORS, Errors, Throttled, paper_errors
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_lab.flights.flight_report import write_tum


def flight(mode: str, percent: float, max_abs_m: float, dropped: int) -> Throttled:
    errors = Errors(max_abs_m, 0.01, 0.002, 1.0, 0.2, 0.05)
    return Throttled(mode, percent, errors, 0.1, 100, 100 - dropped, 0, dropped, 1, 20.0, 0, None)


def test_errors_are_the_papers(tmp_path: Path) -> None:
    n = 20
    t_ns = 50_000_000 * np.arange(n, dtype=np.int64)
    truth = np.array([se3.from_rt(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(n)])
    offset = se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 0.3])), np.array([5.0, 1.0, 0.0]))
    found = truth.copy()
    found[10:, 1, 3] += 0.2  # a jump, which stays
    write_tum(tmp_path / "live.tum", list(zip(t_ns.tolist(), offset @ found, strict=True)))
    errors, live = paper_errors(tmp_path / "live.tum", Trajectory(t_ns, truth))
    assert live is not None
    assert (errors.max_abs_m, errors.max_rel_m) == pytest.approx((0.2, 0.2), abs=1e-5)
    assert errors.rmse_rel_m == pytest.approx(0.2 / np.sqrt(n - 1), abs=1e-5)
    assert errors.max_abs_deg == pytest.approx(0.0, abs=1e-3)
    short, _ = paper_errors(tmp_path / "live.tum", Trajectory(t_ns, truth), until_m=0.55)
    assert short.max_abs_m == pytest.approx(0.0, abs=1e-5)
    assert paper_errors(tmp_path / "none.tum", Trajectory(t_ns, truth)) == (NO_ERRORS, None)
    (tmp_path / "empty.tum").touch()
    assert paper_errors(tmp_path / "empty.tum", Trajectory(t_ns, truth)) == (NO_ERRORS, None)


def test_a_part_that_cannot_be_flown_is_a_bar_that_is_not_met(tmp_path: Path) -> None:
    def part(bench: Bench) -> list[Bar]:
        raise FlightFailed("base ended")

    [bar] = _unless_failed(Bench(tmp_path, tmp_path, lambda _: None), "street", part)
    assert (bar.met, bar.measured) == (False, "base ended")


def test_bars_say_what_one_computer_loses() -> None:
    flights = {(mode, percent): [flight(mode, percent, 0.2, 0)] for mode in MODES for percent in PERCENTS}
    assert all(bar.met for bar in throttled_bars("room", flights))
    assert "loses nothing" in throttled_bars("room", flights)[1].measured
    flights["local", 25.0] = [flight("local", 25.0, 0.5, 40)]
    flights["distributed", 25.0] = [flight("distributed", 25.0, 0.31, 0)]
    ratio, said = throttled_bars("room", flights)[:2]
    assert not ratio.met
    assert said.measured == "loses: 40 % of the frames without a pose and 0.500 m, distributed 0 % and 0.310 m"
    text = table("room", flights)
    assert "| 25 | tracker + mapper, one computer | 0.500 |" in text
