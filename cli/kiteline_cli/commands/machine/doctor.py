"""`kiteline doctor`."""

SUMMARY = "check this machine and its flight controller, and compile the kernels beforehand"
EXAMPLES = ("kiteline doctor", "kiteline doctor --warm", "kiteline doctor --mavlink serial:/dev/ttyAMA0:921600")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline doctor`; the exit status."""
    from kiteline_lab.tools.doctor import main

    return main(argv)
