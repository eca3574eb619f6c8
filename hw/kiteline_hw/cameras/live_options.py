"""Options of a live camera, written behind its devices: `v4l2:/dev/video0?fps=20&calibration=camera.yaml`."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.calibration.nodes import read_nodes
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.calibration import rig_from_yaml
from kiteline_hw.sources.open import open_source
from kiteline_hw.sources.text_files import read_yaml
from kiteline_hw.system.process import home_path

CALIBRATIONS = ("camera.yaml", "/etc/kiteline/camera.yaml")  # looked for where no calibration is named


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """calibration: a camera.yaml, a calibration file of any form, or a recording or log with the rig; "": the first of
    CALIBRATIONS that exists.

    fps: Hz. side_by_side: each image holds the left view and the right view. format: four letters, "": chosen.
    exposure_ms, gain: -1: as the camera wants.
    """

    calibration: str = ""
    fps: float = 20.0
    side_by_side: bool = False
    format: str = ""
    exposure_ms: float = -1.0
    gain: float = -1.0


def parse(scheme: str, argument: str) -> tuple[str, LiveOptions]:
    """Devices and options of an argument. Raises SourceError."""
    devices, _, query = argument.partition("?")
    known: dict[str, Any] = {field.name: field.type for field in fields(LiveOptions)}
    options = LiveOptions()
    for item in filter(None, query.split("&")):
        key, _, text = item.partition("=")
        if key not in known:
            raise SourceError(f"{scheme}: unknown option {key!r}: expected one of {', '.join(known)}")
        try:
            changed: dict[str, Any] = {key: _value(known[key], text)}
            options = replace(options, **changed)
        except ValueError as error:
            raise SourceError(f"{scheme}: option {key}={text!r}: expected a {known[key].__name__}") from error
    if not 1.0 <= options.fps <= 1000.0:
        raise SourceError(f"{scheme}: fps={options.fps:g}: expected 1 to 1000 images a second")
    return devices, options


def _value(kind: type, text: str) -> Any:
    if kind is bool:
        if text.lower() not in ("", "1", "true", "0", "false"):
            raise ValueError(text)
        return text.lower() not in ("0", "false")
    return float(text) if kind is float else text


def read_rig(scheme: str, options: LiveOptions, *, stereo: bool, given: FileCalibration | None = None) -> CameraRig:
    """The rig of a live camera. given: it goes first. Raises SourceError."""
    if given is not None and given.known:
        return given.rig_of_images(scheme, 1 + stereo, (given.cameras[0].height, given.cameras[0].width))
    if given is not None and not options.calibration:
        raise SourceError(
            f"{scheme}: the size of the images is not known: expected {scheme}:…?calibration=FILE, a camera.yaml with "
            "width and height (fx, fy, cx, cy, baseline_m are not used to calibrate), or recorded images"
        )
    name = options.calibration or next((path for path in CALIBRATIONS if Path(path).is_file()), "")
    if not name:
        raise SourceError(
            f"{scheme}: the camera's calibration is missing: expected --calibration FILE, which `kiteline calibrate` "
            f"makes, or {scheme}:…?calibration=FILE (a camera.yaml with fx, fy, cx, cy, width, height, for a pair "
            f"baseline_m; or a recording of this camera), or {' or '.join(CALIBRATIONS)}"
        )
    path = home_path(name)
    if path.suffix not in (".yaml", ".yml"):
        recorded = open_source(name if ":" in name else str(path), mono=not stereo)
        try:
            if stereo and recorded.rig.right is None:
                raise SourceError(f"{name} knows one camera: expected the calibration of a pair, or --mono")
            return recorded.rig
        finally:
            recorded.close()
    if "fx" not in read_nodes(path).keys:
        return read_rig(scheme, options, stereo=stereo, given=read_calibration(str(path)))
    otherwise = (
        "; a pair with lenses is told by a recording with its calibration (calibration=euroc:DIR or "
        "calibration=FILE.mcap)"
    )
    table = read_yaml(path, "fx, fy, cx, cy, width, height")
    return rig_from_yaml(table, path, stereo=stereo, otherwise=otherwise)
