"""Progress, as it is reported to the argument `progress`: of a simulation, and of work that is counted."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Progress:
    """Progress of a simulation: `simulate` and `energy_budget` call their argument `progress` with it.

    Printed, it is one line of text.

    - `batches`: number of batches traced until now.
    - `photons`: number of photons traced until now.
    - `seconds`: time elapsed.
    - `error`: current relative error: of the waveform, as `simulate` defines it, or of the emitted energy.
    - `rtol`: target of the relative error, or None where the number of photons is given.

    **Example:**

    >>> import jaxlidar as jl
    >>> print(jl.Progress(batches=8, photons=65536, seconds=1.5, error=0.004, rtol=0.01))
    8 batches, 65536 photons, 1.5 s, relative error 0.004 (aim 0.01)
    """

    batches: int
    photons: int
    seconds: float
    error: float
    rtol: float | None

    def __str__(self) -> str:
        target = "" if self.rtol is None else f" (aim {self.rtol:.2g})"
        return (
            f"{self.batches} batches, {self.photons} photons, {self.seconds:.1f} s, "
            f"relative error {self.error:.2g}{target}"
        )


@dataclasses.dataclass(frozen=True)
class TaskProgress:
    """Progress of work that is counted, such as the shots of `simulate_many`. Printed, it is one line.

    - `done`: number that is done, that of an earlier run included. With shared illumination, and with truth,
      shots count in proportion to the tasks that are done.
    - `total`: number in all.
    - `seconds`: time since the work began, s; planning comes before.
    - `unit`: what is counted, such as "shots" or "fits". Default "shots".
    - `stored`: number that an earlier run has done, which took none of these seconds. Default 0.
    - `converged`: number of fits that have converged; None where there are none. Default None.

    **Example:**

    >>> import jaxlidar as jl
    >>> print(jl.TaskProgress(done=500, total=2000, seconds=10.0))
    500 of 2000 shots, 10 s, 50 per s, 30 s left
    """

    done: int
    total: int
    seconds: float
    unit: str = "shots"
    stored: int = 0
    converged: int | None = None

    @property
    def rate(self) -> float:
        """Number per s in this run; 0 before the first."""
        return (self.done - self.stored) / max(self.seconds, 1e-9)

    @property
    def left(self) -> float:
        """Estimated time left, s; infinite before the first is done."""
        if self.done == self.total:
            return 0.0
        return (self.total - self.done) / self.rate if self.rate > 0 else math.inf

    def __str__(self) -> str:
        left = f", {self.left:.3g} s left" if math.isfinite(self.left) else ""
        converged = "" if self.converged is None else f", {self.converged} converged"
        count = f"{self.done} of {self.total} {self.unit}{converged}"
        return f"{count}, {self.seconds:.3g} s, {self.rate:.3g} per s{left}"
