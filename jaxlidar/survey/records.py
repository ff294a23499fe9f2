"""What is known of shots before it becomes `Waveforms`, and what is known of their batches."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._statistics import widening
from jaxlidar.instrument.receiver import record
from jaxlidar.spectral.apply_optics import BudgetTerms, WaveformModel
from jaxlidar.spectral.waveform import energy_per_reflectance


class Record(NamedTuple):
    """What is known of shots; axis 0 is the shots'. The quantities are those of `Waveforms`."""

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


def record_of_shot(
    model: WaveformModel,
    components: dict[str, Float[Array, "wavelengths samples"]],
    terms: BudgetTerms,
    stderr: Float[Array, "wavelengths samples"],
    energy_budget_stderr: dict[str, Float[Array, "wavelengths"]],
    error: Array,
    photons: Array,
) -> Record:
    """The record of one shot, of which the components, the balance and their errors are known."""
    lidar, total = model.lidar, components["first"] + components["higher"]
    energy = total * energy_per_reflectance(lidar, model.time)
    return Record(
        reflectance=total,
        stderr=stderr,
        energy=energy,
        recorded=record(energy, lidar.wavelength, lidar.receiver),
        components=components,
        neglected=terms.neglected,
        lost=terms.lost,
        energy_budget=terms.energy_budget,
        energy_budget_stderr=energy_budget_stderr,
        error=error,
        photons=photons,
    )


class BatchMoments(NamedTuple):
    """Means and sums of squared deviations of batches, within compiled programs and of what they return.

    As `jaxlidar._statistics.Moments`, of trees of arrays.
    """

    mean: Any
    squares: Any

    def add(self, value: Any, count: Array) -> "BatchMoments":
        """With one more value (Welford 1962, Technometrics 4, 419); `count` includes it."""
        mean = jax.tree.map(lambda m, v: m + (v - m) / count, self.mean, value)
        more = jax.tree.map(lambda s, v, m, n: s + (v - m) * (v - n), self.squares, value, self.mean, mean)
        return BatchMoments(mean, more)

    def joined(self, count: int, other: "BatchMoments", others: int) -> "BatchMoments":
        """Those of `count` batches and of `others` together (Chan et al. 1983, Am. Stat. 37, 242)."""
        share = others / (count + others)
        mean = jax.tree.map(lambda a, b: a + share * (b - a), self.mean, other.mean)

        def together(s: Any, t: Any, a: Any, b: Any) -> Any:
            return s + t + count * share * (b - a) ** 2

        return BatchMoments(mean, jax.tree.map(together, self.squares, other.squares, self.mean, other.mean))

    def stderr(self, count: Array) -> Any:
        """Standard error of the mean, widened for few batches."""
        share = widening(count) / jnp.sqrt(count * (count - 1.0))
        return jax.tree.map(lambda s: share * jnp.sqrt(jnp.maximum(s, 0.0)), self.squares)
