"""Ground and canopy in a record's energy, gap probability and plant area, without a model of the scene.

`gap_probability` and `plant_area_index` are formulas; `ground_and_canopy` splits a record. All are
differentiable.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from inversion.heights import SignalEnds, find_ground, record, signal_ends
from inversion.pulses import METRES_PER_NS, Pulse, pulse_samples, response, steps_of
from inversion.records import over_shots
from jaxlidar.extend import as_array, check_range

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
