"""`kiteline convert SOURCE OUT.mcap`: write any source as a log, without coding its images again."""

import argparse
from pathlib import Path

from kiteline_core.frame import Frame, ImuBatch, Trajectory
from kiteline_core.wording import counted
from kiteline_hw.logs.mcap_log import GROUND_TRUTH, IMU, ODOMETER, LogWriter
from kiteline_hw.ports import FrameSource
from kiteline_hw.sources.kinds import source_forms
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.progress import Progress
from kiteline_lab.outputs.out_file import expect_nothing_lost, whole_file


def main(argv: list[str]) -> int:
    """Run `kiteline convert`; the exit status. Raises SourceError."""
    p = argparse.ArgumentParser(prog="kiteline convert", description="Turn a data set or a ROS 2 bag into a log.")
    p.add_argument("source", metavar="SOURCE", help=source_forms())
    p.add_argument("out", metavar="OUT.mcap", type=Path)
    p.add_argument("--mono", action="store_true", help="left images only")
    p.add_argument("--no-imu", dest="imu", action="store_false", help="without inertial samples")
    p.add_argument(
        "--calibration", metavar="FILE[,FILE]", default="", help="in place of what SOURCE says of its cameras"
    )
    p.add_argument("--force", action="store_true", help="overwrite OUT.mcap")
    o = p.parse_args(argv)
    with whole_file(o.out, force=o.force) as part:
        source = open_source(o.source, mono=o.mono, imu=o.imu, calibration=o.calibration)
        try:
            frames, samples = record(source, part)
        finally:
            source.close()
    print(f"{o.out}: {counted(frames, 'frame')}, {counted(samples, 'imu sample')}, {o.out.stat().st_size / 1e6:.1f} MB")
    for reason, count in sorted(source.report.skipped.items()):
        print(f"  skipped: {count} x {reason}")
    for note in source.report.notes:
        print(f"  {note}")
    return 0


def record(source: FrameSource, path: Path) -> tuple[int, int]:
    """Write everything that a source delivers; the numbers of frames and inertial samples. Raises SourceError."""
    frames, samples, begun = 0, 0, False
    truth = _Truth(source.ground_truth)
    with (
        LogWriter(path, {"role": "recording", "source": source.name}) as log,
        Progress("converting", source.frame_count, "frames") as progress,
    ):
        for item in source:
            if not begun:
                log.rig(item.t_ns if isinstance(item, Frame) else int(item.t_ns[0]), source.rig, source.imu)
                begun = True
            if isinstance(item, ImuBatch):
                log.imu(IMU, int(item.t_ns[-1]), item)
                samples += len(item.t_ns)
                continue
            if not isinstance(item, Frame):
                log.odometer(ODOMETER, int(item.t_ns[-1]), item)
                continue
            truth.write(log, item.t_ns)
            log.frame(item)
            frames += 1
            progress.update(frames)
            expect_nothing_lost(log, path)
        truth.write(log, None)
    expect_nothing_lost(log, path)
    return frames, samples


class _Truth:
    """Writes ground-truth poses in between the frames, in order of time."""

    def __init__(self, truth: Trajectory | None) -> None:
        self._truth = truth
        self._next = 0

    def write(self, log: LogWriter, until_ns: int | None) -> None:
        truth = self._truth
        while truth is not None and self._next < len(truth.t_ns):
            t_ns = int(truth.t_ns[self._next])
            if until_ns is not None and t_ns > until_ns:
                return
            log.pose(GROUND_TRUTH, t_ns, "world", truth.T_w_b[self._next])
            self._next += 1
