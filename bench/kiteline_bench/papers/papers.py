"""`kiteline bench papers`: each paper's experiments beside kiteline's."""

from kiteline_bench.harness.bars import Run
from kiteline_bench.papers import ds_ptam, ekf, governor, sequences
from kiteline_bench.papers.logs import logs
from kiteline_bench.papers.segfloor import segfloor
from kiteline_bench.papers.several_maps import several_maps

PARTS: dict[str, tuple[str, Run]] = {
    "ekf": (ekf.TITLE, ekf.run),
    "ds-ptam": (ds_ptam.TITLE, ds_ptam.run),
    "governor": (governor.TITLE, governor.run),
    "logs": (logs.TITLE, logs.run),
    "multi-map": (several_maps.TITLE, several_maps.run),
    "segfloor": (segfloor.TITLE, segfloor.run),
    "sequences": (sequences.TITLE, sequences.run),
}
