"""`kiteline replay`."""

SUMMARY = "run an agent or a base again from its log, and compare the outputs"
EXAMPLES = ("kiteline replay out/agent0/log.mcap --verify", "kiteline replay out/agent0/log.mcap --cpu 20 --out slower")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline replay`; the exit status."""
    from kiteline_lab.replay.replay import main

    return main(argv)
