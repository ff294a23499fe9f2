"""Unknowns of the lidar: columns beside differences, fits, plans that serve their bounds, and refusals."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Unknown
from inversion.fit.model import ForwardModel
from inversion.fit.planning import corner_cases, plan_for_bounds
from inversion.fit.unknowns import bind_unknowns, flat_start
from jaxlidar.planning.plan_check import check_pulse, check_reach
from tests.helpers import ask

SLOPE = 20.0
# It rises to the east.
SCENE = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=SLOPE, aspect=270.0))
LIDAR = jl.Lidar(altitude=500.0, divergence=8.0, zenith=5.0, azimuth=60.0, pulse=jl.GaussianPulse(5.0))
TIME = np.arange(-40.0, 41.0)
SIZES = {"n_photons": 512, "n_rays": 1024, "max_orders": 1}
FIRST_ORDER: Any = {"max_orders": 1, "n_rays": 1024, "n_photons": 8}
# A step of the difference, and bounds, by path.
STEPS = {
    "lidar.position": (0.05, (-5.0, 5.0)),
    "lidar.altitude": (2.0, (400.0, 600.0)),
    "lidar.zenith": (0.05, (0.0, 10.0)),
    "lidar.azimuth": (0.5, (0.0, 90.0)),
    "lidar.divergence": (0.1, (4.0, 12.0)),
    "lidar.pulse.fwhm": (0.05, (3.0, 8.0)),
}


def array_of(lidar: Any, path: str) -> Any:
    return lidar.pulse.fwhm if path == "lidar.pulse.fwhm" else getattr(lidar, path.removeprefix("lidar."))


def waveform_of(lidar, scene=SCENE, key=0):
    return jl.simulate(lidar, scene, key=jax.random.key(key), window=(TIME[0], TIME[-1]), **FIRST_ORDER)


@pytest.fixture(scope="module")
def jacobian():
    """Columns of all unknowns, and the waveform as a function of the lidar, by one plan."""
    unknowns = [Unknown(path, bounds=bounds) for path, (_, bounds) in STEPS.items()]
    bound = bind_unknowns(unknowns, SCENE, LIDAR)
    plan = plan_for_bounds(LIDAR, SCENE, bound, TIME, **SIZES)
    columns = ForwardModel(LIDAR, SCENE, plan, bound, jax.random.key(0))(flat_start(bound)).jacobian[0]

    @eqx.filter_jit
    def reflectance(lidar):
        setup = jl.make_setup(lidar, SCENE, plan)
        response = jl.trace_scene(setup, jax.random.fold_in(jax.random.key(0), 0), reverse=False)
        return jl.total_reflectance(response, setup)[0]

    return columns, reflectance


@pytest.mark.parametrize("path", STEPS)
def test_columns_agree_with_differences(jacobian, path):
    columns, reflectance = jacobian
    # The position has two columns.
    number = ["lidar.position", "lidar.position[1]", *list(STEPS)[1:]].index(path)
    step, _ = STEPS[path]
    value = jnp.asarray(array_of(LIDAR, path), float)
    direction = step * jnp.eye(max(value.size, 1))[0].reshape(value.shape)
    lidars = [eqx.tree_at(lambda a: array_of(a, path), LIDAR, value + sign * direction) for sign in (1, -1)]
    ends = [np.asarray(reflectance(lidar), float) for lidar in lidars]
    difference, column = (ends[0] - ends[1]) / (2 * step), columns[:, number]
    norm = np.linalg.norm(difference)
    assert norm > 0
    assert np.linalg.norm(column - difference) < 0.02 * norm
    # A column that is wrong by a tenth is not accepted.
    assert np.linalg.norm(1.1 * column - difference) > 0.05 * norm


def test_the_place_of_a_footprint_and_its_pulse_are_found():
    """On a slope the time of the return tells how far east the footprint lies, its width the pulse."""
    truth = dataclasses.replace(LIDAR, position=(1.5, 0.0), pulse=jl.GaussianPulse(4.0))
    wave = waveform_of(truth)
    noise = 0.01 * float(wave.reflectance.max())
    observed = wave.reflectance + noise * np.random.default_rng(1).normal(size=wave.reflectance.shape)
    unknowns = [
        Unknown("lidar.position", bounds=((-5.0, -1e-3), (5.0, 1e-3)), name="position"),
        Unknown("lidar.pulse.fwhm", bounds=(3.0, 8.0), name="fwhm"),
    ]
    options = {"noise": noise, "time": TIME, "key": jax.random.key(2), **FIRST_ORDER}
    fit = ask(inversion.retrieve, observed, LIDAR, SCENE, unknowns, **options)
    assert fit.converged, fit.status
    for value, error, true_value in (
        (fit.values["position"][0], fit.stderr["position"][0], 1.5),
        (fit.values["fwhm"], fit.stderr["fwhm"], 4.0),
    ):
        assert abs(value - true_value) < 4 * error
        assert error < 0.1
    # The start lies many standard errors away.
    assert 10 * fit.stderr["position"][0] < 1.5


def test_a_slope_tells_how_far_up_it_a_footprint_lies():
    """The mean time of the return does, with the slope; along the contour nothing changes."""
    options: Any = {"noise": 1e-3, "key": jax.random.key(0), **FIRST_ORDER}
    position = Unknown("lidar.position", bounds=(-5.0, 5.0))
    bound = ask(inversion.cramer_rao, None, LIDAR, SCENE, [position], **options)
    error = bound.stderr["lidar.position"]
    assert error[0] < 0.1
    assert not error[1] < 100 * error[0]


@pytest.mark.slow
def test_a_bound_at_nadir_is_that_of_a_beam_beside_it():
    """A start on a bound moves by 1 % of the width, to 0.09 degrees. A plan for nadir does not serve it."""
    nadir = dataclasses.replace(LIDAR, zenith=0.0, azimuth=90.0)
    options: Any = {"noise": 1e-3, "key": jax.random.key(0), **FIRST_ORDER}
    zenith = Unknown("lidar.zenith", bounds=(0.0, 9.0))
    errors = [
        float(ask(inversion.cramer_rao, None, lidar, SCENE, [zenith], **options).stderr["lidar.zenith"])
        for lidar in (nadir, dataclasses.replace(nadir, zenith=0.09))
    ]
    assert np.isfinite(errors[0])
    assert errors[0] == pytest.approx(errors[1], rel=0.01)
    plan = jl.plan(nadir, SCENE, max_orders=1, describe=False)
    with pytest.raises(ValueError, match="the plan does not fit: it is for a beam at nadir"):
        ask(inversion.cramer_rao, None, nadir, SCENE, [zenith], noise=1e-3, key=jax.random.key(0), plan=plan)


@pytest.mark.slow
def test_posterior_and_profile_know_the_lidar():
    """The gradient of a log-density is its difference, and a profile's minimum is at the truth."""
    truth = dataclasses.replace(LIDAR, pulse=jl.GaussianPulse(4.0))
    wave = waveform_of(truth)
    unknowns = [
        Unknown("lidar.pulse.fwhm", bounds=(3.0, 8.0), name="fwhm"),
        Unknown("ground.reflectance", bounds=(0.1, 0.6), name="reflectance"),
    ]
    options = {"noise": 0.01 * float(wave.reflectance.max()), "key": jax.random.key(2), **FIRST_ORDER}
    density = ask(inversion.log_density, wave, LIDAR, SCENE, unknowns, **options)
    gradient = np.asarray(jax.grad(density)(density.initial))
    step = 0.02 * np.eye(2)
    differences = [float(density(density.initial + h) - density(density.initial - h)) / 0.04 for h in step]
    np.testing.assert_allclose(gradient, differences, rtol=0.02)
    profile = ask(
        inversion.profile_likelihood, wave, LIDAR, SCENE, unknowns, "fwhm", [3.8, 4.0, 4.2], **options
    )
    assert int(np.argmin(profile.chi2)) == 1
    assert min(profile.chi2[0], profile.chi2[2]) > 10.0


@pytest.mark.slow
def test_each_footprint_starts_from_its_own_lidar():
    lidars = [dataclasses.replace(LIDAR, position=(x, 0.0)) for x in (0.0, 20.0)]
    truths = [dataclasses.replace(LIDAR, position=(x, 0.0)) for x in (0.4, 20.6)]
    # Flat enough that the second return is within the record.
    scene = eqx.tree_at(lambda s: s.ground.slope, SCENE, jnp.asarray(3.0))
    waves = [waveform_of(lidar, scene) for lidar in truths]
    unknown = Unknown("lidar.position", bounds=((-1.0, -1e-3), (22.0, 1e-3)), name="position")
    observed = np.stack([wave.reflectance for wave in waves])
    options = {"noise": 1e-3 * observed.max(), "time": TIME, "key": jax.random.key(3), **FIRST_ORDER}
    fits = ask(inversion.retrieve_many, observed, lidars, scene, [unknown], **options)
    np.testing.assert_allclose(fits.values["position"][:, 0], [0.4, 20.6], atol=0.05)


def test_a_plan_serves_all_lidars_within_the_bounds():
    """From a beam at nadir with a long pulse, bounds lead to oblique beams and short pulses."""
    nadir = dataclasses.replace(LIDAR, zenith=0.0, pulse=jl.GaussianPulse(8.0))
    unknowns = [Unknown("lidar.zenith", bounds=(0.0, 10.0)), Unknown("lidar.pulse.fwhm", bounds=(2.0, 9.0))]
    bound = bind_unknowns(unknowns, SCENE, nadir)
    plan = plan_for_bounds(nadir, SCENE, bound, TIME, **SIZES)
    own = jl.plan(nadir, SCENE, max_orders=1, window=(TIME[0], TIME[-1]))
    assert own.config.vertical
    assert not plan.config.vertical
    assert plan.bins.width < 0.5 * own.bins.width
    cases = corner_cases(nadir, SCENE, bound)
    assert len(cases) == 5
    for case in cases:
        check_reach(plan, *case)
        check_pulse(plan, *case)
    # That of the start does not.
    options = {"noise": 0.01, "key": jax.random.key(0)}
    wave = waveform_of(nadir)
    with pytest.raises(ValueError, match="the plan does not fit: it is for a beam at nadir"):
        ask(inversion.retrieve, wave, nadir, SCENE, unknowns, plan=own, **options)


def test_inadmissible_arrays_are_refused():
    def bind(*paths: str, lidar: jl.Lidar | None = LIDAR):
        return bind_unknowns([Unknown(path, bounds=(0.0, 1e4)) for path in paths], SCENE, lidar)

    with pytest.raises(ValueError, match=r"where = 'lidar.energy'; admissible are 'lidar.altitude', "):
        bind("lidar.energy")
    with pytest.raises(ValueError, match=r"where = 'lidar.zenith'; admissible here are arrays of the scene"):
        bind("lidar.zenith", lidar=None)
    with pytest.raises(ValueError, match="picks an array that another one picks as well"):
        bind_unknowns([Unknown("lidar.zenith", bounds=(0.0, 9.0), name=name) for name in "ab"], SCENE, LIDAR)
    survey = jl.Survey(LIDAR, position=[(0.0, 0.0), (5.0, 0.0)])
    zenith = Unknown("lidar.zenith", bounds=(0.0, 9.0))
    with pytest.raises(ValueError, match="admissible here are arrays of the scene"):
        inversion.retrieve_scene(
            np.zeros((2, 1, TIME.size)), survey, SCENE, [zenith], noise=1.0, time=TIME, key=jax.random.key(0)
        )
