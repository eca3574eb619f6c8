"""`kiteline maps`."""

SUMMARY = "maps of a running base: list, get, name, merge, split, delete; stores: check, repair, backup"
EXAMPLES = (
    "kiteline maps list",
    "kiteline maps name 0.3.0 hangar",
    "kiteline maps merge 1.1.0 hangar",
    "kiteline maps check maps",
    "kiteline maps backup maps copy",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline maps`; the exit status."""
    from kiteline_lab.tools.maps import main

    return main(argv)
