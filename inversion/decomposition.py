r"""What waveforms are compared by, without a model of the scene: echoes, deconvolution, heights, gaps.

Everything takes single waveforms, (bins,), and can be batched with `jax.vmap`. Functions of a waveform's
numbers alone are differentiable in them: `relative_heights`, `gap_probability`, `plant_area_index`,
`richardson_lucy`, `wiener`. What counts or chooses (`gaussian_decomposition`, `find_ground`) has derivatives
of what it chose.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar.extend import as_array, check_range

_SOLVER = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
_STEPS = 60
# An echo is no narrower than this share of the pulse, and no wider than so many of it.
_NARROWEST, _WIDEST = 0.5, 8.0

Samples = Float[Array, " bins"]


class Echoes(NamedTuple):
    """Gaussian echoes of a waveform, in the order of time; those beyond `count` are zero.

    - `amplitude`, `time`, `width`: (echoes,) height of the peak, its place in ns, standard deviation in ns.
    - `stderr`: (echoes, 3) one standard error of each of the three.
    - `count`: how many echoes there are.
    - `model`: (bins,) their sum. - `chi2`: sum of squared residuals over `noise`. - `criterion`: Bayesian
      information criterion, chi2 + 3 count ln(bins).
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
    """A waveform as a sum of Gaussians, as many as the Bayesian information criterion asks for.

    Echoes are added one at a time where the residual, smoothed by the pulse, is largest, and all are fitted
    again by Levenberg-Marquardt; of the sums of 0 .. `max_echoes` the one of the least criterion is kept.

    **Arguments:**

    - `time`: (bins,) ns, increasing in equal steps. - `power`: (bins,) background removed.
    - `noise`: standard deviation, of all samples or of each.
    - `width`: standard deviation of the pulse in ns, from which echoes start; they end between half of it
      and eight times it.
    - `max_echoes`: at least 1. Default 6.

    **Raises:** ValueError for inadmissible arguments.

    **Source:** Wagner et al. (2006), ISPRS J. Photogramm. 60, 100; Schwarz (1978), Ann. Stat. 6, 461.
    """
    t, y = as_array(time), as_array(power)
    sigma = jnp.broadcast_to(as_array(noise), y.shape)
    check_range("noise", noise, 0.0, low_open=True)
    check_range("width", width, 0.0, low_open=True)
    check_range("power", power)
    check_range("steps of time", jnp.diff(t), 0.0, low_open=True)
    if max_echoes != int(max_echoes) or max_echoes < 1:
        raise ValueError(f"max_echoes = {max_echoes} is outside the admissible range [1, inf) of integers")
    if t.shape != y.shape:
        raise ValueError(f"time and power have the shapes {t.shape} and {y.shape}; they must agree")
    return _decompose(t, y, sigma, as_array(width), int(max_echoes))


def _decompose(t: Samples, y: Samples, sigma: Samples, width: Array, most: int) -> Echoes:
    step = t[1] - t[0]
    kernel = jnp.exp(-0.5 * ((t - 0.5 * (t[0] + t[-1])) / width) ** 2)
    log_n = jnp.log(jnp.asarray(y.size, y.dtype))
    scale = jnp.maximum(jnp.max(jnp.abs(y)), jnp.finfo(y.dtype).tiny)

    def unpack(p: Float[Array, "echoes 3"]) -> tuple[Array, Array, Array]:
        """Amplitude, place and width of free numbers of order one."""
        low, high = jnp.log(_NARROWEST), jnp.log(_WIDEST)
        wide = jnp.exp(low + (high - low) * jax.nn.sigmoid(p[:, 2])) * width
        return scale * p[:, 0], t[0] + width * p[:, 1], wide

    def model(p: Float[Array, "echoes 3"], on: Bool[Array, " echoes"]) -> Samples:
        a, centre, wide = unpack(p)
        away = (t[None, :] - centre[:, None]) / wide[:, None]
        return jnp.sum(jnp.where(on[:, None], a[:, None] * jnp.exp(-0.5 * away * away), 0.0), axis=0)

    def residual(p: Float[Array, "echoes 3"], on: Bool[Array, " echoes"]) -> Samples:
        return (model(p, on) - y) / sigma

    # The free number of the pulse's own width.
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


def richardson_lucy(
    power: Float[ArrayLike, " bins"], pulse: Float[ArrayLike, " lags"], *, iterations: int = 50
) -> Samples:
    """Deconvolution of a waveform from its pulse that keeps its energy and stays positive.

    - `power`: (bins,). Negative samples, which noise makes, count as zero.
    - `pulse`: (lags,) an odd number of samples, time zero in the middle, not negative.
    - `iterations`: 1 or more; more of them resolve more, and amplify noise. Default 50.

    **Source:** Richardson (1972), J. Opt. Soc. Am. 62, 55; Lucy (1974), Astron. J. 79, 745.
    """
    y, h = jnp.maximum(as_array(power), 0.0), _kernel(pulse)
    if iterations != int(iterations) or iterations < 1:
        raise ValueError(f"iterations = {iterations} is outside the admissible range [1, inf) of integers")
    check_range("pulse", pulse, 0.0)
    tiny = 1e-6 * jnp.maximum(jnp.max(y), 1e-30)
    # What of each place is recorded at all: less at the ends.
    seen = jnp.convolve(jnp.ones_like(y), h[::-1], mode="same")

    def better(x: Samples, _: None) -> tuple[Samples, None]:
        ratio = y / jnp.maximum(jnp.convolve(x, h, mode="same"), tiny)
        return x * jnp.convolve(ratio, h[::-1], mode="same") / seen, None

    return lax.scan(better, jnp.full_like(y, jnp.mean(y)), None, length=int(iterations))[0]


def wiener(
    power: Float[ArrayLike, " bins"], pulse: Float[ArrayLike, " lags"], *, noise_to_signal: float
) -> Samples:
    """Deconvolution by Wiener's filter.

    - `power`: (bins,). - `pulse`: (lags,) as for `richardson_lucy`, but of any sign.
    - `noise_to_signal`: power of the noise over that of the signal, above 0; constant in frequency.

    **Source:** Wiener (1949), Extrapolation, Interpolation, and Smoothing of Stationary Time Series.
    """
    check_range("noise_to_signal", noise_to_signal, 0.0, low_open=True)
    y, h = as_array(power), _kernel(pulse)
    n = y.size + h.size - 1
    spectrum = jnp.fft.rfft(h, n)
    gain = jnp.conj(spectrum) / (jnp.abs(spectrum) ** 2 + noise_to_signal)
    # The pulse begins half of its length before its time zero.
    begun = jnp.pad(y, ((h.size - 1) // 2, (h.size - 1) // 2))
    return jnp.fft.irfft(jnp.fft.rfft(begun) * gain, n)[: y.size]


def _kernel(pulse: Float[ArrayLike, " lags"]) -> Float[Array, " lags"]:
    h = as_array(pulse)
    check_range("pulse", pulse)
    if h.ndim != 1 or h.size % 2 == 0:
        raise ValueError(f"pulse has the shape {h.shape}; admissible is (lags,) with an odd number of lags")
    return h / jnp.sum(h)


def relative_heights(
    height: Float[ArrayLike, " bins"],
    power: Float[ArrayLike, " bins"],
    *,
    ground: Float[ArrayLike, ""] = 0.0,
    levels: Float[ArrayLike, " levels"] | Sequence[float] = (25.0, 50.0, 75.0, 95.0, 98.0, 100.0),
) -> Float[Array, " levels"]:
    """RH metrics: heights above `ground` below which the given percentages of the energy return.

    - `height`: (bins,) m, decreasing with time, as `Waveform.height`. - `power`: (bins,) background removed;
      negative samples count as zero. - `ground`: its height in m. - `levels`: per cent, 0..100.

    **Source:** Dubayah et al. (2020), Sci. Remote Sens. 1, 100002.
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
    """Height of the lowest mode: the last local maximum above `threshold`, NaN where there is none.

    Between samples, it is the vertex of the parabola through the three largest. Smooth noisy waveforms
    before.

    - `height`: (bins,) m, decreasing with time. - `power`: (bins,). - `threshold`: in units of power.
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
    """Probability of a gap from above the canopy down to each sample, in the direction of the beam.

    P(z) = 1 - Rv(z) / (Rv + Rg rho_v / rho_g), with Rv(z) the energy that the canopy returned from above z.

    - `canopy`: (bins,) the canopy's return, from the top down. - `ground`: energy of the ground's return.
    - `reflectance_ratio`: rho_v / rho_g of apparent reflectances. Default 1.5, GEDI's.

    **Source:** Ni-Meister et al. (2001), IEEE Trans. Geosci. Remote Sens. 39, 1943; Tang and Armston (2019),
    GEDI footprint canopy cover and vertical profile metrics (theoretical basis document).
    """
    check_range("reflectance_ratio", reflectance_ratio, 0.0, low_open=True)
    above = jnp.cumsum(as_array(canopy))
    total = above[-1] + as_array(ground) * reflectance_ratio
    return 1.0 - above / jnp.where(total > 0, total, 1.0)


def plant_area_index(
    gap: Float[ArrayLike, "*s"], *, zenith: float = 0.0, projection: float = 0.5, clumping: float = 1.0
) -> Float[Array, "*s"]:
    """Plant area index above each level from the gap probability there: -ln(P) cos(zenith) / (G Omega).

    - `gap`: above 0, at most 1. - `zenith`: of the beam in degrees. - `projection`: G. - `clumping`: Omega.
    """
    check_range("gap", gap, 0.0, 1.0, low_open=True)
    check_range("zenith", zenith, 0.0, 90.0, high_open=True)
    check_range("projection", projection, 0.0, 1.0, low_open=True)
    check_range("clumping", clumping, 0.0, low_open=True)
    return -jnp.log(as_array(gap)) * jnp.cos(jnp.deg2rad(zenith)) / (projection * clumping)
