"""Ground and canopy in a record's energy, gap probability and plant area, without a model of the scene.

`gap_probability` and `plant_area_index` are formulas; `ground_and_canopy` splits a record, and
`plant_area_profile` makes layers of it. All are differentiable.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from inversion.metrics.heights import SignalEnds, find_ground, record, signal_ends
from inversion.metrics.pulses import METRES_PER_NS, Pulse, pulse_samples, response, steps_of
from inversion.metrics.records import over_shots
from jaxlidar.extend import as_array, check_range, concrete

Samples = Float[Array, " bins"]


class GroundAndCanopy(NamedTuple):
    """A record's energy, split, of one record, (), or several, (shots,). NaN where no ground was found.

    - `height`: of the ground in m.
    - `ground`, `canopy`: energy in units of the record, summed over samples.
    - `gap`: gap probability in the direction of the beam.

    **Example:** plant area where the ground was found.

    >>> import inversion, numpy as np
    >>> split = inversion.GroundAndCanopy(*np.array([[2.0, 3.0], [50.0, 80.0], [25.0, 0.0], [0.75, 0.5]]))
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
    """Energy of ground and canopy by the ground's lower half, which no canopy reaches, and the gap
    probability.

    What returns after the mode of the ground's echo is the ground's alone. That energy over the share of the
    pulse that comes after its own mode is the ground's; what is left of the signal is the canopy's. Slopes
    and roughness that widen the echo evenly change little. Differentiable in `power`.

    **Arguments:**

    - `height`, `power`, `pulse`, `noise`: as for `signal_ends`.
    - `ground`: height of the ground in m, () or (shots,): where the pulse's time zero lies. Default:
      `find_ground`'s.
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
    check_range("reflectance_ratio", reflectance_ratio, 0.0, low_open=True)
    if ground is None:
        ground = find_ground(height, power, pulse=pulse, noise=noise)
    if ends is None:
        ends = signal_ends(height, power, pulse=pulse, noise=noise)
    top, bottom = (as_array(end) for end in ends)
    z, y, count = record(height, power)
    lags = pulse_samples(pulse, steps_of(height, METRES_PER_NS))
    base = as_array(ground)
    below, above = _below_and_above(z, y, count, lags, base, top, bottom)
    canopy = jnp.maximum(above - below, 0.0)
    total = canopy + below * reflectance_ratio
    gap = 1.0 - canopy / jnp.where(total > 0, total, 1.0)
    return GroundAndCanopy(base, below, canopy, jnp.where(total > 0, gap, jnp.nan))


@over_shots(1, 1, 0, 1, 0, 0, 0)
def _below_and_above(z, y, count, pulse, ground, top, bottom):
    """Energy of the ground, at most all, and all energy between the signal's ends."""
    step = z[0] - z[1]
    real = jnp.arange(y.size) < count

    def above(level):
        """Energy that returns from above a height, of samples as wide as a step."""
        share = jnp.clip((z + 0.5 * step - level) / step, 0.0, 1.0)
        return jnp.sum(jnp.where(real, y * share, 0.0))

    total = above(bottom) - above(top)
    mode = response(pulse).mode
    late = above(bottom) - above(ground - mode * step)
    lag = jnp.arange(pulse.size) - pulse.size // 2
    after = jnp.sum(pulse * jnp.clip(lag + 0.5 - mode, 0.0, 1.0)) / jnp.sum(pulse)
    energy = jnp.maximum(late, 0.0) / jnp.maximum(after, 1e-3)
    missing = jnp.isnan(ground) | jnp.isnan(top)
    return jnp.where(missing, jnp.nan, jnp.minimum(energy, total)), jnp.where(missing, jnp.nan, total)


def gap_probability(
    canopy: Float[ArrayLike, " bins"] | Sequence[float],
    ground: Float[ArrayLike, ""],
    *,
    reflectance_ratio: float = 1.5,
) -> Samples:
    """Gap probability from above the canopy down to each sample, in the direction of the beam.

    P(z) = 1 - Rv(z) / (Rv + Rg rho_v / rho_g), with Rv(z) the energy that the canopy returned from above z.

    **Arguments:**

    - `canopy`: (bins,) energy of the canopy's return per sample, from the top down.
    - `ground`: energy of the ground's return, in the same unit.
    - `reflectance_ratio`: rho_v / rho_g, of apparent reflectances, above 0. Default 1.5, GEDI's.

    **Returns:** (bins,) gap probability.

    **Raises:** ValueError for a `reflectance_ratio` that is not above 0.

    **Source:** Ni-Meister et al. (2001), IEEE Trans. Geosci. Remote Sens. 39, 1943; Tang and Armston (2019),
    GEDI footprint canopy cover and vertical profile metrics (theoretical basis document).

    **Example:**

    >>> import inversion
    >>> gap = inversion.gap_probability([0.1, 0.2, 0.1], 0.2)
    >>> [f"{float(p):.2f}" for p in gap]
    ['0.86', '0.57', '0.43']
    """
    check_range("reflectance_ratio", reflectance_ratio, 0.0, low_open=True)
    above = jnp.cumsum(as_array(canopy))
    total = above[-1] + as_array(ground) * reflectance_ratio
    return 1.0 - above / jnp.where(total > 0, total, 1.0)


def plant_area_index(
    gap: Float[ArrayLike, "*s"], *, zenith: float = 0.0, projection: float = 0.5, clumping: float = 1.0
) -> Float[Array, "*s"]:
    """Plant area index above each level from the gap probability there: -ln(P) cos(zenith) / (G Omega).

    **Arguments:**

    - `gap`: gap probability P, of any shape, above 0, at most 1.
    - `zenith`: angle between the beam and the vertical in degrees, 0 to below 90. Default 0.
    - `projection`: G, mean projection of unit plant area onto the plane across the beam, above 0, at most 1.
      Default 0.5 (random orientations).
    - `clumping`: clumping index Omega, above 0. Default 1 (random positions).

    **Returns:** m2 of plant area per m2 of ground, of the shape of `gap`.

    **Raises:** ValueError for arguments outside their ranges.

    **Example:**

    >>> import inversion
    >>> print(f"{float(inversion.plant_area_index(0.5)):.2f}")
    1.39
    """
    check_range("gap", gap, 0.0, 1.0, low_open=True)
    check_range("zenith", zenith, 0.0, 90.0, high_open=True)
    check_range("projection", projection, 0.0, 1.0, low_open=True)
    check_range("clumping", clumping, 0.0, low_open=True)
    return -jnp.log(as_array(gap)) * jnp.cos(jnp.deg2rad(zenith)) / (projection * clumping)


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
    """Plant area density of layers by the closed-form gap inversion, as GEDI's level 2B has it.

    The ground's energy is that of `ground_and_canopy`; its echo is taken as even about its mode, of the shape
    that its lower half shows, and subtracted. What is left, cumulated from the top, gives the gap
    probability at the edges of the layers, and its logarithm's differences the plant area. Noise is not
    smoothed: densities may be negative. The pulse is not taken out: layers thinner than it share their
    plants. Differentiable in `power`.

    **Arguments:**

    - `height`, `power`, `pulse`, `ground`, `ends`, `noise`, `reflectance_ratio`: as for `ground_and_canopy`.
    - `edges`: (edges,) heights of the layers' edges above the ground in m, increasing, at least two.
    - `zenith`, `projection`, `clumping`: as for `plant_area_index`.
    - `smallest_gap`: gap probabilities below it are taken for it, in (0, 1). Default 1e-3.

    **Returns:** (layers,) or (shots, layers) m2 of plant area per m3, from the lowest layer up. NaN where no
    ground was found.

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
    >>> given = {"edges": edges, "pulse": pulse, "reflectance_ratio": 1.0}
    >>> density = inversion.plant_area_profile(height, power, **given)
    >>> [f"{float(d):.1f}" for d in 2.0 * density]
    ['0.2', '0.5', '0.3']
    """
    check_range("smallest_gap", smallest_gap, 0.0, 1.0, low_open=True, high_open=True)
    levels = as_array(edges, "edges")
    known = concrete(levels)
    if levels.ndim != 1 or levels.size < 2 or (known is not None and not np.all(np.diff(known) > 0)):
        raise ValueError(f"edges = {edges}; admissible are two heights or more, increasing")
    if ends is None:
        ends = signal_ends(height, power, pulse=pulse, noise=noise)
    split = ground_and_canopy(
        height, power, pulse=pulse, ground=ground, ends=ends, noise=noise, reflectance_ratio=reflectance_ratio
    )
    z, y, count = record(height, power)
    lags = pulse_samples(pulse, steps_of(height, METRES_PER_NS))
    total = split.canopy + split.ground * reflectance_ratio
    above = _canopy_above(z, y, count, lags, split.height, split.ground, *map(as_array, ends), levels)
    above = jnp.clip(above, 0.0, split.canopy[..., None])
    gap = 1.0 - above / jnp.where(total > 0, total, 1.0)[..., None]
    gap = jnp.where((total > 0)[..., None], jnp.maximum(gap, smallest_gap), jnp.nan)
    depth = jnp.diff(jnp.log(gap), axis=-1) / jnp.diff(levels)[(None,) * (gap.ndim - 1)]
    check_range("zenith", zenith, 0.0, 90.0, high_open=True)
    check_range("projection", projection, 0.0, 1.0, low_open=True)
    check_range("clumping", clumping, 0.0, low_open=True)
    return depth * jnp.cos(jnp.deg2rad(zenith)) / (projection * clumping)


@over_shots(1, 1, 0, 1, 0, 0, 0, 0, 1)
def _canopy_above(z, y, count, pulse, ground, energy, top, bottom, levels):
    """The canopy's energy from above heights over the ground: all of it, less the ground's even echo."""
    step = z[0] - z[1]
    real = jnp.arange(y.size) < count
    mode = ground - response(pulse).mode * step

    def between(low, high):
        share = jnp.clip((z + 0.5 * step - low) / step, 0.0, 1.0)
        share = share - jnp.clip((z + 0.5 * step - high) / step, 0.0, 1.0)
        return jnp.sum(jnp.where(real, y * share, 0.0))

    half = jnp.maximum(between(bottom, mode), 1e-30)

    def one(level):
        # Of the ground's upper half, as much comes from above a level as, mirrored, of the lower half.
        rise = jnp.maximum(ground + level - mode, 0.0)
        share = jnp.clip(between(bottom, mode - rise) / half, 0.0, 1.0)
        return between(ground + level, top) - 0.5 * energy * share

    return jax.vmap(one)(levels)
