"""Results of shots, before they become `Waveforms`."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar.sensors.receiver import digitise
from jaxlidar.spectral.apply_optics import BudgetTerms, WaveformModel, budget_excess
from jaxlidar.spectral.waveform import energy_at_reference

# Arrays of `Waveforms` that `simulate_many(keep=...)` may leave out.
OPTIONAL_ARRAYS = (
    "reflectance",
    "stderr",
    "energy",
    "recorded",
    "components",
    "energy_budget",
    "energy_budget_stderr",
)
# Those with an axis of samples.
SAMPLED_ARRAYS = OPTIONAL_ARRAYS[:5]
# Further quantities of shots, (shots,), which `Waveforms` do not have. `outside`, `unfollowed`: largest of
# all wavelengths; `excess`: of the sum of the energy budget (`jaxlidar.spectral.apply_optics.budget_excess`).
MISSING_LIGHT = {
    "outside": "fraction of the returned light that is after the end of the record",
    "unfollowed": "fraction of the waveform that orders beyond the last may add",
}
EXCESS = "excess"


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
    kept_names: tuple[str, ...],
) -> dict[str, Any]:
    """Return the fields of `Waveforms` for one shot, from its components, its energy budget and their errors.

    Also `MISSING_LIGHT` and `EXCESS`, by name.

    `relative_energy`: see `jaxlidar.spectral.apply_optics.relative_energy_samples`. `photons`: number of
    photons traced. `kept_names`: those of `OPTIONAL_ARRAYS` to return. The compiler leaves out what only the
    others need.
    """
    lidar, reflectance = model.lidar, components["first"] + components["higher"]
    energy = energy_at_reference(lidar)[:, None] * relative_energy
    optional_arrays = {
        "reflectance": reflectance,
        "stderr": errors.waveform,
        "energy": energy,
        "recorded": digitise(energy, lidar.wavelength, lidar.receiver),
        "components": components,
        "energy_budget": budget.energy_budget,
        "energy_budget_stderr": errors.energy_budget,
    }
    total = jnp.maximum(jnp.sum(reflectance, axis=-1), 1e-30)
    return {
        "neglected": budget.neglected,
        "lost": budget.lost,
        "error": errors.relative,
        "photons": photons,
        "outside": jnp.max(budget.outside / (total + budget.outside)),
        "unfollowed": jnp.max(budget.unfollowed / total),
        EXCESS: budget_excess(budget.energy_budget, errors.energy_budget),
        **{name: optional_arrays[name] for name in kept_names},
    }
