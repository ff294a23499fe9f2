r"""Waveform processing without a model of the scene: echoes, heights, gap probability.

All functions take single waveforms, (bins,), and can be batched with `jax.vmap`. `relative_heights`,
`gap_probability` and `plant_area_index` are differentiable in the waveform. `gaussian_decomposition` and
`find_ground` make discrete choices (the number of echoes, the lowest mode); their derivatives are those for
the choice made.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar.extend import as_array, check_integer, check_range

_SOLVER = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
_STEPS = 60
# Least and largest width of an echo, in widths of the pulse.
_NARROWEST, _WIDEST = 0.5, 8.0

Samples = Float[Array, " bins"]


class Echoes(NamedTuple):
    """Gaussian echoes of a waveform, in order of time; entries beyond `count` are zero.

    - `amplitude`: (echoes,) height of the peak, in units of the waveform.
    - `time`: (echoes,) time of the peak in ns.
    - `width`: (echoes,) standard deviation in ns.
    - `stderr`: (echoes, 3) one standard error of each of the three above.
    - `count`: number of echoes.
    - `model`: (bins,) the sum of the echoes.
    - `chi2`: sum of squared residuals over `noise`.
    - `criterion`: Bayesian information criterion, chi2 + 3 count ln(bins).

    **Example:**

    >>> import inversion, numpy as np
    >>> time = np.arange(0.0, 60.0)
    >>> power = np.exp(-0.5 * ((time - 20.0) / 3.0) ** 2)
    >>> echoes = inversion.gaussian_decomposition(time, power, noise=0.01, width=3.0)
    >>> print(f"{int(echoes.count)}: {float(echoes.time[0]):.1f} ns, width {float(echoes.width[0]):.1f} ns")
    1: 20.0 ns, width 3.0 ns
    """

    amplitude: Float[Array, " echoes"]
    time: Float[Array, " echoes"]
    width: Float[Array, " echoes"]
    stderr: Float[Array, "echoes 3"]
    count: Int[Array, ""]
    model: Samples
    chi2: Float[Array, ""]
    criterion: Float[Array, ""]


def gaussian_decomposition(
    time: Float[ArrayLike, " bins"],
    power: Float[ArrayLike, " bins"],
    *,
    noise: Float[ArrayLike, ""] | Float[ArrayLike, " bins"],
    width: Float[ArrayLike, ""],
    max_echoes: int = 6,
) -> Echoes:
    """Gaussian decomposition of a waveform, with the number of echoes by the Bayesian information criterion.

    Echoes are added one at a time where the residual, smoothed by the pulse, is largest, and all are fitted
    again by Levenberg-Marquardt. Of the fits with 0 to `max_echoes` echoes, the one with the lowest criterion
    is returned. No echo is negative. Equal numbers of bins and echoes compile once.

    **Arguments:**

    - `time`: (bins,) ns, increasing in equal steps.
    - `power`: (bins,) waveform in any unit, background removed.
    - `noise`: standard deviation of `power`, above 0, one number or (bins,).
    - `width`: standard deviation of the pulse in ns, above 0. Widths of echoes start from it and end between
      half of it and eight times it.
    - `max_echoes`: most echoes, at least 1. Default 6.

    **Returns:** an `Echoes`, with `max_echoes` entries.

    **Raises:** ValueError for inadmissible arguments.

    **Source:** Wagner et al. (2006), ISPRS J. Photogramm. 60, 100; Schwarz (1978), Ann. Stat. 6, 461.

    **Example:**

    >>> import inversion, numpy as np
    >>> time = np.arange(0.0, 60.0)
    >>> power = sum(a * np.exp(-0.5 * ((time - t) / 3.0) ** 2) for a, t in ((1.0, 20.0), (0.5, 40.0)))
    >>> echoes = inversion.gaussian_decomposition(time, power, noise=0.01, width=3.0)
    >>> [f"{float(t):.1f}" for t in echoes.time[: echoes.count]]
    ['20.0', '40.0']
    """
    t, y, sigma = as_array(time), as_array(power), as_array(noise)
    most = check_integer("max_echoes", max_echoes)
    if t.shape != y.shape or t.ndim != 1 or t.size < 2:
        raise ValueError(
            f"time and power have the shapes {t.shape} and {y.shape}; admissible is (bins,) for both, two or "
            "more"
        )
    if sigma.shape not in ((), y.shape):
        raise ValueError(f"noise has the shape {sigma.shape}; admissible is () or {y.shape}")
    check_range("noise", noise, 0.0, low_open=True)
    check_range("width", width, 0.0, low_open=True)
    check_range("power", power)
    check_range("steps of time", jnp.diff(t), 0.0, low_open=True)
    return _decompose(t, y, jnp.broadcast_to(sigma, y.shape), as_array(width), most)


@partial(jax.jit, static_argnames="most")
def _decompose(t: Samples, y: Samples, sigma: Samples, width: Array, most: int) -> Echoes:
    step = t[1] - t[0]
    kernel = jnp.exp(-0.5 * ((t - 0.5 * (t[0] + t[-1])) / width) ** 2)
    log_n = jnp.log(jnp.asarray(y.size, y.dtype))
    scale = jnp.maximum(jnp.max(jnp.abs(y)), jnp.finfo(y.dtype).tiny)

    def unpack(p: Float[Array, "echoes 3"]) -> tuple[Array, Array, Array]:
        """Amplitude, time and width out of free parameters of order one."""
        low, high = jnp.log(_NARROWEST), jnp.log(_WIDEST)
        wide = jnp.exp(low + (high - low) * jax.nn.sigmoid(p[:, 2])) * width
        return scale * p[:, 0], t[0] + width * p[:, 1], wide

    def model(p: Float[Array, "echoes 3"], on: Bool[Array, " echoes"]) -> Samples:
        a, centre, wide = unpack(p)
        away = (t[None, :] - centre[:, None]) / wide[:, None]
        return jnp.sum(jnp.where(on[:, None], a[:, None] * jnp.exp(-0.5 * away * away), 0.0), axis=0)

    def residual(p: Float[Array, "echoes 3"], on: Bool[Array, " echoes"]) -> Samples:
        return (model(p, on) - y) / sigma

    # The free parameter of the pulse's own width.
    share = -jnp.log(_NARROWEST) / (jnp.log(_WIDEST) - jnp.log(_NARROWEST))
    own = jnp.log(share) - jnp.log1p(-share)

    def add(carry, k):
        p, on = carry
        left = (y - model(p, on)) / sigma**2
        matched = jnp.convolve(left, kernel, mode="same")
        norm = jnp.convolve(1.0 / sigma**2, kernel**2, mode="same")
        best = jnp.argmax(matched / jnp.sqrt(norm))
        amplitude = matched[best] / norm[best]
        place = t[best] - _half_step(t, step)
        p = p.at[k].set(jnp.stack([amplitude / scale, (place - t[0]) / width, own]))
        on = on.at[k].set(True)
        fitted = optx.least_squares(residual, _SOLVER, p, args=on, max_steps=_STEPS, throw=False).value
        good = jnp.all(jnp.isfinite(fitted))
        p = jnp.where(good, fitted, p)
        chi2 = jnp.sum(residual(p, on) ** 2)
        # Echoes are returns: none may be negative.
        positive = jnp.all(jnp.where(on, p[:, 0] > 0, True))
        criterion = jnp.where(positive, chi2 + 3 * (k + 1) * log_n, jnp.inf)
        return (p, on), (p, on, chi2, criterion)

    nothing = (jnp.zeros((most, 3), y.dtype), jnp.zeros(most, bool))
    _, (p, on, chi2, criterion) = lax.scan(add, nothing, jnp.arange(most))
    none = jnp.sum((y / sigma) ** 2)
    p, on = (jnp.concatenate([a[None], b]) for a, b in zip(nothing, (p, on)))
    chi2, criterion = (jnp.concatenate([none[None], c]) for c in (chi2, criterion))
    best = jnp.argmin(criterion)
    p, on = p[best], on[best]
    order = jnp.argsort(jnp.where(on, p[:, 1], jnp.inf))
    p, on = p[order], on[order]
    jacobian = jax.jacfwd(residual)(p, on).reshape(y.size, -1)
    # Inactive echoes have no column; one on their diagonal keeps the inverse.
    idle = jnp.where(jnp.repeat(on, 3), 0.0, 1.0)
    variance = jnp.diagonal(jnp.linalg.pinv(jacobian.T @ jacobian + jnp.diag(idle)))
    a, centre, wide = unpack(p)
    slope = jax.vmap(jax.grad(lambda q: unpack(q[None])[2][0]))(p)[:, 2]
    natural = jnp.stack([jnp.full_like(a, scale), jnp.full_like(a, width), slope], axis=1)
    stderr = jnp.sqrt(jnp.maximum(variance, 0.0)).reshape(-1, 3) * natural
    return Echoes(
        amplitude=jnp.where(on, a, 0.0),
        time=jnp.where(on, centre, 0.0),
        width=jnp.where(on, wide, 0.0),
        stderr=jnp.where(on[:, None], stderr, 0.0),
        count=jnp.sum(on),
        model=model(p, on),
        chi2=chi2[best],
        criterion=criterion[best],
    )


def _half_step(t: Samples, step: Array) -> Array:
    """How far the centre of a kernel of an even number of samples lies from a sample."""
    return jnp.where(t.size % 2 == 0, 0.5 * step, 0.0)


def relative_heights(
    height: Float[ArrayLike, " bins"],
    power: Float[ArrayLike, " bins"],
    *,
    ground: Float[ArrayLike, ""] = 0.0,
    levels: Float[ArrayLike, " levels"] | Sequence[float] = (25.0, 50.0, 75.0, 95.0, 98.0, 100.0),
) -> Float[Array, " levels"]:
    """Relative heights (RH metrics): heights above ground below which given percentages of the energy return.

    **Arguments:**

    - `height`: (bins,) m, decreasing with time, as `Waveform.height`.
    - `power`: (bins,) waveform, background removed. Negative samples count as zero.
    - `ground`: height of the ground in m. Default 0.
    - `levels`: (levels,) percentages, 0 to 100. Default (25, 50, 75, 95, 98, 100).

    **Returns:** (levels,) heights in m.

    **Raises:** ValueError for `levels` outside 0 to 100.

    **Source:** Dubayah et al. (2020), Sci. Remote Sens. 1, 100002.

    **Example:**

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.5)
    >>> power = np.where((height >= 1.0) & (height <= 15.0), 1.0, 0.0)
    >>> rh50, rh75 = inversion.relative_heights(height, power, ground=1.0, levels=(50.0, 75.0))
    >>> print(f"{float(rh50):.1f} m, {float(rh75):.1f} m")
    7.0 m, 10.6 m
    """
    check_range("levels", levels, 0.0, 100.0)
    z, y = as_array(height)[::-1], jnp.maximum(as_array(power), 0.0)[::-1]
    below = jnp.cumsum(y)
    # Energy up to the middle of each sample.
    share = (below - 0.5 * y) / jnp.maximum(below[-1], jnp.finfo(y.dtype).tiny)
    return jnp.interp(as_array(levels) / 100.0, share, z) - as_array(ground)


def find_ground(
    height: Float[ArrayLike, " bins"],
    power: Float[ArrayLike, " bins"],
    *,
    threshold: float,
) -> Float[Array, ""]:
    """Height of the ground, taken as the lowest mode: the last local maximum above `threshold`.

    Between samples, it is the vertex of the parabola through the maximum and its two neighbours. Smooth noisy
    waveforms first.

    **Arguments:**

    - `height`: (bins,) m, decreasing with time, as `Waveform.height`.
    - `power`: (bins,) waveform.
    - `threshold`: in units of `power`.

    **Returns:** the height in m; NaN where there is no such maximum.

    **Raises:** ValueError for a `threshold` that is not finite.

    **Example:**

    >>> import inversion, numpy as np
    >>> height = np.arange(20.0, -5.0, -0.25)
    >>> power = 0.5 * np.exp(-0.5 * ((height - 12.0) / 2.0) ** 2) + np.exp(-0.5 * ((height - 1.6) / 0.5) ** 2)
    >>> print(f"{float(inversion.find_ground(height, power, threshold=0.1)):.1f} m")
    1.6 m
    """
    check_range("threshold", threshold)
    z, y = as_array(height), as_array(power)
    peak = (y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:]) & (y[1:-1] > threshold)
    last = y.size - 2 - jnp.argmax(peak[::-1])
    before, top, after = y[last - 1], y[last], y[last + 1]
    bend = 2.0 * top - before - after
    shift = 0.5 * (after - before) / jnp.where(bend > 0, bend, 1.0)
    found = z[last] + shift * 0.5 * (z[last + 1] - z[last - 1])
    return jnp.where(jnp.any(peak), found, jnp.nan)


def gap_probability(
    canopy: Float[ArrayLike, " bins"], ground: Float[ArrayLike, ""], *, reflectance_ratio: float = 1.5
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
