"""Results of shots, before they become `Waveforms`."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from jaxlidar.instrument.receiver import digitise
from jaxlidar.spectral.apply_optics import BudgetTerms, WaveformModel
from jaxlidar.spectral.waveform import energy_at_reference

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
    relative_energy: Float[Array, "wavelengths samples"],
    budget: BudgetTerms,
    errors: ShotErrors,
    photons: Array,
) -> ShotResults:
    """Return the results of one shot from its components, its energy budget and their errors.

    `relative_energy`: see `jaxlidar.spectral.apply_optics.relative_energy_samples`. `photons`: number of
    photons traced.
    """
    lidar, reflectance = model.lidar, components["first"] + components["higher"]
    energy = energy_at_reference(lidar)[:, None] * relative_energy
    return ShotResults(
        reflectance=reflectance,
        stderr=errors.waveform,
        energy=energy,
        recorded=digitise(energy, lidar.wavelength, lidar.receiver),
        components=components,
        neglected=budget.neglected,
        lost=budget.lost,
        energy_budget=budget.energy_budget,
        energy_budget_stderr=errors.energy_budget,
        error=errors.relative,
        photons=photons,
    )
