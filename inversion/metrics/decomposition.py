r"""Decomposition of records into echoes: Gaussians, or copies of a recorded pulse.

Echoes are added one at a time where the residual, filtered by the pulse, is largest, and all are fitted again
by Levenberg-Marquardt. The number of echoes is that with the lowest chi^2 + penalty, where an echo of m
parameters costs (Gaussians, m = 3)

    m ln(bins),        copies of a pulse, m = 2 or 3:   (m + 1) ln(bins),

the Bayesian information criterion, and for copies one more, as the place of an echo is searched for among all
bins.

Copies of a pulse are shifted, and broadened by Gaussians, in the Fourier domain, which is exact for a pulse
that its sampling resolves. A recorded pulse has errors of its own. They are counted as noise of `pulse_error`
times the amplitude that the energy within a pulse's length would have as one echo; so the rest that an
imperfect pulse leaves of a strong echo is not taken for weak ones.

Free parameters are smooth bijections of what they stand for, so that no echo leaves the record: its place
lies between the first and the last sample that count, and its height, broadened, between zero and the highest
that the record supports, one standard deviation above a sample. Noise in proportion to the signal has next
to no weight where the signal is strong: without the bounds, echoes grow there beyond any sample.

Derivatives are those for the number of echoes found.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from inversion.metrics.pulses import Pulse, pulse_samples, steps_of
from inversion.metrics.records import ladder, over_shots, pad
from jaxlidar.extend import as_array, check_integer, check_range

_SOLVER = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
_STEPS = 40
# Echoes are added until so many in a row have not lowered the criterion.
_PATIENCE = 2
# Least and largest width of a Gaussian echo, and of what broadens a copy, in widths of the pulse.
_WIDTHS = {"gaussian": (0.5, 8.0), "copies": (0.5, 8.0), "broadened": (0.1, 8.0)}
# ... from which their fits start, and how much an echo costs, in ln(bins).
_START = {"gaussian": 1.0, "copies": 1.0, "broadened": 0.4}
_COST = {"gaussian": 3, "copies": 3, "broadened": 4}
# An echo is at most so many standard deviations above the record; fits start at this share from bounds.
_ABOVE, _MARGIN = 1.0, 0.01
# Noise below this share of the largest sample counts as much: so finely models are computed.
_ROUNDING = 1e-4

Free = Float[Array, "echoes 3"]
On = Bool[Array, " echoes"]


class Echoes(NamedTuple):
    """Echoes of a record, in order of time; entries beyond `count` are zero. Several records have a dimension
    before.

    - `amplitude`: (echoes,) height of the peak, in units of the record; of a copy, before it is broadened.
    - `time`: (echoes,) time of the peak in ns; of a copy, of the pulse's time zero.
    - `width`: (echoes,) standard deviation in ns; of a copy, that of the Gaussian that broadens it, or 0.
    - `stderr`: (echoes, 3) one standard error of each of the three above.
    - `count`: number of echoes.
    - `model`: (bins,) the sum of the echoes.
    - `chi2`: sum of squared residuals over the noise.
    - `criterion`: `chi2` and the cost of all echoes.

    **Example:**

    >>> import inversion, numpy as np
    >>> time = np.arange(0.0, 60.0)
    >>> power = np.exp(-0.5 * ((time - 20.0) / 3.0) ** 2)
    >>> echoes = inversion.gaussian_decomposition(time, power, noise=0.01, width=3.0)
    >>> print(f"{int(echoes.count)}: {float(echoes.time[0]):.1f} ns, width {float(echoes.width[0]):.1f} ns")
    1: 20.0 ns, width 3.0 ns
    """

    amplitude: Float[Array, "... echoes"]
    time: Float[Array, "... echoes"]
    width: Float[Array, "... echoes"]
    stderr: Float[Array, "... echoes 3"]
    count: Int[Array, "..."]
    model: Float[Array, "... bins"]
    chi2: Float[Array, "..."]
    criterion: Float[Array, "..."]


def gaussian_decomposition(
    time: Float[ArrayLike, " bins"],
    power: Float[ArrayLike, "... bins"],
    *,
    noise: Float[ArrayLike, "..."],
    width: Float[ArrayLike, ""] | None = None,
    pulse: Pulse | None = None,
    broaden: bool = True,
    pulse_error: float = 0.01,
    max_echoes: int = 6,
) -> Echoes:
    """Echoes of a record, Gaussians or copies of a recorded pulse, their number by a penalised criterion.

    System pulses are no Gaussians: where the pulse was recorded, give it, or a hard target will have two
    echoes or more. Records are padded to a ladder of sizes (64, 96, 128, 192, ... bins); each is compiled
    once, for each number of records. No echo is negative, none lies outside the record, and none is higher
    than the record by one standard deviation of its noise. Where a record begins or ends within an echo,
    what is seen of it is an echo at that end.

    **Arguments:**

    - `time`: (bins,) ns, increasing in equal steps.
    - `power`: (bins,) record in any unit, background removed; or (shots, bins).
    - `noise`: standard deviation of `power`, above 0: one number, or of the shape of `power`. Where it is
      infinite, samples do not count. Below 1e-4 of the largest sample it counts as that.
    - `width`: for Gaussian echoes: standard deviation of the pulse in ns, above 0. Widths of echoes start
      from it and end between half of it and eight times it.
    - `pulse`: for copies: a recorded pulse, or the system's impulse, at the record's sampling, (lags,), an
      odd number of samples with time zero in the middle, or (shots, lags); or a `jaxlidar` pulse.
    - `broaden`: whether copies may be broadened by Gaussians, where that lowers the criterion. Default True.
    - `pulse_error`: standard deviation of the errors of `pulse` over its peak, 0 or more. Default 0.01.
    - `max_echoes`: most echoes, at least 1. Default 6.

    **Returns:** an `Echoes`, with `max_echoes` entries.

    **Raises:** ValueError for inadmissible arguments, and unless either `width` or `pulse` is given.

    **Source:** Wagner et al. (2006), ISPRS J. Photogramm. 60, 100; Schwarz (1978), Ann. Stat. 6, 461; Zhang
    and Siegmund (2007), Biometrics 63, 22 (places found by search).

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
    if t.ndim != 1 or y.ndim < 1 or t.shape != y.shape[-1:] or t.size < 2:
        raise ValueError(
            f"time and power have the shapes {t.shape} and {y.shape}; admissible is (bins,) and (..., bins), "
            "two or more"
        )
    if sigma.shape not in ((), t.shape, y.shape):
        raise ValueError(f"noise has the shape {sigma.shape}; admissible is () or {y.shape}")
    if (width is None) == (pulse is None):
        raise ValueError("width and pulse: admissible is one of them")
    check_range("noise", jnp.where(jnp.isposinf(sigma), 1.0, sigma), 0.0, low_open=True)
    check_range("power", power)
    check_range("steps of time", jnp.diff(t), 0.0, low_open=True)
    check_range("pulse_error", pulse_error, 0.0)
    size = ladder(t.size)
    weight = jnp.broadcast_to(1.0 / sigma, y.shape)
    arrays = pad(y, size), pad(weight, size), t[1] - t[0]
    if pulse is None:
        assert width is not None
        check_range("width", width, 0.0, low_open=True)
        found = _program("gaussian", most)(*arrays, jnp.ones(1), as_array(width), jnp.zeros(()))
    else:
        lags, error = pulse_samples(pulse, steps_of(time)), as_array(pulse_error)
        found = _program("copies", most)(*arrays, lags, jnp.ones(()), error)
        if broaden:
            other = _program("broadened", most)(*arrays, lags, jnp.ones(()), error)
            better = other.criterion < found.criterion
            found = jax.tree.map(partial(_choose, better), other, found)
    placed = jnp.where(found.amplitude > 0, t[0] + found.time, 0.0)
    return found._replace(time=placed, model=found.model[..., : t.size])


def _choose(where: Array, a: Array, b: Array) -> Array:
    return jnp.where(where.reshape(where.shape + (1,) * (a.ndim - where.ndim)), a, b)


@lru_cache
def _program(kind: str, most: int) -> Callable[..., Echoes]:
    """The compiled decomposition into one kind of echoes."""

    def decompose(*arguments: Array) -> Echoes:
        return _decompose(kind, most, *arguments)

    decompose.__name__ = "_decompose"
    return over_shots(1, 1, 0, 1, 0, 0, in_turn=True)(decompose)


class _Shapes(NamedTuple):
    """How echoes of a kind look: their sum, and amplitude and place of the best new one."""

    width: Array
    model: Callable[[Array, Array, Array], Array]
    seed: Callable[[Array, Array], tuple[Array, Array]]


class _State(NamedTuple):
    """A fit with some echoes."""

    p: Free
    on: On
    chi2: Array
    criterion: Array


def _gaussians(size: int, width: Array) -> _Shapes:
    place = jnp.arange(size, dtype=width.dtype)
    # Of an odd number of samples, so that its middle is one.
    kernel = jnp.exp(-0.5 * ((place[: size - 1] - (size // 2 - 1)) / width) ** 2)

    def model(a, centre, wide):
        away = (place[None, :] - centre[:, None]) / wide[:, None]
        return jnp.sum(a[:, None] * jnp.exp(-0.5 * away * away), axis=0)

    def seed(left, weight):
        matched = jnp.convolve(left * weight**2, kernel, mode="same")
        return matched, jnp.convolve(weight**2, kernel**2, mode="same")

    return _Shapes(width, model, seed)


def _copies(size: int, pulse: Array) -> _Shapes:
    padded = ladder(size + pulse.size)
    half = pulse.size // 2
    first = jnp.roll(jnp.pad(pulse, (0, padded - pulse.size)), -half)
    spectrum, square = jnp.fft.rfft(first), jnp.fft.rfft(first**2)
    omega = 2.0 * jnp.pi * jnp.fft.rfftfreq(padded).astype(pulse.dtype)

    def model(a, centre, wide):
        damping = -0.5 * (omega[None, :] * wide[:, None]) ** 2
        turns = jnp.exp(lax.complex(damping, -omega[None, :] * centre[:, None]))
        return jnp.fft.irfft(spectrum * jnp.sum(a[:, None] * turns, axis=0), padded)[:size]

    def correlate(samples, with_spectrum):
        return jnp.fft.irfft(jnp.fft.rfft(samples, padded) * jnp.conj(with_spectrum), padded)[:size]

    def seed(left, weight):
        return correlate(left * weight**2, spectrum), correlate(weight**2, square)

    return _Shapes(jnp.sum(pulse) / jnp.sqrt(2.0 * jnp.pi), model, seed)


def _with_pulse_error(y: Array, weight: Array, pulse: Array, error: Array) -> Array:
    """Weights of samples whose noise holds the pulse's errors too."""
    size = ladder(y.size + pulse.size)
    half, energy = pulse.size // 2, jnp.where(weight > 0, y * y, 0.0)
    near = jnp.fft.irfft(jnp.fft.rfft(energy, size) * jnp.fft.rfft(jnp.ones(pulse.size, y.dtype), size), size)
    amplitude2 = jnp.maximum(near[half : half + y.size], 0.0) / jnp.sum(pulse**2)
    return weight / jnp.sqrt(1.0 + (weight * error) ** 2 * amplitude2)


def _decompose(
    kind: str, most: int, y: Array, weight: Array, step: Array, pulse: Array, width: Array, error: Array
) -> Echoes:
    if kind == "gaussian":
        shapes = _gaussians(y.size, width / step)
    else:
        shapes, weight = _copies(y.size, pulse), _with_pulse_error(y, weight, pulse, error)
    used = weight > 0
    count, first, last = jnp.sum(used), jnp.argmax(used), y.size - 1 - jnp.argmax(used[::-1])
    log_n = jnp.log(jnp.maximum(count, 2).astype(y.dtype))
    y = jnp.where(used, y, 0.0)
    scale = jnp.maximum(jnp.max(jnp.abs(y)), jnp.finfo(y.dtype).tiny)
    weight = jnp.where(used, weight / jnp.sqrt(1.0 + (_ROUNDING * scale * weight) ** 2), 0.0)
    # A peak between two samples is higher than both.
    narrow = shapes.width * (_WIDTHS[kind][0] if kind == "gaussian" else 1.0)
    between = jnp.exp(0.125 / jnp.maximum(narrow, 0.5) ** 2)
    highest = between * jnp.max(jnp.where(used, y + _ABOVE / jnp.where(used, weight, 1.0), 0.0))
    highest = jnp.maximum(highest, jnp.finfo(y.dtype).tiny)
    low, high = (jnp.log(jnp.asarray(end, y.dtype)) for end in _WIDTHS[kind])
    own = _free((jnp.log(_START[kind]) - low) / (high - low))
    length = jnp.maximum(last - first, 1).astype(y.dtype)
    # In the middle of the record one unit is a width.
    stretch = 4.0 * shapes.width / length
    far = _free(jnp.ones(3, y.dtype))[None, :] * jnp.stack([0.5, 1.0 / stretch, 1.0])[None, :]

    def unpack(p: Free) -> tuple[Array, Array, Array]:
        """Amplitude, place and width, in samples, out of free parameters of order one."""
        wide = jnp.exp(low + (high - low) * jax.nn.sigmoid(p[:, 2])) * shapes.width
        height, centre = highest * jax.nn.sigmoid(p[:, 0]), first + length * jax.nn.sigmoid(stretch * p[:, 1])
        if kind == "broadened":
            height *= jnp.hypot(1.0, wide / shapes.width)
        return height, centre, jnp.zeros_like(wide) if kind == "copies" else wide

    def model(p: Free, on: On) -> Array:
        a, centre, wide = unpack(p)
        return shapes.model(jnp.where(on, a, 0.0), centre, wide)

    def residual(p: Free, on: On) -> Array:
        return (model(p, on) - y) * weight

    def errors(a: Array, centre: Array, wide: Array, on: On) -> Array:
        """(echoes, 3) standard errors of amplitude, place and width, in samples."""
        unit = jnp.stack([highest, shapes.width, shapes.width])

        def scaled(q: Free) -> Array:
            a, centre, wide = (q * unit[None, :]).T
            return shapes.model(jnp.where(on, a, 0.0), centre, wide) * weight

        return (
            _errors(scaled, jnp.stack([a, centre, wide], axis=1) / unit[None, :], on, kind == "copies")
            * unit[None, :]
        )

    none = jnp.sum((y * weight) ** 2)
    nothing = _State(jnp.zeros((most, 3), y.dtype), jnp.zeros(most, bool), none, none)

    def add(state: _State, k: Array) -> _State:
        p, on = state.p, state.on
        matched, norm = shapes.seed(y - model(p, on), weight)
        norm = jnp.maximum(norm, jnp.finfo(y.dtype).tiny)
        best = jnp.argmax(jnp.where(used, matched / jnp.sqrt(norm), -jnp.inf))
        begin = [_free(matched[best] / norm[best] / highest), _free((best - first) / length) / stretch, own]
        # Far out the bijections are flat: what an echo fewer had pushed there would stay.
        p = jnp.clip(p, -far, far).at[k].set(jnp.stack(begin))
        on = on.at[k].set(True)
        fitted = optx.least_squares(residual, _SOLVER, p, args=on, max_steps=_STEPS, throw=False).value
        p = jnp.where(jnp.all(jnp.isfinite(fitted)), fitted, p)
        chi2 = jnp.sum(residual(p, on) ** 2)
        return _State(p, on, chi2, chi2 + _COST[kind] * (k + 1) * log_n)

    def step_on(carry: tuple[_State, _State, Array], k: Array) -> tuple[tuple[_State, _State, Array], None]:
        last, best, failed = carry
        last = lax.cond(
            failed < _PATIENCE,
            add,
            lambda state, _: state._replace(criterion=jnp.full((), jnp.inf, y.dtype)),
            last,
            k,
        )
        better = last.criterion < best.criterion
        best = jax.tree.map(partial(_choose, better), last, best)
        return (last, best, jnp.where(better, 0, failed + 1)), None

    carry = (nothing, nothing, jnp.zeros((), int))
    (_, found, _), _ = lax.scan(step_on, carry, jnp.arange(most))
    p, on = found.p, found.on
    order = jnp.argsort(jnp.where(on, p[:, 1], jnp.inf))
    p, on = p[order], on[order]
    a, centre, wide = unpack(p)
    return Echoes(
        amplitude=jnp.where(on, a, 0.0),
        time=jnp.where(on, centre * step, 0.0),
        width=jnp.where(on, wide * step, 0.0),
        stderr=jnp.where(on[:, None], errors(a, centre, wide, on) * _units(step, y.dtype), 0.0),
        count=jnp.sum(on),
        model=model(p, on),
        chi2=found.chi2,
        criterion=found.criterion,
    )


def _units(step: Array, kind: Any) -> Array:
    return jnp.stack([jnp.ones((), kind), step, step])[None, :]


def _errors(whitened: Callable, q: Free, on: On, without_width: bool) -> Array:
    """(echoes, 3) standard errors of the parameters of a whitened model."""
    columns = jax.jacfwd(whitened)(q).reshape(-1, q.size)
    # Parameters that do nothing have no column; one on their diagonal keeps the inverse.
    free = jnp.asarray([1.0, 1.0, 0.0 if without_width else 1.0], q.dtype)
    idle = 1.0 - jnp.where(on, 1.0, 0.0)[:, None] * free[None, :]
    columns = columns * (1.0 - idle.reshape(1, -1))
    size = jnp.sqrt(jnp.sum(columns**2, axis=0))
    size = jnp.where(size > 0, size, 1.0)
    columns = columns / size[None, :]
    variance = jnp.diagonal(jnp.linalg.pinv(columns.T @ columns + jnp.diag(idle.reshape(-1))))
    errors = (jnp.sqrt(jnp.maximum(variance, 0.0)) / size).reshape(-1, 3)
    return jnp.where(idle > 0, 0.0, errors)


def _free(share: Array) -> Array:
    """The free parameter of a share of what bounds leave, at a margin from them."""
    share = jnp.clip(share, _MARGIN, 1.0 - _MARGIN)
    return jnp.log(share) - jnp.log1p(-share)
