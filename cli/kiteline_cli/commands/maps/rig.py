"""`kiteline rig`."""

SUMMARY = "show and export what flights found of cameras and IMU"
EXAMPLES = (
    "kiteline rig show maps",
    "kiteline rig show rig.toml",
    "kiteline rig export maps --format kalibr --out calibration",
    "kiteline rig export maps --format kiteline --out .",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline rig`; the exit status."""
    from kiteline_lab.tools.rig import main

    return main(argv)
