"""`kiteline eval`."""

SUMMARY = "compare a trajectory with ground truth: ATE, RPE, KITTI drift, coverage"
EXAMPLES = (
    "kiteline eval out/base/agent0.tum euroc:V1_01_easy",
    "kiteline eval out/agent0/live.tum flight.mcap --plot error.png --json",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline eval`; the exit status."""
    from kiteline_lab.tools.evaluate import main

    return main(argv)
