"""`python -m kiteline_cli` is `kiteline`."""

from kiteline_cli.main import run

run()
