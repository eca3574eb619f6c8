"""How long a rolling shutter takes from the first row to the last, found from how it distorts turning views.

Each frame's observations give an equation for it (`readout_kernels`). Equations are summed to blocks of equal
information; errors of lens and depth are alike within a block, so blocks are compared with each other to tell how well
the read-out is known.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class ReadoutConfig:
    """Read-out of a rolling shutter of which the calibration says nothing, found in flight."""

    on: bool = True  # false: a camera without a calibrated read-out has a global shutter
    block_sigma_s: float = 0.002  # s, of a block by its pixels alone, each 1 px off
    least_blocks: int = 4  # before anything is said
    kept_blocks: int = 16  # newest that count: what has changed is found within as many
    scatter_s: float = 0.002  # s between blocks, at least: errors of lens and depth of real cameras
    significance: float = 5.0  # deviations that make a shutter a rolling one
    refined: float = 3.0  # deviations from which a read-out that was found is corrected
    least_s: float = 0.003  # s: a global shutter, for all that it matters
    most_s: float = 0.06  # s: longer than any camera takes at 20 images a second


class ReadoutEstimate:
    """Sums equations, and says by how much the read-out in use is to change."""

    def __init__(self, config: ReadoutConfig, readout_s: float) -> None:
        """readout_s: in use."""
        self._config = config
        self.readout_s = readout_s
        self.sigma_s: float | None = None  # of a read-out that was found; None: none was
        self._information = self._gradient = 0.0
        self._blocks: list[float] = []  # s by which the read-out in use is too short

    @property
    def settled(self) -> bool:
        """True if all blocks that count agree with the read-out in use."""
        return len(self._blocks) == self._config.kept_blocks

    def add(self, information: float, gradient: float) -> float:
        """Take a frame's equation (1/s^2, 1/s). Returns the change in s of the read-out, 0.0 in most frames."""
        config = self._config
        self._information += information
        self._gradient += gradient
        if self._information < config.block_sigma_s**-2:
            return 0.0
        self._blocks.append(self._gradient / self._information)
        self._information = self._gradient = 0.0
        del self._blocks[: -config.kept_blocks]
        return self._decide()

    def _decide(self) -> float:
        """The change that the blocks ask for, if they are sure of it."""
        config, blocks = self._config, np.array(self._blocks)
        if len(blocks) < config.least_blocks:
            return 0.0
        mean = float(blocks.mean())
        sigma_s = max(float(blocks.std(ddof=1)), config.scatter_s) / float(np.sqrt(len(blocks)))
        found = self.sigma_s is not None
        if abs(mean) < sigma_s * (config.refined if found else config.significance):
            return 0.0
        readout_s = min(max(self.readout_s + mean, -config.most_s), config.most_s)
        if not found and abs(readout_s) < config.least_s:
            return 0.0
        change, self.readout_s, self.sigma_s = readout_s - self.readout_s, readout_s, sigma_s
        self._blocks.clear()
        return change
