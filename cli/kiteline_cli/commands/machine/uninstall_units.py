"""`kiteline uninstall-units`."""

SUMMARY = "remove the services; settings, keys, maps and logs stay"
EXAMPLES = ("kiteline uninstall-units", "kiteline uninstall-units base --user")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline uninstall-units`; the exit status."""
    from kiteline_lab.units.install import main_uninstall

    return main_uninstall(argv)
