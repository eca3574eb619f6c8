"""Subcommands: a folder for each group of `kiteline --help`, a file for each command.

A command's file holds SUMMARY (its line in `kiteline --help`), EXAMPLES (shown below its own `--help`) and
`run(argv) -> exit status`, which imports the room that does the work. Nothing else lists commands.
"""

GROUPS = ("flights", "maps", "measurements", "machine")  # in the order of `kiteline --help`
