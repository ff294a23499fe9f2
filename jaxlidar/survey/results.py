"""Results of shots, before they become `Waveforms`."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlidar._not_kept import NotKept
from jaxlidar.sensors.receiver import digitise
from jaxlidar.spectral.apply_optics import BudgetTerms, WaveformModel, budget_excess
from jaxlidar.spectral.waveform import energy_at_reference

# Arrays of JAX within compiled programs, of one shot or of several; of NumPy outside.
_PerSample = Float[Any, "*shots wavelengths samples"]
_PerWavelength = Float[Any, "*shots wavelengths"]


# Arrays of `Waveforms` that `simulate_many(keep=...)` may leave out, each a field of `ShotResults`.
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


class ShotResults(NamedTuple):
    """Results of one shot, or of several along axis 0. The quantities are those of `Waveforms`.

    - `late`: of the emitted light, the fraction after the end of the record. - `unfollowed`: of the waveform,
      the fraction that orders beyond the last may add. Both are the largest of all wavelengths.
    - `excess`: of the sum of the energy budget (`jaxlidar.spectral.apply_optics.budget_excess`).
    - `OPTIONAL_ARRAYS`: None where they are not kept. - `truth`: a `Truths`, or None.
    """

    neglected: _PerWavelength
    lost: _PerWavelength
    error: Float[Any, "*shots"]
    photons: Int[Any, "*shots"]
    late: Float[Any, "*shots"]
    unfollowed: Float[Any, "*shots"]
    excess: Float[Any, "*shots"]
    reflectance: _PerSample = None
    stderr: _PerSample = None
    energy: _PerSample = None
    recorded: _PerSample = None
    # Dicts of such arrays.
    components: Any = None
    energy_budget: Any = None
    energy_budget_stderr: Any = None
    truth: Any = None

    def waveform_fields(self) -> dict[str, Any]:
        """Return the fields that `Waveforms` has, too; arrays that are not kept are `NotKept`."""
        fields = self._asdict()
        for name in ("late", "unfollowed", "excess"):
            del fields[name]
        return fields | {name: NotKept(name) for name in OPTIONAL_ARRAYS if fields[name] is None}


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
) -> ShotResults:
    """Return the results of one shot from its components, its energy budget and their errors.

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
    return ShotResults(
        neglected=budget.neglected,
        lost=budget.lost,
        error=errors.relative,
        photons=photons,
        late=jnp.max(budget.energy_budget["after the window"]),
        unfollowed=jnp.max(budget.neglected / total),
        excess=budget_excess(budget.energy_budget, errors.energy_budget),
        **{name: optional_arrays[name] for name in kept_names},
    )
