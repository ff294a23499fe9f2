"""Prior distributions of unknowns: log-normal, a Gaussian process for profiles, a Markov field for maps.

A normal prior is a plain pair (mean, standard deviation) of `Unknown`. `inversion.fit.prior_residuals` turns
all priors of a fit of one waveform into residuals, `inversion.scene.map_priors` those of maps.
"""

from functools import partial
from typing import final

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxlidar.extend import (
    Range,
    as_array,
    as_optional_array,
    as_optional_scalar,
    as_scalar,
    check_integer,
    check_ranges,
    quantity,
)

_POSITIVE = Range(0.0, low_open=True)


@final
class LogNormal(eqx.Module):
    """A log-normal prior: a normal distribution of the logarithm of a positive unknown.

    **Arguments:**

    - `median`: in the unknown's own unit, positive, a number or an array.
    - `spread`: standard deviation of the natural logarithm (sigma of ln x), positive, a number or an array.
      For instance, 0.5 means within a factor of 1.65 of the median, to one standard deviation.

    **Raises:** ValueError for a `median` or `spread` that is not positive.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> prior = inversion.LogNormal(median=0.3, spread=0.5)
    >>> unknown = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), prior=prior)
    >>> print(f"{float(unknown.prior.median):.1f}")
    0.3
    """

    median: Float[Array, "..."] = quantity(range=_POSITIVE, converter=as_array)
    spread: Float[Array, "..."] = quantity(range=_POSITIVE, converter=as_array)

    def __check_init__(self):
        check_ranges(self)


@final
class Smooth(eqx.Module):
    r"""A smoothness prior of a profile: its layers are a Gaussian process, in the unknown's own unit.

    The values x of layers i and j have

        covariance(x_i, x_j) = strength^2 ((1 + d) exp(-d) + 9),   d = sqrt(3) |i - j| spacing / scale,

    a Matern 3/2 kernel about a common level. `strength` is the standard deviation of the process (the signal
    standard deviation, or amplitude): a larger one is a weaker prior. The 9 is the prior variance of the
    common level, (3 strength)^2, about the mean of the start. With a `mean` the 9 is absent. The prior fills
    in layers that the data leave open; `Retrieval.averaging_kernel` shows where. Bounds, such as that no
    layer is negative, hold as well.

    A strength left to the data maximises the evidence: the probability of the data with the unknowns
    integrated out, for the simulation linearised about the fit and without bounds. The fit is repeated with
    this strength until it changes by less than 10 %. The strength is sought between 1e-4 and 3 times the
    widest bounds. The evidence takes the noise as stated: if the model has further errors, the strength comes
    out too large.

    **Arguments:**

    - `scale`: length scale of the kernel, the correlation length of the profile, in the unit of `spacing`,
      positive.
    - `spacing`: distance between layers, positive: in m for a `scale` in m. Default 1: `scale` in layers.
    - `strength`: standard deviation of a layer about the common level, in the unknown's own unit, positive;
      a larger one smooths less. Default None: by the data.
    - `mean`: of the profile, in the unknown's own unit, one number or one for each layer. Default None: a
      common level with the prior above, about the mean of the start.

    **Raises:** ValueError for a `scale`, `spacing` or `strength` that is not positive.

    **Source:** Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, sections 2.7, 4.2 and
    5.4; evidence: MacKay (1992), Neural Comput. 4, 415.

    **Example:** ten layers of 2 m, correlated over 4 m.

    >>> import inversion, numpy as np
    >>> prior = inversion.Smooth(scale=4.0, spacing=2.0)
    >>> where, start = "canopy.voxels.leaf", np.full((1, 1, 10), 0.1)
    >>> unknown = inversion.Unknown(where, bounds=(0.0, 2.0), prior=prior, start=start)
    >>> print(np.round(prior.correlation(3)[0], 2))
    [1.   0.78 0.48]
    """

    scale: Float[Array, ""] = quantity(range=_POSITIVE, converter=as_scalar)
    spacing: Float[Array, ""] = quantity(range=_POSITIVE, converter=as_scalar, default=1.0, kw_only=True)
    strength: Float[Array, ""] | None = quantity(
        range=_POSITIVE, converter=as_optional_scalar, default=None, kw_only=True
    )
    mean: Float[Array, "..."] | None = quantity(converter=as_optional_array, default=None, kw_only=True)

    def __check_init__(self):
        check_ranges(self)

    def correlation(self, layers: int) -> Float[np.ndarray, "layers layers"]:
        """Correlation between layers, without the common level.

        **Arguments:** `layers`: their number.

        **Returns:** (layers, layers).
        """
        # In correlation lengths.
        position = np.arange(check_integer("layers", layers)) * float(self.spacing) / float(self.scale)
        distance = np.sqrt(3.0) * np.abs(np.subtract.outer(position, position))
        return (1.0 + distance) * np.exp(-distance)


@final
class MarkovField(eqx.Module):
    r"""A prior of a map, such as leaf area density in voxels or heights of terrain: smooth, and sparse.

    Values of neighbours along an axis differ by a normal random number of the standard deviation
    `difference`, independent of all other differences (an intrinsic Gaussian Markov random field of first
    order):

        -2 ln density = sum over axes and neighbours of  (x_i - x_j)^2 / difference^2  +  2 sum of x_i / mean

    The second term is an exponential prior of each value, with the `mean` that it would have without the
    first. It pulls values to zero alike, large and small, and so leaves few that are not zero (L1 penalty).

    For `retrieve_scene`. The field has no level of its own: where no light comes, it continues the values
    around.

    **Arguments:**

    - `difference`: standard deviation of the difference of neighbours, in the unknown's own unit, positive:
      one number, or one for each axis of the unknown. Infinite along axes without smoothing.
    - `mean`: mean of the exponential prior, in the unknown's own unit, positive; it needs bounds of 0 or
      above. Default None: no such prior.

    **Raises:** ValueError for values that are not positive, and for a `difference` with more than one axis.

    **Source:** Rue and Held (2005), Gaussian Markov Random Fields, section 3.3; L1: Tibshirani (1996), J. R.
    Stat. Soc. B 58, 267.

    **Example:** leaf area density in voxels, smoother along x and y than along z.

    >>> import inversion, numpy as np
    >>> prior = inversion.MarkovField((0.1, 0.1, 0.3), mean=0.2)
    >>> voxels = inversion.Unknown("canopy.voxels.leaf", bounds=(0.0, 2.0), prior=prior)
    >>> print(voxels.prior.difference)
    [0.1 0.1 0.3]
    """

    # Infinity is admissible, so that it states no range.
    difference: Float[Array, "..."] = eqx.field(converter=partial(as_array, field="difference"))
    mean: Float[Array, ""] | None = quantity(
        range=_POSITIVE, converter=as_optional_scalar, default=None, kw_only=True
    )

    def __check_init__(self):
        difference = np.asarray(self.difference)
        if difference.ndim > 1 or difference.size == 0:
            raise ValueError(
                f"difference has the shape {difference.shape}; admissible is one number, or one for each axis"
            )
        # Written so that NaN is refused.
        if not np.all(difference > 0):
            raise ValueError(f"difference = {difference} is outside the admissible range (0, inf]")
        check_ranges(self)
