"""`Progress`: how far a simulation has come."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a simulation has come; `simulate` and `energy_budget` give it to their argument `progress`.

    Printed, it is one line of text.

    - `batches`: batches traced so far.
    - `photons`: photons traced so far.
    - `seconds`: time spent so far.
    - `error`: relative error so far: of the waveform, as `simulate` defines it, or of the emitted energy.
    - `rtol`: relative error aimed at, or None where the number of photons is given.

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
        goal = "" if self.rtol is None else f" (aim {self.rtol:.2g})"
        return (
            f"{self.batches} batches, {self.photons} photons, {self.seconds:.1f} s, "
            f"relative error {self.error:.2g}{goal}"
        )
