"""`kiteline export`."""

SUMMARY = "write a base's map in the formats of other tools: TUM, PLY, PGM, g2o"
EXAMPLES = (
    "kiteline export maps --format ply --out map.ply",
    "kiteline export maps --format tum --agent 0 --out agent0.tum",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline export`; the exit status."""
    from kiteline_lab.tools.export import main

    return main(argv)
