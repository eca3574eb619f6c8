"""Configuration of scans and of the local grid."""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class ScanConfig:
    """When images are scanned for ground and obstacles; `ground` says how."""

    MAY_BE_ZERO: ClassVar = (
        "moved_m",
        "turned_rad",
    )

    on: bool = True  # False: the agent makes no scans
    by_base: bool = False  # True: of a stereo pair the base makes them from images, while the link carries these
    jpeg_quality: int = (
        90  # of these images: 27 kB of a textured room; 75 (17 kB) costs 6 points of recall, 97 gains none
    )
    moved_m: float = (
        0.2  # m; motion since the last scan: it sees a wall at 3 m from another angle, by 4 degrees; 0: any
    )
    turned_rad: float = 0.17  # rad; rotation since the last scan: a tenth of the field of view is new; 0: any


@dataclass(frozen=True, slots=True)
class LocalGridConfig:
    """Grid of obstacles around the vehicle, for a flight controller that avoids them."""

    cell_m: float = 0.05  # m; the grid has 512 x 512 cells
    reach_m: float = 10.0  # m; farther obstacles are not told
    sigma_m: float = 0.07  # m; deviation of a range up to which own scans count: 4 m with 0.11 m of baseline
    scans: int = 48  # newest ones that are kept: 10 m of flight, or more than a turn
    slab_m: float = 0.1  # m that the camera climbs until scans are drawn anew
    body_m: float = 0.25  # m above and below the vehicle where an obstacle stands in its way: a small drone
    repeats: int = 4  # newest scans of one view that are kept: as many as turn a cell that was free
    vehicle_m: float = 0.15  # m about its middle where the vehicle is itself
    tiles: int = 512  # of the base's grid that are kept, 2 MiB: the farthest go
