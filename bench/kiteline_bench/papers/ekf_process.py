"""The filter in a process of its own, whose memory is measured."""

from kiteline_agent.ekf.ekf_slam import EkfSlam
from kiteline_agent.ekf_config import EkfConfig
from kiteline_bench.papers import simulated_vehicle as vehicle
from kiteline_hw.system.memory import release_memory, rss_mib

_STARTED = 60  # frames after which all kernels are loaded


def main() -> None:
    """Fly a drone around the loop and print the memory in use, in MiB."""
    slam = EkfSlam(vehicle.camera(), EkfConfig())
    for k, frame in enumerate(vehicle.flight(vehicle.VehicleModel(planar=False), 0)):
        if k == _STARTED:
            release_memory()  # as an agent does once it is warm
        if frame.motion is not None:
            slam.predict(frame.motion)
        slam.update(frame.ids, frame.uv)
    print(f"{rss_mib():.1f}")
