"""Progress of a simulation, as it is reported to the argument `progress`."""

import dataclasses


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
