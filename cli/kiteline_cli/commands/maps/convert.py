"""`kiteline convert`."""

SUMMARY = "write a data set or a ROS 2 bag as a kiteline log"
EXAMPLES = ("kiteline convert euroc:V1_01_easy v101.mcap", "kiteline convert bag.mcap flight.mcap")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline convert`; the exit status."""
    from kiteline_lab.tools.convert import main

    return main(argv)
