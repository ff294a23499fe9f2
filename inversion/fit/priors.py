"""Priors of unknowns, as residuals that they add to a fit, and the free parameter of a bounded value."""

import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from scipy import linalg, optimize, special

from jaxlidar.extend import as_array, as_scalar, check_range

if TYPE_CHECKING:
    from inversion.fit.unknowns import Settled

# Standard deviation of a smooth profile's level, in strengths, where it has no mean.
_LEVEL = 3.0
# Strengths of smoothness priors, in widths of bounds: the first that is tried, and the range; largest step.
_BEGIN, _STRENGTHS, _LEAP = 0.1, (1e-4, 3.0), 3.0
# Variance that layers have of their own, as a share: rounding, where a profile is alike throughout.
_NUGGET = 1e-8


def inside(z: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value at a free parameter, and its derivative."""
    share = special.expit(z)
    return low + (high - low) * share, (high - low) * share * special.expit(-z)


def outside(value: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Free parameter of a value within its bounds: the inverse of `inside`."""
    return np.log(value - low) - np.log(high - value)


@final
class LogNormal(eqx.Module):
    """A log-normal prior: a normal distribution of the logarithm of a positive unknown.

    **Arguments:**

    - `median`: in the unknown's own unit, positive, a number or an array.
    - `spread`: standard deviation of the natural logarithm, positive, a number or an array. For instance, 0.5
      means within a factor of 1.65 of the median, to one standard deviation.

    **Raises:** ValueError for a `median` or `spread` that is not positive.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> prior = inversion.LogNormal(median=0.3, spread=0.5)
    >>> unknown = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), prior=prior)
    >>> print(f"{float(unknown.prior.median):.1f}")
    0.3
    """

    median: Float[Array, "..."] = eqx.field(converter=as_array)
    spread: Float[Array, "..."] = eqx.field(converter=as_array)

    def __check_init__(self):
        check_range("median", self.median, 0.0, low_open=True)
        check_range("spread", self.spread, 0.0, low_open=True)


@final
class Smooth(eqx.Module):
    r"""A smoothness prior of a profile: its layers are a Gaussian process, in the unknown's own unit.

    Of the values x of layers i and j,

        covariance(x_i, x_j) = strength^2 ((1 + d) exp(-d) + 9),   d = sqrt(3) |i - j| spacing / scale,

    a Matern process of one derivative about a common level, which is left to the data: the 9 is not there
    where a `mean` is given. The prior fills in what the data leave open, and tells that it did: see
    `Retrieval.averaging_kernel`. Bounds, such as that no layer has less than nothing, hold beside it.

    A strength left to the data is that of the largest evidence: the probability of the data where the
    unknowns are integrated out, with the simulation linearised about the fit and bounds left out. The fit
    goes on with it, until it changes by less than 10 %. It is sought between 1e-4 and 3 times the widest
    bounds. The evidence takes the noise as stated: where the model is wrong beyond it, the strength comes out
    too large.

    **Arguments:**

    - `scale`: length over which the profile is alike, in the unit of `spacing`, positive.
    - `spacing`: distance between layers, positive: in m for a `scale` in m. Default 1: `scale` in layers.
    - `strength`: standard deviation of a layer about the common level, in the unknown's own unit, positive.
      Default None: by the data.
    - `mean`: of the profile, in the unknown's own unit, one number or one for each layer. Default None: the
      mean of the start, and a common level that is left to the data.

    **Raises:** ValueError for a `scale`, `spacing` or `strength` that is not positive.

    **Source:** Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, sections 2.7, 4.2 and
    5.4; evidence: MacKay (1992), Neural Comput. 4, 415.

    **Example:** ten layers of 2 m, alike over 4 m.

    >>> import inversion, numpy as np
    >>> prior = inversion.Smooth(scale=4.0, spacing=2.0)
    >>> where, start = "canopy.voxels.leaf", np.full((1, 1, 10), 0.1)
    >>> unknown = inversion.Unknown(where, bounds=(0.0, 2.0), prior=prior, start=start)
    >>> print(np.round(prior.correlation(3)[0], 2))
    [1.   0.78 0.48]
    """

    scale: Float[Array, ""] = eqx.field(converter=as_scalar)
    spacing: Float[Array, ""] = eqx.field(converter=as_scalar, default=1.0, kw_only=True)
    strength: Float[Array, ""] | None = eqx.field(
        converter=lambda x: None if x is None else as_scalar(x, "strength"), default=None, kw_only=True
    )
    mean: Float[Array, "..."] | None = eqx.field(
        converter=lambda x: None if x is None else as_array(x, "mean"), default=None, kw_only=True
    )

    def __check_init__(self):
        check_range("scale", self.scale, 0.0, low_open=True)
        check_range("spacing", self.spacing, 0.0, low_open=True)
        if self.strength is not None:
            check_range("strength", self.strength, 0.0, low_open=True)
        if self.mean is not None:
            check_range("mean", self.mean)

    def correlation(self, layers: int) -> Float[np.ndarray, "layers layers"]:
        """Correlation between layers, before the common level.

        **Arguments:** `layers`: how many.

        **Returns:** (layers, layers).
        """
        place = np.arange(layers) * float(self.spacing) / float(self.scale)
        apart = np.sqrt(3.0) * np.abs(np.subtract.outer(place, place))
        return (1.0 + apart) * np.exp(-apart)


class _Block:
    """A smoothness prior of one unknown. `place`: that of its values among all."""

    def __init__(self, settled: "Settled", place: slice):
        assert settled.smooth is not None
        smooth, self.place, size = settled.smooth, place, settled.low.size
        level = float(np.mean(settled.start)) if smooth.mean is None else np.asarray(smooth.mean, float)
        self.mean = np.broadcast_to(level, settled.low.shape).ravel()
        self.open = smooth.strength is None
        width = float(np.max(settled.high - settled.low))
        self.range = (_STRENGTHS[0] * width, _STRENGTHS[1] * width)
        shape = smooth.correlation(size) + _NUGGET * np.eye(size)
        # Of a strength of one.
        self.factor = np.linalg.cholesky(shape + (_LEVEL**2 if smooth.mean is None else 0.0))
        self.whiten = linalg.solve_triangular(self.factor, np.eye(size), lower=True)
        self.volume = 2.0 * float(np.sum(np.log(np.diag(self.factor))))
        self.strength = _BEGIN * width if smooth.strength is None else float(smooth.strength)


class Priors:
    """Residuals that the priors of all unknowns add to a fit; it keeps the strengths of smoothness priors."""

    def __init__(self, settled: "Sequence[Settled]"):
        def flat(pick: "Callable[[Settled], np.ndarray]") -> np.ndarray:
            return np.concatenate([np.ravel(pick(s)) for s in settled])

        self.mean = flat(lambda s: np.zeros_like(s.low) if s.prior is None else s.prior[0])
        self.weight = flat(lambda s: np.zeros_like(s.low) if s.prior is None else 1.0 / s.prior[1])
        self.log = flat(lambda s: np.full(s.low.shape, s.log_prior))
        self.width = flat(lambda s: s.high - s.low)
        ends = np.cumsum([0, *(s.low.size for s in settled)])
        places = [slice(a, b) for a, b in itertools.pairwise(ends)]
        self.blocks = [_Block(s, p) for s, p in zip(settled, places) if s.smooth is not None]
        self.smooth = flat(lambda s: np.full(s.low.shape, s.smooth is not None))

    def __call__(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals, as many as values, and their derivatives (residuals, values)."""
        positive = np.where(self.log, np.maximum(values, 1e-300), 1.0)
        shown = np.where(self.log, np.log(positive), values)
        off, slope = (shown - self.mean) * self.weight, np.diag(self.weight / positive)
        for block in self.blocks:
            slope[block.place, block.place] = block.whiten / block.strength
            off[block.place] = slope[block.place, block.place] @ (values[block.place] - block.mean)
        return off, slope

    @property
    def basis(self) -> np.ndarray:
        """Columns: changes of the values that smoothness priors take as independent and of one unit."""
        basis = np.eye(self.mean.size)
        for block in self.blocks:
            basis[block.place, block.place] = block.factor * block.strength
        return basis

    @property
    def volume(self) -> float:
        """-2 ln of the smoothness priors' densities at no cost: it tells apart fits of other strengths."""
        return float(sum(b.volume + 2.0 * b.mean.size * np.log(b.strength) for b in self.blocks))

    @property
    def strengths(self) -> np.ndarray:
        """Those of the smoothness priors, in the order of the unknowns."""
        return np.array([b.strength for b in self.blocks])

    @property
    def by_the_data(self) -> bool:
        """Whether a strength is left to the data."""
        return any(b.open for b in self.blocks)

    def put(self, strengths: np.ndarray) -> None:
        """Take other strengths."""
        for block, strength in zip(self.blocks, strengths):
            block.strength = float(strength)

    def likeliest(self, values: np.ndarray, residual: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """Strengths of the largest evidence, where they are left to the data; the others as they are.

        With the simulation linear about `values`, and H = J^T J + P,

            -2 ln evidence = smallest cost + ln det H - ln det P + constant.

        **Arguments:** `residual`, `jacobian`: of the data, whitened, in natural units.

        **Returns:** the strengths, each within a factor of three of what it is: the model is linear nearby.
        """
        off, slope = self(values)
        plain = ~self.smooth
        # In widths of the bounds, within which all unknowns are known to lie.
        jacobian, slope = jacobian * self.width, slope * np.outer(plain, plain) * self.width
        data = jacobian.T @ jacobian + slope.T @ slope + np.diag(plain.astype(float))
        pull = jacobian.T @ residual + slope.T @ np.where(plain, off, 0.0)
        strengths = self.strengths
        for i, block in enumerate(self.blocks):
            if not block.open:
                continue

            def deviance(log: float, i: int = i) -> float:
                tried = np.where(np.arange(strengths.size) == i, np.exp(log), strengths)
                return self._deviance(values, data, pull, tried)

            near = np.log(np.clip(block.strength * np.array([1.0 / _LEAP, _LEAP]), *block.range))
            found: Any = optimize.minimize_scalar(deviance, bounds=near, method="bounded")
            strengths[i] = np.exp(found.x)
        return strengths

    def _deviance(
        self, values: np.ndarray, data: np.ndarray, pull: np.ndarray, strengths: np.ndarray
    ) -> float:
        """-2 ln evidence, but for a constant."""
        information, pull, total = data.copy(), pull.copy(), 0.0
        for block, strength in zip(self.blocks, strengths):
            place, slope = block.place, block.whiten / strength
            off, slope = slope @ (values[place] - block.mean), slope * self.width[place]
            information[place, place] += slope.T @ slope
            pull[place] += slope.T @ off
            total += off @ off + 2.0 * block.mean.size * np.log(strength)
        root = np.linalg.cholesky(information)
        gain = linalg.solve_triangular(root, pull, lower=True)
        return float(total - gain @ gain + 2.0 * np.sum(np.log(np.diag(root))))


def known_priors(settled: "Sequence[Settled]") -> Priors:
    """The priors, where no fit chooses strengths. **Raises:** ValueError where one is left to the data."""
    for s in settled:
        if s.smooth is not None and s.smooth.strength is None:
            raise ValueError(
                f"unknown {s.name!r}: strength = None leaves the Smooth prior's strength to a fit; "
                "admissible here is a number"
            )
    return Priors(settled)
