"""`kiteline bench`."""

SUMMARY = "run measurements and write docs/results.md"
EXAMPLES = (
    "kiteline bench",
    "kiteline bench agent",
    "kiteline bench papers/governor --starts 2",
    "kiteline bench papers/sequences --data ~/datasets --results mine.md",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline bench`; the exit status."""
    from kiteline_bench.benchmark import main

    return main(argv)
