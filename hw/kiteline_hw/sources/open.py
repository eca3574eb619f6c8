"""Opens whatever a SOURCE names: `euroc:DIR kitti:DIR tum:DIR mcap:FILE images:GLOB sim:SCENE v4l2:DEV`, or a plain
path, recognised by its layout.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from kiteline_hw.ports import FrameSource, SourceError

SCHEMES = ("euroc", "kitti", "tum", "mcap", "images", "sim", "v4l2")
_MCAP_MAGIC = b"\x89MCAP0\r\n"


def open_source(spec: str, mono: bool = False, imu: bool = True) -> FrameSource:
    """Open a camera or a recording. mono: left images alone, without right eye or depth. imu: False leaves inertial
    samples out (the body frame stays). Reads calibration only; images are read and decoded while iterating.

    Raises SourceError that says what was found and what was expected.
    """
    scheme, colon, rest = spec.partition(":")
    if not colon or scheme not in SCHEMES:
        scheme, rest = recognise(spec), spec
    if not rest:
        raise SourceError(f"{spec!r} names nothing: expected {scheme}:PATH")
    if scheme == "sim":
        return _open_sim(rest, mono, imu)
    if scheme == "v4l2":
        raise SourceError(f"{spec}: cameras cannot be opened yet: expected a recording or sim:SCENE")
    if scheme == "images":
        from kiteline_hw.sources.image_files import open_images

        return open_images(rest, mono=mono, imu=imu)
    path = Path(rest).expanduser()
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    if scheme == "mcap":
        from kiteline_hw.bags.mcap_source import open_mcap

        return open_mcap(_mcap_file(path), mono=mono, imu=imu)
    if not path.is_dir():
        raise SourceError(f"{path}: expected a folder with the layout of {scheme}")
    if scheme == "euroc":
        from kiteline_hw.sources.euroc import open_euroc

        return open_euroc(path, mono=mono, imu=imu)
    if scheme == "kitti":
        from kiteline_hw.sources.kitti import open_kitti

        return open_kitti(path, mono=mono, imu=imu)
    from kiteline_hw.sources.tum import open_tum

    return open_tum(path, mono=mono, imu=imu)


def recognise(spec: str) -> str:
    """The scheme of a plain path, by its layout. Raises SourceError when it looks like nothing that we know."""
    path = Path(spec).expanduser()
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(16)
        if head.startswith(_MCAP_MAGIC) or path.suffix == ".mcap":
            return "mcap"
        if path.suffix in (".db3", ".bag"):
            raise SourceError(f"{path}: a {path.suffix} bag: convert it first with `ros2 bag convert` to MCAP storage")
        raise SourceError(f"{path}: expected an MCAP file or a data set folder; it starts with {head[:8]!r}")
    if path.is_dir():
        if (path / "mav0").is_dir() or (path / "cam0").is_dir():
            return "euroc"
        if (path / "rgb.txt").is_file() or (path / "rgb").is_dir():
            return "tum"
        if (path / "calib.txt").is_file() or any((path / f"image_{side}").is_dir() for side in "0123lr"):
            return "kitti"
        if list(path.glob("*.mcap")):
            return "mcap"
        raise SourceError(
            f"{path}: layout not recognised: expected mav0/ (EuRoC), calib.txt with image_0/ (KITTI), rgb.txt (TUM) or "
            "*.mcap; plain images are opened as images:'DIR/*.png'"
        )
    if any(c in spec for c in "*?["):
        return "images"
    known = ", ".join(f"{scheme}:" for scheme in SCHEMES)
    raise SourceError(f"{spec}: no such file or folder; expected a path or one of {known}")


def _mcap_file(path: Path) -> Path:
    if path.is_file():
        return path
    files = sorted(path.glob("*.mcap"))
    if len(files) == 1:
        return files[0]
    if not files:
        raise SourceError(f"{path}: no *.mcap in this folder: expected one")
    raise SourceError(
        f"{path}: {len(files)} MCAP files: name one, or join them with `kiteline log merge OUT.mcap FILES…`"
    )


def _open_sim(scene: str, mono: bool, imu: bool) -> FrameSource:
    try:
        module = import_module("kiteline_hw.sim.source")
    except ModuleNotFoundError as error:
        raise SourceError(f"sim:{scene}: the simulator is not installed ({error})") from error
    source: FrameSource = module.open_sim(scene, mono=True) if mono else module.open_sim(scene)
    from kiteline_hw.sources.reduced import reduced

    return reduced(source, mono, imu)
