"""How long a rolling shutter takes from the first row to the last, found from how it distorts turning views.

Each frame's observations give an equation for it (`readout_kernels`). Equations are summed to blocks of equal
information; errors of lens and depth are alike within a block, so blocks are compared with each other to tell how well
the read-out is known.
"""

import numpy as np

BLOCK_SIGMA_S = 0.002  # s, of a block by its pixels alone, each 1 px off
MOST_S = 0.06  # s: longer than any camera takes at 20 images a second
_LEAST_BLOCKS = 4  # before anything is said
_KEPT_BLOCKS = 16  # newest that count: what has changed is found within as many
_SCATTER_S = 0.002  # s between blocks, at least: errors of lens and depth of real cameras
_SIGNIFICANCE = 5.0  # deviations from 0 above which a shutter is a rolling one
_REFINED = 3.0  # deviations above which a read-out that was found is corrected
_LEAST_S = 0.003  # s: a global shutter, for all that it matters


class ReadoutEstimate:
    """Sums equations, and says by how much the read-out in use is to change."""

    def __init__(self, readout_s: float, sigma_s: float | None = None) -> None:
        """readout_s: in use. sigma_s: its deviation, if an earlier flight found it."""
        self.readout_s = readout_s
        self.sigma_s = sigma_s  # of a read-out that was found; None: none was
        self._of_earlier_flight = sigma_s is not None
        self._information = self._gradient = 0.0
        self._blocks: list[float] = []  # s by which the read-out in use is too short
        # blocks behind the read-out in use
        self._used = 0 if sigma_s is None else _blocks_behind(sigma_s)

    def take(self, readout_s: float, sigma_s: float) -> float:
        """Take a read-out and its deviation that were found without equations. Returns the change in s."""
        change = readout_s - self.readout_s
        self.readout_s, self.sigma_s = readout_s, sigma_s
        self._used = _blocks_behind(sigma_s)
        self._information = self._gradient = 0.0
        self._blocks.clear()
        return change

    @property
    def settled(self) -> bool:
        """True if all blocks that count agree with the read-out in use."""
        return len(self._blocks) == _KEPT_BLOCKS

    def add(self, information: float, gradient: float) -> float:
        """Take a frame's equation (1/s^2, 1/s). Returns the change in s of the read-out, 0.0 in most frames."""
        self._information += information
        self._gradient += gradient
        if self._information < BLOCK_SIGMA_S**-2:
            return 0.0
        self._blocks.append(self._gradient / self._information)
        self._information = self._gradient = 0.0
        del self._blocks[:-_KEPT_BLOCKS]
        return self._decide()

    def _decide(self) -> float:
        """The change in s by which the blocks agree that the read-out is off; 0.0 if it is not significant."""
        blocks = np.array(self._blocks)
        if len(blocks) < _LEAST_BLOCKS:
            return 0.0
        mean = float(blocks.mean())
        sigma_s = max(float(blocks.std(ddof=1)), _SCATTER_S) / float(np.sqrt(len(blocks)))
        found = self.sigma_s is not None
        if abs(mean) < sigma_s * (_REFINED if found else _SIGNIFICANCE):
            return 0.0
        if self._of_earlier_flight and abs(mean) > max(_SIGNIFICANCE * sigma_s, _LEAST_S):
            self._used = 0  # refuted: the camera runs in another mode
        weight = len(blocks) / (len(blocks) + self._used)  # what was found before counts, too
        readout_s = min(max(self.readout_s + weight * mean, -MOST_S), MOST_S)
        if not found and abs(readout_s) < _LEAST_S:
            return 0.0
        change, self.readout_s, self.sigma_s = readout_s - self.readout_s, readout_s, sigma_s
        self._used += len(blocks)
        self._of_earlier_flight = False
        self._blocks.clear()
        return change


def _blocks_behind(sigma_s: float) -> int:
    """How many blocks tell a read-out as well as its deviation says."""
    return min(round((_SCATTER_S / sigma_s) ** 2), _KEPT_BLOCKS)
