"""The entry point of the installed script. Ctrl-C ends the process while it loads: there is nothing to clean up yet."""

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)

from kiteline_cli.main import run  # noqa: E402

__all__ = ["run"]
