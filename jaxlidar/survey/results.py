"""Results of shots, before they become `Waveforms`."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from jaxlidar.instrument.receiver import record
from jaxlidar.spectral.apply_optics import BudgetTerms, WaveformModel
from jaxlidar.spectral.waveform import energy_per_reflectance


class ShotResults(NamedTuple):
    """Results of shots; axis 0 is the shots'. The quantities are those of `Waveforms`."""

    reflectance: Any
    stderr: Any
    energy: Any
    recorded: Any
    components: Any
    neglected: Any
    lost: Any
    energy_budget: Any
    energy_budget_stderr: Any
    error: Any
    photons: Any
    truth: Any = None


class ShotErrors(NamedTuple):
    """Errors of one shot: standard errors of its waveform and its energy budget, and the relative error."""

    waveform: Float[Array, "wavelengths samples"]
    energy_budget: dict[str, Float[Array, "wavelengths"]]
    relative: Array


def make_shot_results(
    model: WaveformModel,
    components: dict[str, Float[Array, "wavelengths samples"]],
    budget: BudgetTerms,
    errors: ShotErrors,
    photons: Array,
) -> ShotResults:
    """Return the results of one shot from its components, its energy budget and their errors.

    `photons`: number of photons traced.
    """
    lidar, reflectance = model.lidar, components["first"] + components["higher"]
    energy = reflectance * energy_per_reflectance(lidar, model.time)
    return ShotResults(
        reflectance=reflectance,
        stderr=errors.waveform,
        energy=energy,
        recorded=record(energy, lidar.wavelength, lidar.receiver),
        components=components,
        neglected=budget.neglected,
        lost=budget.lost,
        energy_budget=budget.energy_budget,
        energy_budget_stderr=errors.energy_budget,
        error=errors.relative,
        photons=photons,
    )
