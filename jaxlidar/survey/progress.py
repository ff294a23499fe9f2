"""How far a campaign has come, and how fast."""

import dataclasses
import math
import time


@dataclasses.dataclass(frozen=True)
class SurveyProgress:
    """How far `simulate_many` has come. Printed, it is one line of text.

    - `done`: shots done, those of an earlier run included.
    - `total`: shots in all.
    - `seconds`: time spent so far.
    - `rate`: shots per s.
    - `left`: estimated time left, s.

    **Example:**

    >>> import jaxlidar as jl
    >>> print(jl.SurveyProgress(done=500, total=2000, seconds=10.0, rate=50.0, left=30.0))
    500 of 2000 shots, 10 s, 50 per s, 30 s left
    """

    done: int
    total: int
    seconds: float
    rate: float
    left: float

    def __str__(self) -> str:
        left = f", {self.left:.3g} s left" if math.isfinite(self.left) else ""
        return f"{self.done} of {self.total} shots, {self.seconds:.3g} s, {self.rate:.3g} per s{left}"


class Pace:
    """How fast shots come, and how long the rest will take."""

    def __init__(self, total: int, kept: int):
        self.total, self.kept, self.done = total, kept, kept
        self.started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time since the start, s."""
        return time.perf_counter() - self.started

    @property
    def rate(self) -> float:
        """Shots per s in this run; 0 before the first."""
        return (self.done - self.kept) / max(self.seconds, 1e-9)

    @property
    def left(self) -> float:
        """Estimated time left, s; infinite before the first shot."""
        if self.done == self.total:
            return 0.0
        return (self.total - self.done) / self.rate if self.rate > 0 else math.inf
