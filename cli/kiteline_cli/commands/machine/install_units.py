"""`kiteline install-units`."""

SUMMARY = "install agent and base as services that start at boot"
EXAMPLES = ("kiteline install-units agent", "kiteline install-units base --user")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline install-units`; the exit status."""
    from kiteline_lab.units.install import main

    return main(argv)
