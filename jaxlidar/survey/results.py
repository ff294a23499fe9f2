"""Results of shots, before they become `Waveforms`."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from jaxlidar.instrument.receiver import record
from jaxlidar.trace.colouring import Balance, Recording
from jaxlidar.waveform import received


class ShotResults(NamedTuple):
    """Results of shots; axis 0 is the shots'. The quantities are those of `Waveforms`."""

    reflectance: Any
    stderr: Any
    energy: Any
    recorded: Any
    components: Any
    neglected: Any
    lost: Any
    ledger: Any
    ledger_stderr: Any
    error: Any
    photons: Any
    truth: Any = None


class ShotErrors(NamedTuple):
    """Errors of one shot: standard errors of its waveform and its energy budget, and the relative error."""

    waveform: Float[Array, "wavelengths samples"]
    ledger: dict[str, Float[Array, "wavelengths"]]
    relative: Array


def make_shot_results(
    recording: Recording,
    components: dict[str, Float[Array, "wavelengths samples"]],
    balance: Balance,
    errors: ShotErrors,
    photons: Array,
) -> ShotResults:
    """Return the results of one shot from its components, its energy budget and their errors.

    `photons`: number of photons traced.
    """
    lidar, reflectance = recording.lidar, components["first"] + components["higher"]
    energy = reflectance * received(lidar, recording.time)
    return ShotResults(
        reflectance=reflectance,
        stderr=errors.waveform,
        energy=energy,
        recorded=record(energy, lidar.wavelength, lidar.receiver),
        components=components,
        neglected=balance.neglected,
        lost=balance.lost,
        ledger=balance.ledger,
        ledger_stderr=errors.ledger,
        error=errors.relative,
        photons=photons,
    )
