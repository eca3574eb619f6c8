"""`kiteline calibrate`."""

SUMMARY = "calibrate a camera or a pair by a printed board; convert calibration files"
EXAMPLES = (
    "kiteline calibrate board charuco:9x7:0.03 --out board.png",
    "kiteline calibrate camera 'images:shots/*.png' --board charuco:9x7:0.03 --picture residuals.png",
    "kiteline calibrate camera 'images:left/*.png,right/*.png' --board chessboard:9x6:0.025 --out rig.yaml",
    "kiteline calibrate camera bag.mcap --board charuco:9x7:0.03 --lens equidistant --json",
    "kiteline calibrate export calibration.yaml --format kalibr --out kalibr",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline calibrate`; the exit status."""
    from kiteline_lab.calibration.calibrate import main

    return main(argv)
