"""`python -m kiteline_cli` is `kiteline`."""

from kiteline_cli.entry import run

run()
