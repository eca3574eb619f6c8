"""`kiteline sim`."""

SUMMARY = "record a simulated flight"
EXAMPLES = ("kiteline sim room --out room.mcap", "kiteline sim 'hall?seed=3&seconds=20' --out hall.mcap")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline sim`; the exit status."""
    from kiteline_lab.flights.simulate import main

    return main(argv)
