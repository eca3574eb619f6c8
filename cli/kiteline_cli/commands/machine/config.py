"""`kiteline config`."""

SUMMARY = "print, explain and check the options of agent and base"
EXAMPLES = (
    "kiteline config > kiteline.toml",
    "kiteline config --explain keyframe.min_share",
    "kiteline config --check agent.toml",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline config`; the exit status."""
    from kiteline_lab.tools.config import main

    return main(argv)
