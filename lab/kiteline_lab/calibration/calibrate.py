"""`kiteline calibrate camera|board|imu|export`: cameras by a board, IMUs by a motion; boards and conversions."""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from kiteline_core.arguments import period
from kiteline_core.arrays import U8
from kiteline_core.errors import KitelineError
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch
from kiteline_core.wording import counted
from kiteline_hw.calibration.file_calibration import UNCALIBRATED, FileCalibration
from kiteline_hw.calibration.files import FORMS, read_calibration
from kiteline_hw.calibration.own import texts as own_texts
from kiteline_hw.sources.kinds import source_forms
from kiteline_hw.sources.open import open_source
from kiteline_lab.calibration import boards, imu
from kiteline_lab.calibration.best_lens import best_lens
from kiteline_lab.calibration.boards import Board, parse_board
from kiteline_lab.calibration.picture import residual_picture
from kiteline_lab.calibration.solve import Calibrated
from kiteline_lab.calibration.verdict import CalibrationFinding, judge, overall
from kiteline_lab.calibration.views import ViewCollector
from kiteline_lab.flights.progress import Progress
from kiteline_lab.outputs.out_file import whole_file, write_files, write_whole

_DPI = 300  # of a printed board
_M_AN_INCH = 0.0254


class NoBoard(KitelineError):
    """A source in which the board is not seen."""


def collect(
    items: Iterable[Frame | ImuBatch | OdometryBatch], collector: ViewCollector, every_s: float, until_complete: bool
) -> Iterable[int]:
    """Add frames of any source, a camera's too, to a collector; yields the number of frames after each one.

    every_s: s between two frames that are looked at. until_complete: end as soon as nothing is missing.
    """
    next_ns: int | None = None
    for item in items:
        if not isinstance(item, Frame) or (next_ns is not None and item.t_ns < next_ns):
            continue
        next_ns = item.t_ns + round(1e9 * every_s)
        collector.add(item.t_ns, (item.left, item.right))
        yield collector.frames
        if until_complete and collector.is_complete:
            return


def calibrated(
    collector: ViewCollector, board: Board, lens: str, coefficients: int
) -> tuple[Calibrated, list[CalibrationFinding]]:
    """The cameras of the collected views, and what the result is worth. Raises KitelineError."""
    sizes = [c.size for c in collector.coverage]
    result = best_lens(board.points_m, collector.views, sizes, lens, coefficients)
    return result, judge(result, collector.coverage, len(collector.views))


def main(argv: Sequence[str]) -> int:
    """Run `kiteline calibrate`; the exit status. Raises KitelineError."""
    args = _parser().parse_args(argv)
    run = {"camera": _camera, "board": _board, "imu": imu.run, "export": _export}
    return run[args.verb](args)


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="kiteline calibrate",
        description="Calibrate cameras by a printed board, and an IMU against them by a guided motion.",
    )
    verbs = p.add_subparsers(dest="verb", required=True, metavar="VERB")
    camera = verbs.add_parser("camera", help="calibrate a camera or a pair by images or a recording of the board")
    camera.add_argument("source", metavar="SOURCE", help=source_forms())
    camera.add_argument("--board", required=True, type=parse_board, metavar="BOARD", help=boards.FORMS)
    camera.add_argument("--out", type=Path, default=Path("calibration.yaml"), metavar="FILE",
                        help="the calibration file to write (default: calibration.yaml)")  # fmt: skip
    camera.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw where corners were and how they are missed"
    )
    camera.add_argument("--lens", choices=("auto", "radtan", "equidistant"), default="auto",
                        help="auto: the one that fits better; equidistant: for fisheyes")  # fmt: skip
    camera.add_argument("--coefficients", type=int, choices=(4, 5, 8), default=4, help="of a radtan lens (default: 4)")
    camera.add_argument("--mono", action="store_true", help="the left camera alone")
    camera.add_argument("--every", type=period, default=0.2, metavar="S",
                        help="s between two images that are looked at (default: 0.2; 0: all)")  # fmt: skip
    camera.add_argument("--until-complete", action="store_true", help="end as soon as nothing is missing")
    camera.add_argument("--calibration", default="", metavar="FILE[,FILE]",
                        help="keep the place and noise of the IMU of this calibration")  # fmt: skip
    camera.add_argument("--json", action="store_true", help="print the verdict as JSON")
    camera.add_argument("--force", action="store_true", help="overwrite --out")
    board = verbs.add_parser("board", help="draw a board to print")
    board.add_argument("board", type=parse_board, metavar="BOARD", help=boards.FORMS)
    board.add_argument("--out", type=Path, required=True, metavar="FILE.png")
    imu.add_parser(verbs)
    export = verbs.add_parser("export", help="write a calibration in the form of another tool")
    export.add_argument("calibration", metavar="FILE[,FILE]", help="of any form that is read")
    export.add_argument("--format", choices=tuple(FORMS), required=True)
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write to")
    export.add_argument("--force", action="store_true", help="overwrite files in DIR")
    return p


def _camera(args: argparse.Namespace) -> int:
    board: Board = args.board
    kept = read_calibration(args.calibration) if args.calibration else FileCalibration("")
    source = open_source(args.source, mono=args.mono, imu=False, calibration=UNCALIBRATED)
    collector = ViewCollector(board, 1 + (source.rig.right is not None))
    # images without stamps are single pictures: each is looked at
    every_s = 0.0 if source.name.startswith("images:") else args.every
    with whole_file(args.out, force=args.force) as part:
        try:
            with Progress("looking for the board", source.frame_count, "frames") as progress:
                for done in collect(source, collector, every_s, args.until_complete):
                    progress.update(done, _note(collector))
        finally:
            source.close()
        if not collector.views:
            raise NoBoard(
                f"{args.source}: the board is in none of {collector.frames} images: expected {_described(board)}; "
                "check --board, that markers are not mirrored, and that a white margin is left around it"
            )
        result, findings = calibrated(collector, board, args.lens, args.coefficients)
        rms = ", ".join(f"{r.rms_px:.3f}" for r in result.residuals)
        head = f"kiteline calibrate: {counted(len(result.poses), 'view')} of {_described(board)}, {rms} px rms"
        comments = (f"{head}; {overall(findings)}",)
        given = FileCalibration(str(args.out), result.cameras, result.T_c_r, kept.T_b_c, kept.imu, kept.topics)
        part.write_text(own_texts(given, comments)["calibration.yaml"])
    if args.picture is not None:
        _write_picture(args.picture, residual_picture(result, collector.coverage))
    if args.json:
        print(json.dumps(_summary(args.out, result, findings, collector), indent=2))
    else:
        print("\n".join(f.line() for f in findings))
        worth = {"good": "good", "poor": "usable; the lines above say how it gets better", "bad": "not to be flown"}
        print(f"{args.out}: {worth[overall(findings)]}")
        wanted = collector.wanted()
        if wanted and overall(findings) != "good":
            print(f"next, show {wanted}")
    return 1 if overall(findings) == "bad" else 0


def _note(collector: ViewCollector) -> str:
    covered = ", ".join(f"{100 * c.share:.0f} %" for c in collector.coverage)
    wanted = collector.wanted()
    seen = f"{counted(len(collector.views), 'view')}, {covered} covered"
    return seen + (f"; show {wanted}" if wanted else "; complete")


def _described(board: Board) -> str:
    kind = f"ChArUco board ({board.dictionary})" if board.is_charuco else "chessboard"
    return f"a {kind} of {board.columns}x{board.rows} squares of {1000 * board.square_m:g} mm"


def _summary(
    out: Path, result: Calibrated, findings: list[CalibrationFinding], collector: ViewCollector
) -> dict[str, Any]:
    return {
        "file": str(out),
        "verdict": overall(findings),
        "findings": [{"level": f.level, "text": f.text, "mend": f.mend} for f in findings],
        "views": len(result.poses),
        "frames": collector.frames,
        "wanted": collector.wanted(),
        "rms_px": [r.rms_px for r in result.residuals],
        "coverage": [c.share for c in collector.coverage],
        "lens": result.cameras[0].lens.value,
        "focal_px": [[c.fx, c.fy] for c in result.cameras],
        "baseline_m": None if result.T_c_r is None else float(np.linalg.norm(result.T_c_r[:3, 3])),
    }


def _board(args: argparse.Namespace) -> int:
    board: Board = args.board
    px = max(20, round(board.square_m / _M_AN_INCH * _DPI))
    _write_picture(args.out, board.draw(px))
    print(f"{args.out}: {_described(board)}; print it at {px / board.square_m * _M_AN_INCH:.1f} dots an inch without "
          "scaling, glue it on something flat, and measure a square")  # fmt: skip
    return 0


def _write_picture(path: Path, picture: U8) -> None:
    """Write a picture in the format that its name tells. Raises NoBoard for another one, OSError."""
    try:
        made, content = cv2.imencode(path.suffix, picture)
    except cv2.error:
        made = False
    if not made:
        raise NoBoard(f"{path}: no picture: expected a name that ends in .png")
    write_whole(path, content.tobytes())


def _export(args: argparse.Namespace) -> int:
    given = read_calibration(args.calibration)
    if not given.cameras and args.format != "kalibr":
        given.rig()  # says that no camera is there
    texts = FORMS[args.format](given)
    for path in write_files(args.out, {name: text.encode() for name, text in texts.items()}, force=args.force):
        sys.stdout.write(f"{path}\n")
    return 0
