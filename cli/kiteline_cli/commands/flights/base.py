"""`kiteline base`."""

SUMMARY = "run the base station live: one map for any number of agents"
EXAMPLES = (
    "kiteline base --link zenoh:tcp/0.0.0.0:7447 --store maps --web 0.0.0.0:8080",
    "kiteline base --link serial:/dev/ttyUSB0:57600 --down-bytes 500",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline base`; the exit status."""
    from kiteline_basestation.__main__ import main

    return main(argv)
