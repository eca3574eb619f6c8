"""`kiteline status`."""

SUMMARY = "what a running base does: agents and their links, map, store, and what is wrong"
EXAMPLES = ("kiteline status", "kiteline status --base tcp/10.0.0.1:7447 --watch", "kiteline status --json")


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline status`; the exit status."""
    from kiteline_lab.tools.status import main

    return main(argv)
