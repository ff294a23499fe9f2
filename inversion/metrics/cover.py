r"""Energy of ground and canopy in a record, gap probability and plant area, without a model of the scene.

**Split.** The record between the ends of its signal is E(z1, z2), the energy from heights z1 to z2. Nothing
but ground returns light below the mode m of the ground's echo. With phi the fraction of the pulse's energy
that follows the pulse's own mode,

    E_ground = E(bottom, m) / phi,    E_canopy = E(bottom, top) - E_ground

(Drake et al. 2002, whose symmetric echo has phi = 1/2).

**Gap probability** down to z, with Rv(z) the canopy's energy from above z (Ni-Meister et al. 2001):

    P(z) = 1 - Rv(z) / (Rv + Rg rho_v / rho_g),    Rv = E_canopy, Rg = E_ground.

**Plant area** by Beer's law, with G the projection function, Omega the clumping index and theta the zenith
angle of the beam:

    PAI(z) = -ln P(z) cos(theta) / (G Omega),    density of a layer = -d PAI / dz.

All functions are differentiable.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from inversion.metrics.heights import SignalEnds, relative_ground, relative_signal_ends
from inversion.metrics.records import PaddedRecord, pad_record, sample_pulse_at_heights, smooth_pulse
from jaxlidar.extend import as_array, check_numbers, check_range, concrete
from jaxlidar.survey.records import Pulse, divide_by_largest, over_shots

# Least fraction of a pulse after its mode, and least energy of an echo's lower half over the largest sample,
# that are divided by.
_LEAST_LATE_FRACTION, _LEAST_HALF = 1e-3, 1e-30

Samples = Float[Array, " bins"]


class GroundAndCanopy(NamedTuple):
    """Energy of ground and canopy in one record, (), or several, (shots,). NaN in records without ground.

    - `height`: of the ground in m.
    - `ground`, `canopy`: energy in units of the record, summed over samples.
    - `gap`: gap probability in the direction of the beam.

    **Example:** plant area of two records.

    >>> import inversion, numpy as np
    >>> from inversion.metrics.cover import GroundAndCanopy
    >>> split = GroundAndCanopy(*np.array([[2.0, 3.0], [50.0, 80.0], [25.0, 0.0], [0.75, 0.5]]))
    >>> np.round(inversion.plant_area_index(split.gap), 2)
    Array([0.58, 1.39], dtype=float32)
    """

    height: Float[Array, "..."]
    ground: Float[Array, "..."]
    canopy: Float[Array, "..."]
    gap: Float[Array, "..."]


def ground_and_canopy(
    height: Float[ArrayLike, "... bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    pulse: Pulse,
    ground: Float[ArrayLike, "..."] | None = None,
    ends: SignalEnds | tuple[ArrayLike, ArrayLike] | None = None,
    noise: Float[ArrayLike, "..."] | None = None,
    reflectance_ratio: float = 1.5,
) -> GroundAndCanopy:
    """Split a record's energy into ground and canopy, and return the gap probability.

    Light that returns after the mode of the ground's echo is the ground's alone. Its energy over the fraction
    of the pulse that follows the pulse's own mode is the ground's; the rest of the signal is the canopy's.
    Slope and roughness that widen the echo evenly change little. Differentiable in `power`.

    **Arguments:**

    - `height`, `power`, `pulse`, `noise`: as for `signal_ends`.
    - `ground`: height of the ground in m, () or (shots,), at the echo's time zero. Default: `find_ground`'s.
    - `ends`: of the signal in m. Default: those of `signal_ends`.
    - `reflectance_ratio`: rho_v / rho_g, above 0. Default 1.5, GEDI's.

    **Returns:** a `GroundAndCanopy`. For the plant area index, pass its `gap` to `plant_area_index`.

    **Raises:** ValueError for inadmissible arguments.

    **Source:** the split is that of a symmetric ground echo (Drake et al. 2002, Remote Sens. Environ. 79,
    305) for a pulse of any shape; gap probability as in `gap_probability`.

    **Example:** of an even canopy, 40 % of the energy, above the ground.

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -8.0, -0.15)
    >>> pulse = np.exp(-0.5 * (np.arange(-20.0, 21.0) / 5.0) ** 2)
    >>> target = np.where((height > 4.0) & (height < 12.0), 1.0, 0.0)
    >>> target *= 40.0 / target.sum()
    >>> target[np.argmin(np.abs(height))] = 60.0
    >>> power = np.convolve(target, pulse / pulse.sum(), mode="same")
    >>> split = inversion.ground_and_canopy(height, power, pulse=pulse)
    >>> print(f"ground {split.ground:.0f}, canopy {split.canopy:.0f}, gap {split.gap:.2f}")
    ground 60, canopy 40, gap 0.69
    """
    record = pad_record(height, power)
    split = _split_record(record, pulse, ground, ends, noise, reflectance_ratio)
    gap = 1.0 - split.canopy / jnp.where(split.total > 0, split.total, 1.0)
    return GroundAndCanopy(
        record.heights.absolute(split.ground_height),
        record.times_magnitude(split.ground),
        record.times_magnitude(split.canopy),
        jnp.where(split.total > 0, gap, jnp.nan),
    )


class _SplitRecord(NamedTuple):
    """Energies of a record over its magnitude, and heights over its first sample; (...,) each.

    - `ground_height`: of the echo's time zero.
    - `top`, `bottom`: ends of the signal.
    - `ground`, `canopy`: energies.
    - `total`: energy that the footprint would return if all of it were as bright as plants.
    - `lags`: (..., lags) samples of the pulse.
    """

    ground_height: Array
    top: Array
    bottom: Array
    ground: Array
    canopy: Array
    total: Array
    lags: Array


def _split_record(
    record: PaddedRecord,
    pulse: Pulse,
    ground: ArrayLike | None,
    ends: SignalEnds | tuple[ArrayLike, ArrayLike] | None,
    noise: ArrayLike | None,
    reflectance_ratio: float,
) -> _SplitRecord:
    """Split a record's energy into ground and canopy; arguments as for `ground_and_canopy`."""
    check_range("reflectance_ratio", reflectance_ratio, 0.0, low_open=True)
    if ground is None:
        ground_height = relative_ground(record, pulse=pulse, noise=noise)
    else:
        ground_height = record.heights.relative(ground, "ground")
    if ends is None:
        top, bottom = relative_signal_ends(record, pulse=pulse, noise=noise)
    else:
        top, bottom = (record.heights.relative(end, "ends") for end in ends)
    lags = sample_pulse_at_heights(pulse, record.heights)
    ground_energy, signal_energy = _split_energy(
        **record.arguments(), pulse=lags, ground=ground_height, top=top, bottom=bottom
    )
    canopy_energy = jnp.maximum(signal_energy - ground_energy, 0.0)
    total = canopy_energy + ground_energy * reflectance_ratio
    return _SplitRecord(ground_height, top, bottom, ground_energy, canopy_energy, total, lags)


def _energy_between(step, power, n_samples, low, high=jnp.inf):
    """Energy of a padded record between two heights, with each sample spread evenly over its step."""
    top = -step * jnp.arange(power.size, dtype=power.dtype) + 0.5 * step
    fraction = jnp.clip((top - low) / step, 0.0, 1.0) - jnp.clip((top - high) / step, 0.0, 1.0)
    return jnp.sum(jnp.where(jnp.arange(power.size) < n_samples, power * fraction, 0.0))


@over_shots(step=0, power=1, n_samples=0, pulse=1, ground=0, top=0, bottom=0)
def _split_energy(step, power, n_samples, pulse, ground, top, bottom):
    """Energy of the ground, at most that of the signal, and energy of the signal, of one padded record.

    1. Energy of the signal, between its ends.
    2. Energy below the mode of the ground's echo, which lies `mode` samples after its time zero.
    3. Fraction of the pulse's energy after its mode, each sample spread evenly over its step.
    """
    above = partial(_energy_between, step, power, n_samples)
    signal_energy = above(bottom) - above(top)
    # The mode of the smoothed pulse, as `find_ground` reads the smoothed record.
    mode = smooth_pulse(pulse).mode
    late_energy = above(bottom) - above(ground - mode * step)
    lag = jnp.arange(pulse.size, dtype=pulse.dtype) - pulse.size // 2
    late_fraction = jnp.sum(pulse * jnp.clip(lag + 0.5 - mode, 0.0, 1.0)) / jnp.sum(pulse)
    # The energy of a pulse that ends at its mode cannot be derived from the light after it.
    ground_energy = jnp.maximum(late_energy, 0.0) / jnp.maximum(late_fraction, _LEAST_LATE_FRACTION)
    is_missing = jnp.isnan(ground) | jnp.isnan(top)
    ground_energy = jnp.minimum(ground_energy, signal_energy)
    return jnp.where(is_missing, jnp.nan, ground_energy), jnp.where(is_missing, jnp.nan, signal_energy)


def gap_probability(
    canopy: Float[ArrayLike, " bins"] | Sequence[float],
    ground: Float[ArrayLike, ""],
    *,
    reflectance_ratio: float = 1.5,
) -> Samples:
    """Return the gap probability from above the canopy down to each sample, in the direction of the beam.

    P(z) = 1 - Rv(z) / (Rv + Rg rho_v / rho_g), with Rv(z) the energy that the canopy returned from above z.

    **Arguments:**

    - `canopy`: (bins,) energy of the canopy's return per sample, from the top down.
    - `ground`: energy of the ground's return, in the same unit.
    - `reflectance_ratio`: rho_v / rho_g, of apparent reflectances, above 0. Default 1.5, GEDI's.

    **Returns:** (bins,) gap probability; NaN where noise makes the sum of all energy negative.

    **Raises:** ValueError for energies that are not finite, a negative `ground`, and a `reflectance_ratio`
    that is not above 0.

    **Source:** Ni-Meister et al. (2001), IEEE Trans. Geosci. Remote Sens. 39, 1943; Tang and Armston (2019),
    GEDI footprint canopy cover and vertical profile metrics (theoretical basis document).

    **Example:**

    >>> import inversion
    >>> gap = inversion.gap_probability([0.1, 0.2, 0.1], 0.2)
    >>> [f"{float(p):.2f}" for p in gap]
    ['0.86', '0.57', '0.43']
    """
    check_range("reflectance_ratio", reflectance_ratio, 0.0, low_open=True)
    check_range("ground", ground, 0.0)
    if np.ndim(canopy) != 1 or np.ndim(ground):
        raise ValueError(
            f"canopy and ground have the shapes {np.shape(canopy)} and {np.shape(ground)}; admissible are "
            "(bins,) and ()"
        )
    check_range("canopy", canopy)
    canopy_values, ground_value = concrete(canopy), concrete(ground)
    if canopy_values is None or ground_value is None:
        all_energy = jnp.append(as_array(canopy, "canopy"), as_array(ground, "ground"))
    else:
        all_energy = np.append(canopy_values, ground_value)
    energies, _ = divide_by_largest(all_energy, "canopy and ground")
    canopy_above = jnp.cumsum(energies[:-1])
    total = canopy_above[-1] + energies[-1] * reflectance_ratio
    gap = 1.0 - canopy_above / jnp.where(total > 0, total, 1.0)
    # Nothing returned, nothing intercepted: the gap probability of an empty record is one. Noise that makes
    # the sum negative leaves none.
    return jnp.where((total > 0) | (jnp.max(jnp.abs(energies)) == 0), gap, jnp.nan)


def plant_area_index(
    gap: Float[ArrayLike, "*s"], *, zenith: float = 0.0, projection: float = 0.5, clumping: float = 1.0
) -> Float[Array, "*s"]:
    """Return the plant area index above each level from its gap probability: -ln(P) cos(zenith) / (G Omega).

    **Arguments:**

    - `gap`: gap probability P, of any shape, in [0, 1]; NaN where it is missing.
    - `zenith`: angle between the beam and the vertical in degrees, 0 to below 90. Default 0.
    - `projection`: G, mean projection of unit plant area onto the plane across the beam, above 0, at most 1.
      Default 0.5 (random orientations).
    - `clumping`: clumping index Omega, above 0. Default 1 (random positions).

    **Returns:** m2 of plant area per m2 of ground, of the shape of `gap`; infinite where P is 0, which is
    where no light of the ground was recorded, and NaN where P is missing.

    **Raises:** ValueError for arguments outside their ranges.

    **Example:**

    >>> import inversion
    >>> print(f"{float(inversion.plant_area_index(0.5)):.2f}")
    1.39
    """
    check_numbers("gap", gap)
    values = concrete(gap)
    if values is not None:
        check_range("gap", values[~np.isnan(values)], 0.0, 1.0)
    _check_canopy_structure(zenith, projection, clumping)
    return -jnp.log(as_array(gap, "gap")) * jnp.cos(jnp.deg2rad(zenith)) / (projection * clumping)


def _check_canopy_structure(zenith: Any, projection: Any, clumping: Any) -> None:
    """Check the arguments that turn optical depth into plant area. **Raises:** ValueError."""
    check_range("zenith", zenith, 0.0, 90.0, high_open=True)
    check_range("projection", projection, 0.0, 1.0, low_open=True)
    check_range("clumping", clumping, 0.0, low_open=True)


def plant_area_profile(
    height: Float[ArrayLike, "... bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    edges: Float[ArrayLike, " edges"] | Sequence[float],
    pulse: Pulse,
    ground: Float[ArrayLike, "..."] | None = None,
    ends: SignalEnds | tuple[ArrayLike, ArrayLike] | None = None,
    noise: Float[ArrayLike, "..."] | None = None,
    reflectance_ratio: float = 1.5,
    zenith: float = 0.0,
    projection: float = 0.5,
    clumping: float = 1.0,
    smallest_gap: float = 1e-3,
) -> Float[Array, "... layers"]:
    """Return the plant area density of layers by the closed-form gap inversion of GEDI's level 2B.

    The ground's energy is that of `ground_and_canopy`. Its echo is taken as symmetric about its mode, with
    the shape of its lower half, and subtracted. The rest, cumulated from the top, gives the gap probability
    at the edges of the layers; differences of its logarithm give the plant area. Noise is not smoothed:
    densities may be negative. The pulse is not deconvolved: layers thinner than it mix their plants.
    Differentiable in `power`.

    **Arguments:**

    - `height`, `power`, `pulse`, `ground`, `ends`, `noise`, `reflectance_ratio`: as for `ground_and_canopy`.
    - `edges`: (edges,) heights of the layers' edges above the ground in m, increasing, at least two.
    - `zenith`, `projection`, `clumping`: as for `plant_area_index`.
    - `smallest_gap`: lower limit of gap probabilities, in (0, 1). Default 1e-3.

    **Returns:** (layers,) or (shots, layers) m2 of plant area per m3, from the lowest layer up. NaN in
    records without ground.

    **Raises:** ValueError for inadmissible arguments.

    **Source:** Ni-Meister et al. (2001), IEEE Trans. Geosci. Remote Sens. 39, 1943; Tang and Armston (2019),
    GEDI footprint canopy cover and vertical profile metrics (theoretical basis document).

    **Example:** an even canopy of plant area 2 between 4 and 12 m, as bright as the ground.

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -8.0, -0.1)
    >>> gap = np.exp(-0.125 * np.clip(12.0 - height, 0.0, 8.0))
    >>> power = np.diff(1.0 - gap, append=1.0 - gap[-1])
    >>> power[np.argmin(np.abs(height))] += gap[-1]
    >>> pulse = np.exp(-0.5 * (np.arange(-9.0, 10.0) / 3.0) ** 2)
    >>> power = np.convolve(power, pulse / pulse.sum(), mode="same")
    >>> edges = [2.0, 6.0, 10.0, 14.0]
    >>> options = {"edges": edges, "pulse": pulse, "reflectance_ratio": 1.0}
    >>> density = inversion.plant_area_profile(height, power, **options)
    >>> [f"{float(d):.1f}" for d in 2.0 * density]
    ['0.2', '0.5', '0.3']
    """
    check_range("smallest_gap", smallest_gap, 0.0, 1.0, low_open=True, high_open=True)
    edge_heights = as_array(edges, "edges")
    # Inside a JAX transformation that traces the edges, their order cannot be checked.
    edge_values = concrete(edge_heights)
    if (
        edge_heights.ndim != 1
        or edge_heights.size < 2
        or (edge_values is not None and not np.all(np.diff(edge_values) > 0))
    ):
        raise ValueError(f"edges = {edges}; admissible are two heights or more, increasing")
    record = pad_record(height, power)
    split = _split_record(record, pulse, ground, ends, noise, reflectance_ratio)
    total = split.total
    canopy_above = _canopy_energy_above(
        **record.arguments(),
        pulse=split.lags,
        ground=split.ground_height,
        ground_energy=split.ground,
        top=split.top,
        bottom=split.bottom,
        levels=edge_heights,
    )
    # Noise, and levels above the signal's top, make it negative or larger than all of the canopy's.
    canopy_above = jnp.clip(canopy_above, 0.0, split.canopy[..., None])
    gap = 1.0 - canopy_above / jnp.where(total > 0, total, 1.0)[..., None]
    gap = jnp.where((total > 0)[..., None], jnp.maximum(gap, smallest_gap), jnp.nan)
    # ln P grows with height, so the extinction of each layer is its difference over the thickness.
    thickness = jnp.diff(edge_heights)[(None,) * (gap.ndim - 1)]
    extinction = jnp.diff(jnp.log(gap), axis=-1) / thickness
    _check_canopy_structure(zenith, projection, clumping)
    return extinction * jnp.cos(jnp.deg2rad(zenith)) / (projection * clumping)


@over_shots(step=0, power=1, n_samples=0, pulse=1, ground=0, ground_energy=0, top=0, bottom=0, levels=1)
def _canopy_energy_above(step, power, n_samples, pulse, ground, ground_energy, top, bottom, levels):
    """Energy of the canopy from above levels over the ground, of one padded record.

    It is all energy from above a level, less that of the ground's echo. The upper half of a symmetric echo
    has, from above a height r over its mode m, as much energy as the lower half has from below m - r:

        E_canopy(z) = E(z, top) - E_ground / 2 * E(bottom, m - r) / E(bottom, m),    r = z - m.
    """
    mode = ground - smooth_pulse(pulse).mode * step

    between = partial(_energy_between, step, power, n_samples)
    lower_half = jnp.maximum(between(bottom, mode), _LEAST_HALF)

    def canopy_above(level):
        rise = jnp.maximum(ground + level - mode, 0.0)
        fraction = jnp.clip(between(bottom, mode - rise) / lower_half, 0.0, 1.0)
        return between(ground + level, top) - 0.5 * ground_energy * fraction

    return jax.vmap(canopy_above)(levels)
