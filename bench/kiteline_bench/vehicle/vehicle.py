"""On the vehicle: what `kiteline bench vehicle` measures, part by part."""

from kiteline_bench.harness.bars import Run, in_turn
from kiteline_bench.vehicle import camera, controllers, costs, faults, guided, raw_images, units
from kiteline_bench.vehicle.sitl import flights

PARTS: dict[str, tuple[str, Run]] = {
    "sitl": ("Vehicle: ArduCopter in the loop", flights.run),
    "controllers": ("Vehicle: modelled ArduPilot and PX4", controllers.run),
    "faults": ("Vehicle: faults of cameras and lines", faults.run),
    "camera": (
        "Vehicle: a live camera at 20 Hz beside link, MAVLink and log",
        in_turn(camera.run, costs.run, raw_images.run),
    ),
    "calibration": ("Vehicle: camera and IMU by a guided motion", guided.run),
    "units": ("Vehicle: services", units.run),
}
