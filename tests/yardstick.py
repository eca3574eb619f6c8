"""How slow this machine is at the moment, so that a bound on CPU time is about the code, not about the machine."""

import time

_LOOPS = 200_000
_USUAL_S = 0.007  # s of CPU that they take on a machine whose cv2.ORB_create(1000) takes 5.3 ms


def slowness() -> float:
    """CPU time of a fixed piece of work over that of a usual machine, at least 1; the best of three."""
    best_s = float("inf")
    for _ in range(3):
        begin_s, total = time.process_time(), 0
        for i in range(_LOOPS):
            total += i
        best_s = min(best_s, time.process_time() - begin_s)
    return max(1.0, best_s / _USUAL_S)
