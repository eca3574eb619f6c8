"""The bars of real and worn recordings."""

from kiteline_bench.agent import altitude, bent, rigs, slants
from kiteline_bench.base import real_places
from kiteline_bench.reality import base, cpu, difficult, fixed_parts, nees, people, shutter, street, worn
from kiteline_bench.reality.one_camera import euroc, high, metric, own_unit, starts
from kiteline_bench.reality.sensors import imu, missing, motion

PARTS = {
    "euroc": ("Reality: monocular with a real IMU", euroc.run),
    "room": ("Reality: a worn rig in a room", worn.room),
    "hall": ("Reality: a worn rig in a hall", worn.hall),
    "street": ("Reality: a street", street.run),
    "motion": ("Reality: starts in motion", motion.run),
    "imu": ("Reality: stereo with a real IMU, and with wrong ones", imu.run),
    "sensors": ("Reality: sensors that come late, have holes, or end", missing.run),
    "base": ("Reality: the base beside the tracker alone", base.run),
    "own-unit": ("Reality: one camera without an IMU", own_unit.run),
    "high": ("Reality: one camera high above ground, beside a base", high.run),
    "metric": ("Reality: metric said from a hundred starts", metric.run),
    "starts": ("Reality: random monocular starts, forward and backward", starts.run),
    "nees": ("Reality: consistent poses of worn rigs", nees.run),
    "people": ("Reality: people who walk through", people.run),
    "bent": ("Reality: right cameras that were bent", bent.run),
    "rigs": ("Reality: rigs of many kinds", rigs.run),
    "slants": ("Reality: slanted surfaces", slants.run),
    "altitude": ("Reality: high above ground", altitude.run),
    "difficult": ("Reality: difficult images", difficult.run),
    "fixed": ("Reality: what stands still in the images", fixed_parts.run),
    "shutter": ("Reality: rolling shutters", shutter.run),
    "places": ("Reality: places on real images", real_places.run),
    "cpu": ("Reality: CPU over a yardstick", cpu.run),
}
