"""`kiteline keys`."""

SUMMARY = "make and show the keys that seal packets between agents and base"
EXAMPLES = ("kiteline keys new 3", "kiteline keys show --secret 3 > agent3.key")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline keys`; the exit status."""
    from kiteline_lab.tools.keys import main

    return main(argv)
