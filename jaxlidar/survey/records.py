"""What is known of shots before it becomes `Waveforms`."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from jaxlidar.instrument.receiver import record
from jaxlidar.trace.colouring import Balance, Recording
from jaxlidar.waveform import received


class Record(NamedTuple):
    """What is known of shots; axis 0 is the shots'. The quantities are those of `Waveforms`."""

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


def record_of_shot(
    recording: Recording,
    components: dict[str, Float[Array, "wavelengths samples"]],
    balance: Balance,
    stderr: Float[Array, "wavelengths samples"],
    ledger_stderr: dict[str, Float[Array, "wavelengths"]],
    error: Array,
    photons: Array,
) -> Record:
    """The record of one shot, of which the components, the balance and their errors are known."""
    lidar, total = recording.lidar, components["first"] + components["higher"]
    energy = total * received(lidar, recording.time)
    return Record(
        reflectance=total,
        stderr=stderr,
        energy=energy,
        recorded=record(energy, lidar.wavelength, lidar.receiver),
        components=components,
        neglected=balance.neglected,
        lost=balance.lost,
        ledger=balance.ledger,
        ledger_stderr=ledger_stderr,
        error=error,
        photons=photons,
    )
