"""Opens the source that a SOURCE argument names, or that a plain path holds."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.ports import FrameSource, SourceError, is_live
from kiteline_hw.sources import kinds
from kiteline_hw.sources.bags.bag_heads import MCAP_MAGIC, SQLITE_MAGIC, refuse_unreadable
from kiteline_hw.sources.beside.odometry_file import with_odometry_file
from kiteline_hw.sources.kinds import SourceKind
from kiteline_hw.sources.overrides import CalibratedView
from kiteline_hw.system.process import home_path


def open_source(
    spec: str, mono: bool = False, imu: bool = True, calibration: str | FileCalibration = ""
) -> FrameSource:
    """Open a camera or a recording. Only the calibration is read; images are decoded while iterating.

    mono: left images alone, without right image or depth. imu: False leaves inertial samples out (the body frame
    stays). calibration: FILE[,FILE…] in place of what the source says of its cameras and its IMU's noise, or what was
    read of them. Raises SourceError.
    """
    scheme, colon, argument = spec.partition(":")
    kind = _by_scheme(scheme) if colon else None
    if kind is None:
        kind, argument = recognise(spec), spec
    if not argument:
        raise SourceError(f"{spec!r} names nothing: expected {kind.scheme}:{kind.argument}")
    if kind.argument in ("DIR", "FILE"):
        path = home_path(argument)
        if not path.exists():
            raise SourceError(f"{path}: no such file or folder")
        if kind.argument == "DIR" and not path.is_dir():
            raise SourceError(f"{path}: expected a folder with the layout of {kind.scheme}")
        argument = str(path)
    first, comma, second = argument.partition("?")[0].partition(",")
    if comma and first == second:
        raise SourceError(f"{spec}: left and right are the same: name the right one after the comma")
    opener: Callable[..., FrameSource] = import_module(kind.module).open_source
    given = read_calibration(calibration) if isinstance(calibration, str) and calibration else calibration
    if isinstance(given, str):
        source = opener(argument, mono, imu)
    else:
        source = opener(argument, mono, imu, given) if kind.given and given.cameras else opener(argument, mono, imu)
        # a camera has nothing of its own that the given calibration is put over
        source = CalibratedView(source, given) if given.known and not is_live(source) else source
    if kind.argument == "DIR":
        return with_odometry_file(source, Path(argument))
    if kind.scheme == "images":
        return with_odometry_file(source, *home_path(argument.split(",")[0]).parents[:2])
    return source


def recognise(spec: str) -> SourceKind:
    """The kind of a plain path, by its layout. Raises SourceError if no kind fits."""
    path = home_path(spec)
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(16)
        if head.startswith((MCAP_MAGIC, SQLITE_MAGIC)) or path.suffix == ".mcap":
            return _known("mcap")
        refuse_unreadable(path)
        raise SourceError(
            f"{path}: expected an MCAP file, a .db3 bag or a data set folder; it starts with {head[:8]!r}"
        )
    if path.is_dir():
        for kind in kinds.SOURCES:
            if any(_holds(path, pattern) for pattern in kind.layout):
                return kind
        for layout in kinds.FOREIGN:
            if all(any(path.glob(mark)) for mark in layout.marks):
                raise SourceError(f"{path}: the layout of {layout.name} is not read: {layout.mend}")
        refuse_unreadable(path)
        *shown, last = [kind.shown for kind in kinds.SOURCES if kind.shown]
        raise SourceError(
            f"{path}: layout not recognised: expected {', '.join(shown)} or {last}; plain images are opened as "
            "images:'DIR/*.png'"
        )
    if any(c in spec for c in "*?["):
        return _known("images")
    schemes = ", ".join(f"{kind.scheme}:" for kind in kinds.SOURCES)
    raise SourceError(f"{spec}: no such file or folder; expected a path or one of {schemes}")


def _by_scheme(scheme: str) -> SourceKind | None:
    return next((kind for kind in kinds.SOURCES if kind.scheme == scheme), None)


def _known(scheme: str) -> SourceKind:
    kind = _by_scheme(scheme)
    assert kind is not None
    return kind


def _holds(folder: Path, pattern: str) -> bool:
    """True if the folder has a sub-folder (pattern with a trailing slash) or a file that matches."""
    wants_folder = pattern.endswith("/")
    return any(entry.is_dir() if wants_folder else entry.is_file() for entry in folder.glob(pattern.rstrip("/")))
