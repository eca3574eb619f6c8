"""`kiteline agent`."""

SUMMARY = "run the onboard half live: images in, poses out, map updates to the base"
EXAMPLES = (
    "kiteline agent flight.mcap --link zenoh:tcp/10.0.0.1:7447 --log logs",
    "kiteline agent flight.mcap --mavlink udp:10.0.0.2:14550 --cpu 30",
    "kiteline agent flight.mcap --mavlink serial:/dev/ttyS0:921600 --imu controller --config agent.toml",
    "kiteline agent flight.mcap --agent 3 --key agent3.key --link serial:/dev/ttyUSB0:57600 --up-bytes 1000",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline agent`; the exit status."""
    from kiteline_agent.__main__ import main

    return main(argv)
