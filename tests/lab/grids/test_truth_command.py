"""`kiteline grid truth`: the true grid of a simulated flight, and of a recording with a list of its solids."""

from pathlib import Path

import numpy as np
import pytest

from kiteline_hw.ports import SourceError
from kiteline_lab.flights.simulate import main as simulate
from kiteline_lab.grids.files import read_grid
from kiteline_lab.grids.truth import main

SCENE = "room?scale=0.2&texture_bits=7&seconds=1.0"


def test_a_simulated_flight_and_its_recording_have_the_same_truth(tmp_path: Path) -> None:
    assert simulate([SCENE, "--out", str(tmp_path / "f.mcap")]) == 0
    assert main([f"sim:{SCENE}", "--out", str(tmp_path / "t.yaml")]) == 0
    for part in ("", "_seen", "_seen_0.1-0.5", "_seen_0.5-1.2", "_seen_1.2-2"):
        assert (tmp_path / f"f{part}.pgm").read_bytes() == (tmp_path / f"t{part}.pgm").read_bytes()


def test_a_recording_needs_the_list_of_its_solids(tmp_path: Path) -> None:
    simulate([SCENE, "--out", str(tmp_path / "f.mcap")])
    with pytest.raises(SourceError, match="--boxes"):
        main([str(tmp_path / "f.mcap"), "--out", str(tmp_path / "t.yaml")])
    (tmp_path / "b.csv").write_text("0,0,1.5,6,6,1.5,0\n")
    assert main([str(tmp_path / "f.mcap"), "--boxes", str(tmp_path / "b.csv"), "--out", str(tmp_path / "t.yaml")]) == 0
    everything, seen = read_grid(tmp_path / "t.yaml"), read_grid(tmp_path / "t_seen.yaml")
    assert (everything.state == 0).sum() == pytest.approx(12 * 12 / 0.05**2, rel=0.02)
    assert 0 < (seen.state == 0).sum() < 0.5 * (everything.state == 0).sum()
    assert main([f"sim:{SCENE}", "--out", str(tmp_path / "s.yaml"), "--range", "1.0", "--cell", "0.1"]) == 0
    near = read_grid(tmp_path / "s_seen.yaml")
    assert near.cell_m == 0.1 and np.isin(near.state, (-1, 0, 100)).all()


@pytest.mark.parametrize("cell", ["1e-5", "nan", "inf"])
def test_cells_that_no_memory_holds_are_refused(cell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([f"sim:{SCENE}", "--out", str(tmp_path / "t.yaml"), "--cell", cell])
    assert left.value.code == 2
    assert "side of a cell" in capsys.readouterr().err
