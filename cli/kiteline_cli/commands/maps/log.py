"""`kiteline log`."""

SUMMARY = "inspect and repair logs: info, recover, cut, merge"
EXAMPLES = (
    "kiteline log info out/agent0/log.mcap",
    "kiteline log recover cut.mcap whole.mcap",
    "kiteline log cut log.mcap part.mcap --from 12 --to 20",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline log`; the exit status."""
    from kiteline_lab.tools.logs import main

    return main(argv)
