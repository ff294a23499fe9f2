"""`SurveyProgress`: the progress of a survey and its rate."""

import dataclasses
import math
import time


@dataclasses.dataclass(frozen=True)
class SurveyProgress:
    """Progress of `simulate_many`. Printed, it is one line of text.

    - `done`: number of shots traced, those of an earlier run included. With shared illumination, and with
      truth, it is in proportion to the tasks that are done.
    - `total`: number of shots in all.
    - `seconds`: time since tracing began, s; planning comes before.
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
        remaining = f", {self.left:.3g} s left" if math.isfinite(self.left) else ""
        return f"{self.done} of {self.total} shots, {self.seconds:.3g} s, {self.rate:.3g} per s{remaining}"


class ProgressClock:
    """The rate of shots since tracing began, and the time that the remaining ones will take.

    `total`: shots in all. `stored`: those of earlier runs, which do not count in the rate.
    """

    def __init__(self, total: int, stored: int):
        self.total, self.stored, self.done = total, stored, stored
        self.start_time = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time since tracing began, s."""
        return time.perf_counter() - self.start_time

    @property
    def rate(self) -> float:
        """Shots per s in this run; 0 before the first."""
        # Shots of earlier runs took none of this run's time.
        return (self.done - self.stored) / max(self.seconds, 1e-9)

    @property
    def seconds_left(self) -> float:
        """Estimated time left, s; infinite before the first shot."""
        if self.done == self.total:
            return 0.0
        return (self.total - self.done) / self.rate if self.rate > 0 else math.inf
