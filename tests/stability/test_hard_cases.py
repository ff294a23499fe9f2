"""The table of hard cases: values and both derivatives are finite, and right where a closed form exists."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from tests.helpers import SINGLE_SAMPLE, ask, first_wave, one_batch, single_sample_lidar
from tests.stability.hard_answers import value_and_slope
from tests.stability.hard_cases import CASES, KNOWN_FAILURES
from tests.stability.hard_families import FAMILIES

KEY = jax.random.key(24)

# Compilation takes far longer than execution here: leave out the optimisation of machine code.
quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


@functools.cache
def compiled(family, precision):
    """Return a program for value, derivative along a direction, and gradient of a weighted sum, by precision.

    The measure is linearised once: the linear map is the forward derivative, its transpose the reverse.
    """
    measure = FAMILIES[family].make()

    def derivatives(p, along):
        value, linear = jax.linearize(measure, p)
        (gradient,) = jax.linear_transpose(linear, p)(weights(value.size, value.dtype))
        return value, linear(along), gradient

    return quick_jit(derivatives)


def weights(size, dtype=float):
    """Return one weight per output, all different."""
    return jnp.asarray(1.0 + 0.5 * np.sin(1.0 + np.arange(size)), dtype)


@functools.cache
def exact(number):
    case = CASES[number]
    family = FAMILIES[case.family]
    return value_and_slope(family.answer, {**family.usual, **case.numbers}, case.variable)


def case_parameters():
    """Yield every case in both precisions, one family after another."""
    for precision in ("float32", "float64"):
        for number, case in enumerate(CASES):
            marks = [pytest.mark.slow] if precision in FAMILIES[case.family].slow else []
            if str(case) in KNOWN_FAILURES:
                marks.append(pytest.mark.xfail(strict=True, reason=KNOWN_FAILURES[str(case)]))
            yield pytest.param(number, precision, marks=marks, id=f"{case}, {precision}")


@pytest.mark.parametrize(("number", "precision"), list(case_parameters()))
def test_case(number, precision):
    with jax.enable_x64(precision == "float64"):
        check(number, precision)


def check(number, precision):
    case = CASES[number]
    family = FAMILIES[case.family]
    p = {name: jnp.asarray(x, float) for name, x in {**family.usual, **case.numbers}.items()}
    along = {name: jnp.asarray(float(name == case.variable)) for name in p}
    value, tangent, gradient = compiled(case.family, precision)(p, along)
    assert value.dtype == tangent.dtype == precision
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(tangent))
    assert not [name for name, g in gradient.items() if not np.isfinite(g)]

    double = precision == "float64"
    bound, slope_bound = ((case.bounds or b)[double] for b in (family.bounds, family.slopes))
    sought, slope = exact(number)
    assert error_of(value, sought) <= bound
    if case.kink:
        return
    # The error of a derivative that is zero is measured in units of the value.
    unit, w = np.nanmax(np.abs(sought)), np.asarray(weights(value.size), float)
    assert error_of(tangent, slope, unit) <= slope_bound
    if not np.any(np.isnan(slope)):
        summed, size = np.sum(w * slope, keepdims=True), np.sum(np.abs(w * slope))
        assert error_of(gradient[case.variable][None], summed, unit, size) <= slope_bound
    else:
        # Without a closed form forward and reverse derivatives must agree.
        terms = w * np.asarray(tangent, float)
        assert abs(float(gradient[case.variable]) - np.sum(terms)) <= 1e-3 * np.sum(np.abs(terms)) + 1e-6


def error_of(computed, sought, unit=1.0, size=0.0):
    """Return the largest error of outputs with an answer, relative to the largest answer or to `unit`."""
    computed = np.asarray(computed, float)
    has_answer = ~np.isnan(sought)
    if not np.any(has_answer):
        return 0.0
    scale = max(np.max(np.abs(sought[has_answer])), size)
    # Numbers that underflow in single precision count as zero.
    scale = scale if scale > 1e-15 else unit
    error = np.max(np.abs(computed - sought)[has_answer])
    return float(error / scale) if error > 0 else 0.0


def test_cases_have_unique_names_and_numbers_of_their_family():
    assert len({str(case) for case in CASES}) == len(CASES)
    assert set(KNOWN_FAILURES) <= {str(case) for case in CASES}
    for case in CASES:
        assert {case.variable, *case.numbers} <= set(FAMILIES[case.family].usual), str(case)
    assert {case.family for case in CASES} == set(FAMILIES)


@pytest.mark.parametrize("error", [3e-5, -3e-5])
def test_errors_are_noticed(error):
    """A value, or a derivative, off by somewhat more than the bound of 1e-5 does not pass."""
    right = np.array([0.3, 0.2, np.nan])
    assert error_of(right, right) == 0.0
    assert error_of(right * (1 + error), right) > 1e-5
    assert error_of(np.full(2, abs(error)), np.zeros(2), unit=1.0) > 1e-5


# -- photons and retrievals: no derivative of one number ---------------------------------------------------


def over_ground(leaf, n_layers=3):
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.full((1, 1, n_layers), 0.3), voxel_size=(4.0, 4.0, 1.0), origin=(-2.0, -2.0, 1.0)
    )
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=False),
        ground=jl.Ground(reflectance=0.4),
    )


@pytest.mark.slow
def test_batches_of_one_photon():
    lidar, scene = single_sample_lidar(), over_ground(jl.LeafOptics(reflectance=0.5, transmittance=0.3))
    plan = jl.plan(lidar, scene, max_orders=3, n_rays=64, **SINGLE_SAMPLE)
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan, n_photons=1)
    assert wave.info["photons"] == 8
    assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(wave))
    np.testing.assert_allclose(sum(wave.energy_budget.values()), 1.0, atol=2e-6)


@pytest.mark.slow
def test_a_batch_of_ten_million_photons():
    """Each photon carries 1e-7, less than the spacing of single precision at one half."""
    lidar, scene = single_sample_lidar(), over_ground(jl.LeafOptics(reflectance=0.0, transmittance=0.0))
    plan = jl.plan(lidar, scene, max_orders=2, n_photons=80_000_000, n_rays=64, **SINGLE_SAMPLE)
    setup = jl.make_setup(lidar, scene, plan)
    wave = one_batch(setup, KEY)
    np.testing.assert_allclose(sum(wave.energy_budget.values()), 1.0, atol=2e-4)
    # A slab of optical depth 0.9; ground of reflectance 0.4.
    passed = np.exp(-0.9)
    arrived = wave.energy_budget["absorbed by ground"] / 0.6
    np.testing.assert_allclose(arrived, passed, rtol=5e-4)


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_a_canopy_from_400_km_as_from_1_km(precision):
    """In samples of 0.1 ns, by a beam of the same width and an aperture of the same angular size."""
    with jax.enable_x64(precision == "float64"):
        lidars = [
            jl.Lidar(
                altitude=1e3 * scale,
                divergence=0.2 / scale,
                aperture=0.2 * scale,
                sampling_interval=0.1,
                pulse=jl.GaussianPulse(fwhm=1.0),
            )
            for scale in (1.0, 400.0)
        ]
        scene = over_ground(jl.LeafOptics(reflectance=0.5, transmittance=0.3))
        plan = jl.plan(lidars[0], scene, max_orders=1, n_rays=512, footprint="fixed", window=(-35.0, 5.0))
        low, high = (first_wave(lidar, scene, plan).reflectance for lidar in lidars)
        np.testing.assert_allclose(high, low, rtol=0, atol=1e-4 * float(np.max(low)))
        assert float(np.max(low)) > 1e-3


def fitted(observed, lidar, start, unknowns):
    noise = 0.01 * float(np.max(observed.reflectance))
    sizes = {"n_photons": 4096, "n_rays": 128, "max_orders": 1}
    return ask(
        inversion.retrieve, observed, lidar, start, unknowns, noise=noise, key=jax.random.key(1), **sizes
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reflectance", "height"), [(0.0, -1.0), (1.0, 1.0), (0.0, 1.0)], ids=["low", "high", "both"]
)
def test_fits_that_start_at_a_bound(reflectance, height):
    lidar = jl.Lidar()
    observed = jl.simulate(lidar, jl.Scene(ground=jl.Ground(reflectance=0.3, height=0.2)), key=KEY)
    start = jl.Scene(ground=jl.Ground(reflectance=reflectance, height=height))
    unknowns = [
        inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="reflectance"),
        inversion.Unknown(lambda s: s.ground.height, bounds=(-1.0, 1.0), name="height"),
    ]
    fit = fitted(observed, lidar, start, unknowns)
    assert fit.status.startswith("converged")
    assert "bound" not in fit.status
    for name, truth in (("reflectance", 0.3), ("height", 0.2)):
        assert abs(float(fit.values[name]) - truth) < 3e-2 * float(np.sqrt(truth)), name
        assert 0 < float(fit.stderr[name]) < 0.1


@pytest.mark.slow
def test_chlorophyll_is_undetermined_at_1064_nm():
    """It has no finite covariance, and the unknown that the waveform determines is fitted all the same."""
    lidar = jl.Lidar(wavelength=1064.0, altitude=500.0, divergence=4.0)
    observed = jl.simulate(lidar, over_ground(jl.Prospect(Cab=40.0)), key=KEY, max_orders=1)
    start = eqx.tree_at(lambda s: s.ground.reflectance, over_ground(jl.Prospect(Cab=60.0)), jnp.asarray(0.2))
    unknowns = [
        inversion.Unknown(lambda s: s.canopy.leaf.Cab, bounds=(5.0, 100.0), name="Cab"),
        inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="ground"),
    ]
    fit = fitted(observed, lidar, start, unknowns)
    assert "the data do not determine Cab (infinite standard error)" in fit.status
    assert np.isinf(fit.stderr["Cab"])
    assert np.isinf(fit.covariance[0, 0])
    assert np.all(np.asarray(fit.covariance)[0, 1:] == 0)
    assert np.all(np.asarray(fit.correlation) == np.eye(2))
    assert float(fit.values["ground"]) == pytest.approx(0.4, abs=0.02)
    assert 0 < float(fit.stderr["ground"]) < 0.05
