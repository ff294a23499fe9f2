"""Pulses against quadrature in high precision, at the extremes of their parameters, and their derivatives."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from jaxlidar.sensors.pulse import (
    ExponentiallyModifiedGaussianPulse,
    GaussianPulse,
    RectangularPulse,
    SampledPulse,
)
from tests.helpers import BY_PRECISION

TOLERANCE = {"float32": 1e-6, "float64": 1e-13}
# Without optimisation: compilation takes far longer than execution here.
quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
cumulative = quick_jit(lambda pulse, t, jitter: pulse.cumulative(t, jitter))
power = quick_jit(lambda pulse, t, jitter: pulse.power(t, jitter))
FWHM = 2 * mp.sqrt(2 * mp.log(2))


def exact_gaussian(t, jitter, fwhm):
    s = mp.sqrt((fwhm / FWHM) ** 2 + mp.mpf(jitter) ** 2)
    if s == 0:
        return (mp.sign(t) + 1) / 2
    return mp.ncdf(t / s)


def exact_segments(t, jitter, knots):
    """Integrate the power through `knots`, blurred by jitter, by quadrature between them."""
    area = sum((b[0] - a[0]) * (a[1] + b[1]) / 2 for a, b in itertools.pairwise(knots))
    total = mp.mpf(0)
    for (ta, pa), (tb, pb) in itertools.pairwise(knots):
        line = lambda u, ta=ta, pa=pa, tb=tb, pb=pb: pa + (pb - pa) * (u - ta) / (tb - ta)  # noqa: E731
        if jitter == 0:
            end = min(max(t, ta), tb)
            total += (end - ta) * (pa + line(end)) / 2
        else:
            marks = sorted({ta, tb} | {min(max(t + k * jitter, ta), tb) for k in (-12, -4, 0, 4, 12)})
            total += mp.quad(lambda u: line(u) * mp.ncdf((t - u) / jitter), marks)  # noqa: B023
    return total / area


def exact_emg(t, jitter, fwhm, decay):
    if decay == 0:
        return exact_gaussian(t, jitter, fwhm)
    s, t = mp.sqrt((fwhm / FWHM) ** 2 + mp.mpf(jitter) ** 2), t + decay
    if s == 0:
        return 1 - mp.exp(-t / decay) if t > 0 else mp.mpf(0)
    # The textbook form overflows in floating point, but not in mpmath; with enough digits it is exact.
    with mp.workdps(60):
        tail = mp.exp(s**2 / (2 * decay**2) - t / decay) * mp.ncdf(t / s - s / decay)
        return mp.ncdf(t / s) - tail


# The power jumps to zero at the end.
KNOTS = [(-3.0, 0.0), (-1.0, 2.0), (-0.75, 1.5), (4.0, 0.25), (6.0, 1.0)]
SAMPLED = {"time": [a for a, _ in KNOTS], "power": [b for _, b in KNOTS]}


def sampled():
    return SampledPulse(**SAMPLED)


CASES = {
    "gaussian": (lambda: GaussianPulse(6.0), lambda t, j: exact_gaussian(t, j, 6.0)),
    "gaussian, wide": (lambda: GaussianPulse(1000.0), lambda t, j: exact_gaussian(t, j, 1000.0)),
    "gaussian, instant": (lambda: GaussianPulse(0.0), lambda t, j: exact_gaussian(t, j, 0.0)),
    "rectangle": (
        lambda: RectangularPulse(6.0),
        lambda t, j: exact_segments(t, j, [(-3.0, 1.0), (3.0, 1.0)]),
    ),
    "rectangle, narrow": (
        lambda: RectangularPulse(0.0078125),
        lambda t, j: exact_segments(t, j, [(-0.00390625, 1.0), (0.00390625, 1.0)]),
    ),
    "rectangle, instant": (lambda: RectangularPulse(0.0), lambda t, j: exact_gaussian(t, j, 0.0)),
    "exponential": (
        lambda: ExponentiallyModifiedGaussianPulse(3.0, 2.0),
        lambda t, j: exact_emg(t, j, 3.0, 2.0),
    ),
    "exponential, short": (
        lambda: ExponentiallyModifiedGaussianPulse(6.0, 2.0**-10),
        lambda t, j: exact_emg(t, j, 6.0, 2.0**-10),
    ),
    "exponential, long": (
        lambda: ExponentiallyModifiedGaussianPulse(2.0**-10, 512.0),
        lambda t, j: exact_emg(t, j, 2.0**-10, 512.0),
    ),
    "exponential, pure": (
        lambda: ExponentiallyModifiedGaussianPulse(0.0, 3.0),
        lambda t, j: exact_emg(t, j, 0.0, 3.0),
    ),
    "exponential, none": (
        lambda: ExponentiallyModifiedGaussianPulse(6.0, 0.0),
        lambda t, j: exact_emg(t, j, 6.0, 0.0),
    ),
    "exponential, instant": (
        lambda: ExponentiallyModifiedGaussianPulse(0.0, 0.0),
        lambda t, j: exact_gaussian(t, j, 0.0),
    ),
    "sampled": (sampled, lambda t, j: exact_segments(t, j, KNOTS)),
}
NAMES = list(CASES)
# Representable in both precisions, so that rounding of the input does not add to the error.
TIMES = [
    -1000.0,
    -20.0,
    -6.5,
    -3.0,
    -2.75,
    -1.0,
    -0.125,
    0.0,
    0.00390625,
    0.5,
    1.75,
    3.0,
    5.5,
    7.25,
    31.0,
    2000.0,
]


@functools.cache
def expected_of(name, jitter):
    return np.array([float(CASES[name][1](mp.mpf(t), mp.mpf(jitter))) for t in TIMES])


@pytest.mark.parametrize("jitter", [0.0, 0.0009765625, 0.25, 2.0, 64.0])
@pytest.mark.parametrize("name", NAMES)
def test_cumulative_is_exact(name, jitter, precision):
    expected = expected_of(name, jitter)
    computed = cumulative(CASES[name][0](), np.array(TIMES, precision), jitter)
    assert computed.dtype == precision
    np.testing.assert_allclose(computed, expected, rtol=0, atol=TOLERANCE[precision])


@functools.cache
def exponentials(times, jitter, decay):
    return [float(exact_emg(mp.mpf(x), mp.mpf(jitter), 0.0, mp.mpf(decay))) for x in times]


@pytest.mark.parametrize("ratio", [2.0**k for k in range(-8, 9, 2)])
def test_exponential_is_exact_for_every_ratio_of_width_to_decay(ratio, precision):
    """Dense in time, so that both formulas of the Mills ratio and the switch between them are tested."""
    jitter, decay = 2.0, 2.0 / ratio
    t = np.linspace(-12, 24, 145)
    expected = exponentials(tuple(t.tolist()), jitter, decay)
    computed = cumulative(ExponentiallyModifiedGaussianPulse(0.0, decay), t.astype(precision), jitter)
    np.testing.assert_allclose(computed, expected, rtol=0, atol=TOLERANCE[precision])


@pytest.mark.parametrize("name", NAMES)
def test_area_is_one_and_the_integral_never_falls(name, precision):
    low, high = (pulse := CASES[name][0]()).support(0.5)
    value = np.asarray(cumulative(pulse, np.linspace(low, high, 1001), 0.5))
    assert value[0] < 1e-6
    assert value[-1] > 1 - 1e-6
    assert np.diff(value).min() > -TOLERANCE[precision]


@pytest.mark.parametrize("jitter", [0.0, 0.7])
@pytest.mark.parametrize("name", NAMES)
def test_less_than_1e_7_of_the_energy_lies_outside_the_support(name, jitter):
    with jax.enable_x64(True):
        pulse = CASES[name][0]()
        low, high = pulse.support(jitter)
        outside = cumulative(pulse, low, jitter) + 1 - cumulative(pulse, high, jitter)
        if high > low:
            assert 0 <= float(outside) < 1e-7
        else:
            assert low == high == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_mean_and_std_are_those_of_the_shape(name, precision):
    pulse, jitter = CASES[name][0](), 0.5
    low, high = pulse.support(jitter)
    edges = np.linspace(low, high, 20001)
    with jax.enable_x64(True):
        energy = np.diff(np.asarray(cumulative(pulse, edges, jitter)))
    centres = (edges[1:] + edges[:-1]) / 2
    mean = np.sum(energy * centres)
    # The variances of the bins' width and of the jitter add to that of the pulse.
    variance = np.sum(energy * (centres - mean) ** 2) - (edges[1] - edges[0]) ** 2 / 12 - jitter**2
    np.testing.assert_allclose(pulse.mean, mean, atol=2e-5 * (high - low))
    np.testing.assert_allclose(pulse.std, np.sqrt(max(variance, 0.0)), atol=2e-4 * (high - low))


@pytest.mark.parametrize("name", NAMES)
def test_power_is_the_slope_of_the_integral(name):
    with jax.enable_x64(True):
        pulse, jitter, step = CASES[name][0](), 0.3, 1e-4
        t = np.linspace(-9.0, 9.0, 25)
        slope = (cumulative(pulse, t + step, jitter) - cumulative(pulse, t - step, jitter)) / (2 * step)
        np.testing.assert_allclose(power(pulse, t, jitter), slope, atol=1e-7)


def test_power_of_plain_shapes():
    np.testing.assert_allclose(
        RectangularPulse(4.0).power(np.array([-3.0, -2.0, 0.0, 1.9])), [0, 0.125, 0.25, 0.25]
    )
    area = np.trapezoid(SAMPLED["power"], SAMPLED["time"])
    expected = np.interp([-2.0, -0.5, 5.0], *zip(*KNOTS)) / area
    np.testing.assert_allclose(sampled().power(np.array([-2.0, -0.5, 5.0])), expected, rtol=1e-5)
    peak = 2 * np.sqrt(np.log(2) / np.pi) / 6
    np.testing.assert_allclose(GaussianPulse(6.0).power(np.array([0.0, 3.0])), [peak, peak / 2], rtol=1e-5)


SHAPES = {
    "Gaussian": lambda p: GaussianPulse(p[0]),
    "rectangle": lambda p: RectangularPulse(p[0]),
    "exponential": lambda p: ExponentiallyModifiedGaussianPulse(p[0], p[1]),
    "sampled": lambda p: SampledPulse(
        time=jnp.stack([-p[1], 0.0 * p[0], p[0]]), power=jnp.stack([p[1], p[0], 1.0])
    ),
}


@functools.cache
def derivative_programs(shape):
    """Return programs for the integral and its derivatives, forward, in reverse, and second ones."""
    t = jnp.array([-4.0, -1.3, 0.0, 0.4, 1.25, 3.7])

    def function(x):
        return SHAPES[shape](x).cumulative(t + 0.1 * x[0], x[2])

    forward = jax.jacfwd(function)
    return [quick_jit(f) for f in (function, forward, jax.jacrev(function), jax.jacfwd(forward))]


@pytest.mark.parametrize(
    ("shape", "decay"),
    [
        ("Gaussian", 1.3),
        pytest.param("rectangle", 1.3, marks=pytest.mark.slow),
        pytest.param("exponential", 1.3, marks=pytest.mark.slow),
        ("exponential", 0.013),
        pytest.param("sampled", 1.3, marks=pytest.mark.slow),
    ],
)
def test_derivatives_match_central_differences(shape, decay):
    with jax.enable_x64(True):
        function, forward, reverse, second = derivative_programs(shape)
        steps = 1e-5 * np.diag([1.0, decay / 1.3, 1.0])
        for jitter in (0.05, 0.9):
            unknowns = jnp.array([2.5, decay, jitter])
            slope = forward(unknowns)
            np.testing.assert_allclose(slope, reverse(unknowns), atol=1e-13)
            # In units of the steps: a short decay has large derivatives.
            numeric = [(function(unknowns + h) - function(unknowns - h)) / 2 for h in steps]
            np.testing.assert_allclose(slope @ steps, np.stack(numeric, -1), atol=2e-13)
            numeric = [(forward(unknowns + h) - forward(unknowns - h)) @ steps / 2 for h in steps]
            expected = np.einsum("tij,ik,jl->tkl", second(unknowns), steps, steps)
            np.testing.assert_allclose(expected, np.stack(numeric, -1), atol=3e-16)


EXTREMES = {
    "gaussian": lambda p: GaussianPulse(p),
    "rectangle": lambda p: RectangularPulse(p),
    "exponential, both": lambda p: ExponentiallyModifiedGaussianPulse(p, p),
    "exponential, width": lambda p: ExponentiallyModifiedGaussianPulse(p, 3.0),
    "exponential, decay": lambda p: ExponentiallyModifiedGaussianPulse(3.0, p),
    "sampled": lambda p: SampledPulse([-1.0, 0.0, 1.0], jnp.stack([p, 1.0 + 0 * p, 0 * p])),
}


@BY_PRECISION
@pytest.mark.parametrize("name", list(EXTREMES))
def test_everything_is_finite_at_the_extremes(name, precision):
    t = jnp.array([-4e3, -3.0, -1.0, -1e-6, 0.0, 1e-20, 1.0, 3.0, 4e5])

    def function(p, j, t):
        return EXTREMES[name](p).cumulative(t, j)

    everything = quick_jit(
        lambda *x: (function(*x), jax.jacrev(function, (0, 1, 2))(*x), jax.jvp(function, x, x))
    )
    for width in [0.0, 1e-30, 1e-13, 1e-6, 1e-3, 1.0, 1e3]:
        for jitter in [0.0, 1e-30, 1e-13, 1e-6, 1.0, 1e3]:
            value, reverse, forward = everything(jnp.asarray(width), jnp.asarray(jitter), t)
            assert np.all((value > -1e-6) & (value < 1 + 1e-6)), (width, jitter)
            for derivative in jax.tree.leaves((reverse, forward)):
                assert np.all(np.isfinite(derivative)), (width, jitter)


def test_instants_are_steps_of_one_half():
    t = np.array([-1e-3, 0.0, 1e-3])
    for pulse in (GaussianPulse(0.0), RectangularPulse(0.0), ExponentiallyModifiedGaussianPulse(0.0, 0.0)):
        np.testing.assert_array_equal(pulse.cumulative(t), [0.0, 0.5, 1.0])
        np.testing.assert_array_equal(pulse.power(t), 0.0)


def test_vanishing_decay_has_the_derivative_of_the_limit():
    """Time zero is the centroid, so a short tail changes the integral to second order only."""
    with jax.enable_x64(True):
        t = jnp.linspace(-5, 5, 11)
        slope = jax.jacfwd(lambda d: ExponentiallyModifiedGaussianPulse(4.0, d).cumulative(t))(0.0)
        np.testing.assert_allclose(slope, 0.0, atol=1e-14)


def test_a_finely_sampled_shape_is_that_shape(precision):
    time = np.linspace(-20, 20, 801)
    pulse = GaussianPulse(6.0)
    copy = SampledPulse(time, 37.0 * np.asarray(pulse.power(time)))
    t = np.linspace(-15, 15, 61)
    # Linear interpolation has the error (step^2 / 8) p'', here 5e-6 of the area.
    np.testing.assert_allclose(cumulative(copy, t, 0.4), cumulative(pulse, t, 0.4), atol=2e-5)
    shifted = SampledPulse(time + 2.0, pulse.power(time))
    np.testing.assert_allclose(cumulative(shifted, t + 2.0, 0.0), cumulative(copy, t, 0.0), atol=2e-6)
    np.testing.assert_allclose(shifted.mean, 2.0, atol=1e-5)
    np.testing.assert_allclose(copy.std, pulse.std, rtol=1e-4)


def test_a_sampled_pulse_may_be_faint_and_padded(precision):
    pulse = SampledPulse(time=(0, 1, 2, 3, 4, 5), power=np.array([0, 0, 1e-30, 2e-30, 0, 0]))
    assert pulse.support() == (1.0, 4.0)
    np.testing.assert_allclose(
        pulse.cumulative(np.array([1.0, 2.0, 3.0, 4.0])), [0, 1 / 6, 2 / 3, 1], rtol=1e-6
    )


def test_jit_and_vmap_without_retracing():
    traces = []

    @eqx.filter_jit
    def function(pulse, t):
        traces.append(None)
        return pulse.cumulative(t, 0.1)

    t = jnp.linspace(-4, 4, 5)
    for width in (1.0, 2.0, 0.0):
        np.testing.assert_allclose(
            function(GaussianPulse(width), t), GaussianPulse(width).cumulative(t, 0.1), atol=1e-6
        )
    assert len(traces) == 1
    by_length = eqx.filter_vmap(lambda w: RectangularPulse(w).cumulative(t))(jnp.array([0.0, 1.0, 5.0]))
    np.testing.assert_allclose(by_length[2], RectangularPulse(5.0).cumulative(t), atol=1e-7)
    grid = sampled().cumulative(t.reshape(5, 1), 0.2)
    np.testing.assert_allclose(grid[:, 0], sampled().cumulative(t, 0.2), atol=1e-7)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GaussianPulse(-1.0), r"fwhm = -1 .*\[0, inf"),
        (lambda: GaussianPulse(np.nan), "fwhm = nan"),
        (lambda: RectangularPulse(-0.5), "length = -0.5"),
        (lambda: RectangularPulse(np.inf), "length = inf"),
        (lambda: ExponentiallyModifiedGaussianPulse(-1.0, 1.0), "fwhm = -1"),
        (lambda: ExponentiallyModifiedGaussianPulse(1.0, -2.0), "decay = -2"),
        (lambda: SampledPulse([0.0, 2.0, 1.0], [1.0, 1.0, 1.0]), "time = 2 is followed by 1"),
        (lambda: SampledPulse([0.0, 0.0], [1.0, 1.0]), "time = 0 is followed by 0"),
        (lambda: SampledPulse([0.0], [1.0]), "two samples or more"),
        (lambda: SampledPulse([0.0, 1.0], [1.0, 1.0, 1.0]), "shapes"),
        (lambda: SampledPulse([0.0, np.nan], [1.0, 1.0]), "time = nan"),
        (lambda: SampledPulse([0.0, 1.0], [1.0, -0.1]), "power = -0.1"),
        (lambda: SampledPulse([0.0, 1.0], [0.0, 0.0]), "power = 0 throughout"),
    ],
)
def test_inadmissible_input_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
