"""`kiteline fly`."""

SUMMARY = "fly recordings or a simulation: agents and a base as processes of this machine"
EXAMPLES = (
    "kiteline fly euroc:V1_01_easy --out out",
    "kiteline fly flight.mcap --out out --mode tracker --no-imu",
    "kiteline fly a.mcap b.mcap --out out --profile radio --link-loss 0.2 --cpu 30",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline fly`; the exit status."""
    from kiteline_lab.flights.fly import main

    return main(argv)
