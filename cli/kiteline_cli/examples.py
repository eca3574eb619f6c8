"""What is often typed, by command: shown below its `--help`."""

from __future__ import annotations

EXAMPLES = {
    "fly": (
        "kiteline fly euroc:V1_01_easy --out out",
        "kiteline fly flight.mcap --out out --mode tracker --no-imu",
        "kiteline fly a.mcap b.mcap --out out --profile radio --link-loss 0.2 --cpu 30",
    ),
    "eval": (
        "kiteline eval out/base/agent0.tum euroc:V1_01_easy",
        "kiteline eval out/agent0/live.tum flight.mcap --plot error.png --json",
    ),
    "grid": ("kiteline grid eval out/base/grid.yaml true.yaml",),
    "sim": (
        "kiteline sim room --out room.mcap",
        "kiteline sim 'hall?seed=3&seconds=20' --out hall.mcap",
    ),
    "agent": (
        "kiteline agent flight.mcap --link zenoh:tcp/10.0.0.1:7447 --log logs",
        "kiteline agent flight.mcap --mavlink udp:10.0.0.2:14550 --cpu 30",
        "kiteline agent flight.mcap --mavlink serial:/dev/ttyS0:921600 --imu controller --config rig.toml",
        "kiteline agent flight.mcap --agent 3 --key agent3.key --link serial:/dev/ttyUSB0:57600 --up-bytes 1000",
    ),
    "base": (
        "kiteline base --link zenoh:tcp/0.0.0.0:7447 --store maps --web 0.0.0.0:8080",
        "kiteline base --link serial:/dev/ttyUSB0:57600 --down-bytes 500",
    ),
    "replay": (
        "kiteline replay out/agent0/log.mcap --verify",
        "kiteline replay out/agent0/log.mcap --cpu 20 --out slower",
    ),
    "convert": (
        "kiteline convert euroc:V1_01_easy v101.mcap",
        "kiteline convert bag.mcap flight.mcap",
    ),
    "log": (
        "kiteline log info out/agent0/log.mcap",
        "kiteline log recover cut.mcap whole.mcap",
        "kiteline log cut log.mcap part.mcap --from 12 --to 20",
    ),
    "export": (
        "kiteline export maps --format ply --out map.ply",
        "kiteline export maps --format tum --agent 0 --out agent0.tum",
    ),
    "maps": (
        "kiteline maps list",
        "kiteline maps name 0.3.0 hangar",
        "kiteline maps merge 1.1.0 hangar",
    ),
    "keys": ("kiteline keys new 3", "kiteline keys show --secret 3 > agent3.key"),
    "doctor": ("kiteline doctor", "kiteline doctor --warm"),
    "bench": ("kiteline bench", "kiteline bench agent"),
}
