"""`kiteline bench trust`: nothing is lost, and nothing comes twice."""

from kiteline_bench.harness.bars import Run
from kiteline_bench.trust import disk, histories, store, stranger

PARTS: dict[str, tuple[str, Run]] = {
    "disk": ("Trust: full disks", disk.run),
    "starts": ("Trust: ids and nonces", histories.run),
    "stranger": ("Trust: a stranger on the network", stranger.run),
    "store": ("Trust: flipped bits in a store", store.run),
}
