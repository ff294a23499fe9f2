"""Results of shots, before they become `Waveforms`."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from jaxlidar.instrument.receiver import record
from jaxlidar.spectral.apply_optics import BudgetTerms, WaveformModel
from jaxlidar.spectral.waveform import energy_per_reflectance

# Arrays of JAX within compiled programs, of one shot or of several; of NumPy outside.
_PerSample = Float[Any, "*shots wavelengths samples"]
_PerWavelength = Float[Any, "*shots wavelengths"]


class ShotResults(NamedTuple):
    """Results of one shot, or of several along axis 0. The quantities are those of `Waveforms`.

    `truth`: a `Truths`, or None.
    """

    reflectance: _PerSample
    stderr: _PerSample
    energy: _PerSample
    recorded: _PerSample
    components: dict[str, _PerSample]
    neglected: _PerWavelength
    lost: _PerWavelength
    energy_budget: dict[str, _PerWavelength]
    energy_budget_stderr: dict[str, _PerWavelength]
    error: Float[Any, "*shots"]
    photons: Int[Any, "*shots"]
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
