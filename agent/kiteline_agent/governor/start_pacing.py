"""Paces the start of a monocular map with an IMU within a CPU budget: its frames, and the parts of its solution.

Neither is in a hurry, since frames wait for the solution: they only have to fit the budget.
"""

_BURST = 0.1  # share of the budget that a step may take: meanwhile no frame is taken from the camera
_LEARNING = 0.3  # gain of the expected costs
_DOUBT = 1.1  # times the expected cost for which there has to be room


class StartPacing:
    """Expected costs of frames in which corners are followed, and of parts of the solution."""

    def __init__(self, budget_ns: float, frame_ns: float) -> None:
        """budget_ns: of a window. frame_ns: expected at first."""
        self._budget_ns = budget_ns
        self._frame_ns = self._part_ns = frame_ns
        self._solving = False
        self._parts = 0  # in this step

    def may_step(self, spent_ns: float, *, solving: bool) -> bool:
        """True if a step fits. spent_ns: in the window before it. solving: it is for parts of a solution."""
        self._solving, self._parts = solving, 0
        need_ns = self._frame_ns + (self._part_ns if solving else 0.0)  # after a solution a map may begin
        return spent_ns + _DOUBT * need_ns <= self._budget_ns

    def may_solve(self, spent_ns: float) -> bool:
        """True if a further part fits in this step; it is booked then."""
        need_ns = (self._parts + 1) * self._part_ns
        fits = spent_ns + _DOUBT * (need_ns + self._frame_ns) <= self._budget_ns and need_ns <= _BURST * self._budget_ns
        if not self._solving or (self._parts and not fits):
            return False
        self._parts += 1
        return True

    def learn(self, cpu_ns: int) -> None:
        """The cost of the last step that was taken."""
        if self._parts:
            self._part_ns += _LEARNING * (cpu_ns / self._parts - self._part_ns)
        else:
            self._frame_ns += _LEARNING * (cpu_ns - self._frame_ns)
