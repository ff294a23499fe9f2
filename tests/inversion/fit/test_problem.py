"""Problems: checked once, immutable, made anew with other parts, and asked by functions that suit them."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Problem, Recorder, Unknown

LIDAR, SCENE, KEY = jl.Lidar(), jl.Scene(ground=jl.Ground(height=0.5, reflectance=0.3)), jax.random.key(1)
UNKNOWNS = [
    Unknown("ground.height", bounds=(-2.0, 2.0), name="height"),
    Unknown("ground.reflectance", bounds=(0.0, 1.0), name="reflectance"),
]


@pytest.fixture(scope="module")
def wave():
    return jl.simulate(LIDAR, SCENE, key=jax.random.key(0), window=(-30.0, 30.0))


def test_a_problem_is_planned_once_for_all_that_is_asked(wave, monkeypatch):
    problem = Problem(wave, LIDAR, SCENE, UNKNOWNS, noise=0.002)
    monkeypatch.setattr("inversion.fit.problem.checked_plan", lambda *_: pytest.fail("planned again"))
    fit = inversion.retrieve(problem, key=KEY)
    profile = inversion.profile_likelihood(problem, "height", [0.49, 0.5, 0.51], key=KEY)
    density = inversion.log_density(problem, key=KEY)
    bound = inversion.cramer_rao(problem, key=KEY)
    assert fit.converged
    assert int(np.argmin(profile.chi2)) == 1
    assert density.names == fit.labels == bound.labels == ("height", "reflectance")
    # First order is exact, so that a fit's errors are the bound at its end.
    for name, error in fit.stderr.items():
        np.testing.assert_allclose(bound.stderr[name], error, rtol=0.01)


def test_a_bound_has_the_unknowns_and_the_noise_of_the_recorder(wave):
    """It is the error of a fit, which a bound without the recorder is not."""
    recorder = Recorder(offset=(-0.1, 0.1), correlation=0.5, pulse_noise=0.02)
    options = {"noise": 0.002, "time": wave.time, "scale": (0.5, 2.0)}
    record = 1.2 * wave.reflectance + 0.01
    problem = Problem(record, LIDAR, SCENE, UNKNOWNS[:1], recorder=recorder, **options)
    fit, bound = inversion.retrieve(problem, key=KEY), inversion.cramer_rao(problem, key=KEY)
    assert bound.labels == fit.labels == ("height", "offset", "scale")
    for name, error in fit.stderr.items():
        np.testing.assert_allclose(bound.stderr[name], error, rtol=0.02)
    plain = inversion.cramer_rao(dataclasses.replace(problem, recorder=None), key=KEY)
    assert abs(plain.stderr["height"] / bound.stderr["height"] - 1.0) > 0.1


def test_starts_are_those_of_the_problem(wave):
    problem = Problem(wave, LIDAR, SCENE, UNKNOWNS, noise=0.002, start={"height": 0.2, "reflectance": 0.6})
    values = inversion.log_density(problem, key=KEY)
    at_start = values.to_natural(values.initial)
    np.testing.assert_allclose([at_start["height"], at_start["reflectance"]], [0.2, 0.6], rtol=1e-4)
    assert float(inversion.retrieve(problem, key=KEY).values["height"]) == pytest.approx(0.5, abs=0.01)
    many = Problem(
        np.stack([wave.reflectance] * 2),
        LIDAR,
        SCENE,
        UNKNOWNS,
        noise=0.002,
        time=wave.time,
        start={"height": [0.2, 0.4]},
    )
    assert inversion.retrieve_many(many, key=KEY).converged.all()


def test_a_problem_cannot_be_changed(wave):
    problem = Problem(wave, LIDAR, SCENE, UNKNOWNS, noise=0.002)
    with pytest.raises(AttributeError):
        problem.noise = 1.0  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValueError, match="noise = -1 is outside"):
        dataclasses.replace(problem, noise=-1.0)


def test_problems_of_other_records_are_refused(wave):
    many = Problem(wave.reflectance[None], LIDAR, SCENE, UNKNOWNS, noise=0.002, time=wave.time)
    one, none = (Problem(observed, LIDAR, SCENE, UNKNOWNS, noise=0.002) for observed in (wave, None))
    of_one = (
        inversion.retrieve,
        inversion.log_density,
        lambda problem, key: inversion.profile_likelihood(problem, "height", [0.0, 0.1], key=key),
    )
    for function in (*of_one, inversion.cramer_rao):
        with pytest.raises(ValueError, match="observed has many records"):
            function(many, key=KEY)
    for function in (*of_one, inversion.retrieve_many):
        with pytest.raises(ValueError, match="problem has observed = None"):
            function(none, key=KEY)
    with pytest.raises(ValueError, match="observed is one record"):
        inversion.retrieve_many(one, key=KEY)
    with pytest.raises(TypeError, match=r"sequence of Waveforms; admissible .* numpy\.stack"):
        Problem([wave, wave], LIDAR, SCENE, UNKNOWNS, noise=1.0)
    with pytest.raises(ValueError, match="one record or more"):
        Problem(np.zeros((0, 1, 9)), LIDAR, SCENE, UNKNOWNS, noise=1.0, time=np.arange(9.0))


def test_numbers_that_jax_traces_are_refused(wave):
    problem = Problem(wave, LIDAR, SCENE, UNKNOWNS, noise=0.002)
    with pytest.raises(
        TypeError, match="JAX traces one of them; admissible is a Problem that is made within"
    ):
        eqx.filter_jit(lambda problem: inversion.retrieve(problem, key=KEY).values["height"])(problem)
