"""The rules by which nav2's map_server loads a map (nav2_map_server, map_io.cpp), as far as they can refuse ours."""

from pathlib import Path

import cv2
import numpy as np
import yaml

MODES = ("trinary", "scale", "raw")


class Nav2Error(Exception):
    """map_server would not load the map."""


def load_as_nav2(file: Path) -> tuple[np.ndarray, float, list[float]]:
    """OccupancyGrid data (rows, columns), row 0 the lowest y, resolution and origin, as map_server publishes them."""
    doc = yaml.safe_load(file.read_text())
    for key in ("image", "resolution", "origin", "free_thresh", "occupied_thresh", "negate"):
        if key not in doc:
            raise Nav2Error(f"no tag {key}")
    image = doc["image"]
    if not isinstance(image, str) or not image:
        raise Nav2Error("the image tag was empty")
    for key in ("resolution", "free_thresh", "occupied_thresh"):
        if not isinstance(doc[key], int | float):
            raise Nav2Error(f"{key} is no number")
    origin = doc["origin"]
    if not isinstance(origin, list) or len(origin) != 3 or not all(isinstance(v, int | float) for v in origin):
        raise Nav2Error("origin should have 3 numbers")
    if doc.get("mode", "trinary") not in MODES:
        raise Nav2Error("unknown mode")
    if not isinstance(doc["negate"], int):  # a bool is one too
        raise Nav2Error("negate is neither a number nor a bool")
    free, occupied = float(doc["free_thresh"]), float(doc["occupied_thresh"])
    if not 0.0 <= free < occupied <= 1.0:
        raise Nav2Error("inconsistent thresholds")
    picture = Path(image) if image.startswith("/") else file.parent / image
    grey = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    if grey is None or grey.ndim != 2 or grey.dtype != np.uint8:
        raise Nav2Error(f"{picture} is no grey image")
    shade = grey.astype(np.float64) / 255.0
    occ = shade if doc["negate"] else 1.0 - shade
    data = np.full(grey.shape, -1, np.int8)
    data[occ < free] = 0
    data[occupied < occ] = 100
    if doc.get("mode", "trinary") != "trinary":
        raise Nav2Error("the other modes keep percentages, which these maps do not hold")
    return data[::-1], float(doc["resolution"]), [float(v) for v in origin]
