"""Many fits at once: the same as one at a time, each on its own, and resumed where they were interrupted."""

import concurrent.futures
import dataclasses
import subprocess
import sys

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Unknown
from tests.helpers import slow_unless
from tests.survey.test_simulate_many import Dying

LIDAR = jl.Lidar(wavelength=(532.0, 1064.0), pulse=jl.GaussianPulse(fwhm=4.0))
WINDOW = (-20.0, 20.0)
COUNT = 20
UNKNOWNS = [
    Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height"),
    Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0), name="reflectance"),
]
START = jl.Scene(ground=jl.Ground(height=0.3, reflectance=np.array([0.3, 0.3])))
TRUTH = {
    "height": np.linspace(-0.3, 0.8, COUNT),
    "reflectance": np.stack([np.linspace(0.1, 0.4, COUNT), np.linspace(0.6, 0.2, COUNT)], axis=1),
}


@pytest.fixture(scope="module")
def footprints():
    plan = jl.plan(
        LIDAR, jl.Scene(ground=jl.Ground(height=2.0, reflectance=np.array([0.3, 0.3]))), window=WINDOW
    )
    waves = []
    for height, reflectance in zip(TRUTH["height"], TRUTH["reflectance"]):
        scene = jl.Scene(ground=jl.Ground(height=height, reflectance=reflectance))
        waves.append(jl.simulate(LIDAR, scene, key=jax.random.key(0), plan=plan))
    clean = np.stack([np.asarray(w.reflectance, float) for w in waves])
    noise = 0.01 * clean.max()
    return clean + noise * np.random.default_rng(0).normal(size=clean.shape), noise, np.asarray(waves[0].time)


def fit(footprints, lidar=LIDAR, scene=START, unknowns=UNKNOWNS, **more):
    observed, noise, time = footprints
    given = {"noise": noise, "time": time, "key": jax.random.key(1), "lanes": 6, **more}
    return inversion.retrieve_many(observed, lidar, scene, unknowns, **given)


@pytest.mark.parametrize(
    "own", slow_unless([{}], [{}, {"starts": 2}, {"max_orders": 2, "n_photons": 1024, "max_steps": 3}])
)
def test_workers_give_the_same_fits(footprints, own):
    """One lidar for all, and for each, with an unknown that starts elsewhere in each footprint."""
    own |= {"lidar": [LIDAR] * COUNT, "start": {"height": np.linspace(-0.2, 0.7, COUNT)}, "lanes": 2}
    here, seen = fit(footprints, **own), []
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        there = fit(footprints, **own, executor=pool, progress=seen.append)
    assert here.status == there.status
    for name in ("values", "stderr", "covariance", "reduced_chi2", "converged", "steps", "fitted"):
        pairs = zip(jax.tree.leaves(getattr(here, name)), jax.tree.leaves(getattr(there, name)), strict=True)
        assert all(np.array_equal(a, b) for a, b in pairs), name
    assert [p.done for p in seen] == list(range(1, COUNT + 1))


def test_a_worker_that_dies_costs_its_fits_a_second_try(footprints, tmp_path):
    here, path = fit(footprints, lanes=2), tmp_path / "fits.sqlite"
    dying = Dying([1])
    assert np.array_equal(fit(footprints, lanes=2, executor=dying).fitted, here.fitted)
    assert dying.submitted.count(1) == 2
    with pytest.raises(RuntimeError, match="the workers of chunk 1 died twice"):
        fit(footprints, lanes=2, executor=Dying([1, 1]), path=path)
    # What the others had done is kept.
    seen = []
    again = fit(footprints, lanes=2, path=path, progress=seen.append)
    assert np.array_equal(again.fitted, here.fitted)
    assert seen[0].done > 1


def test_every_footprint_is_found_within_its_errors(footprints):
    seen = []
    found = fit(footprints, progress=seen.append)
    assert np.all(found.converged)
    z = np.concatenate([np.ravel((found.values[k] - TRUTH[k]) / found.stderr[k]) for k in TRUTH])
    assert 0.7 < np.std(z) < 1.3
    assert np.max(np.abs(z)) < 4
    # A wrong truth is told apart: the neighbour's.
    wrong = np.ravel((found.values["height"][1:] - TRUTH["height"][:-1]) / found.stderr["height"][1:])
    assert np.median(np.abs(wrong)) > 4
    assert [p.done for p in seen] == list(range(1, COUNT + 1))
    assert str(seen[-1]) == f"{COUNT} of {COUNT} fits, {COUNT} converged"
    assert found.fitted.shape == footprints[0].shape
    assert found.labels == ("height", "reflectance[0]", "reflectance[1]")


def test_a_batch_is_the_fits_one_by_one(footprints):
    observed, noise, time = footprints
    found = fit(footprints)
    for i in (0, 7, COUNT - 1):
        one = inversion.retrieve(
            observed[i], LIDAR, START, UNKNOWNS, noise=noise, time=time, key=jax.random.key(1)
        )
        for name in TRUTH:
            assert np.allclose(found.values[name][i], one.values[name], rtol=1e-4, atol=1e-5)
            assert np.allclose(found.stderr[name][i], one.stderr[name], rtol=1e-3)
        assert found.steps[i] == one.steps
        assert found.status[i] == one.status


def test_a_failed_fit_leaves_its_neighbours_alone(footprints):
    observed, noise, time = footprints
    spoiled = observed.copy()
    spoiled[3] = 1e3 * np.random.default_rng(1).normal(size=spoiled[3].shape)
    good, bad = fit(footprints), fit((spoiled, noise, time), max_steps=50)
    others = np.arange(COUNT) != 3
    assert not bad.converged[3] or bad.reduced_chi2[3] > 1e3
    assert np.array_equal(good.values["height"][others], bad.values["height"][others])
    assert np.all(np.isfinite(bad.values["height"]))


def test_each_footprint_may_have_a_pulse_and_a_start_of_its_own(footprints):
    wide = dataclasses.replace(LIDAR, pulse=jl.GaussianPulse(fwhm=6.0))
    lidars = [LIDAR if i % 2 else wide for i in range(COUNT)]
    starts = [
        START if i % 3 else jl.Scene(ground=jl.Ground(reflectance=np.array([0.5, 0.2]))) for i in range(COUNT)
    ]
    found = fit(footprints, lidar=lidars, scene=starts)
    # Recorded with the narrow pulse: the wide one does not fit.
    assert found.reduced_chi2[1::2].max() < 2 < 10 < found.reduced_chi2[0::2].min()
    with pytest.raises(ValueError, match="lidar has 3 elements; admissible is one, or 20"):
        fit(footprints, lidar=lidars[:3])
    other = [START] * (COUNT - 1) + [jl.Scene(ground=jl.Ground(reflectance=0.3))]
    with pytest.raises(ValueError, match="scene 19 differs from the first"):
        fit(footprints, scene=other)


def test_what_is_done_is_kept_when_interrupted(footprints, tmp_path):
    path = tmp_path / "fits.sqlite"
    whole = fit(footprints)

    def stop(progress):
        if progress.done == 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(footprints, path=path, progress=stop)
    seen = []
    resumed = fit(footprints, path=path, progress=seen.append)
    assert [p.done for p in seen] == list(range(10, COUNT + 1))
    assert np.array_equal(resumed.values["height"], whole.values["height"])
    assert resumed.status == whole.status
    # Nothing is left to do, and nothing else may be put there.
    assert np.array_equal(fit(footprints, path=path, progress=stop).covariance, whole.covariance)
    observed, noise, time = footprints
    with pytest.raises(ValueError, match="keeps fits of another problem; what differs: observed"):
        fit((observed + 0.1, noise, time), path=path)


def test_starts_find_what_one_start_misses(footprints):
    observed, noise, time = footprints
    far = jl.Scene(ground=jl.Ground(height=-1.9, reflectance=np.array([0.3, 0.3])))
    sharp = dataclasses.replace(LIDAR, pulse=jl.GaussianPulse(fwhm=4.0))
    found = inversion.retrieve_many(
        observed[-2:], sharp, far, UNKNOWNS, noise=noise, time=time, key=jax.random.key(1), starts=8
    )
    assert np.all(found.converged)
    assert np.allclose(found.values["height"], TRUTH["height"][-2:], atol=0.05)
    assert all("of 8 starts ended there" in s for s in found.status)


def test_results_go_to_xarray(footprints):
    pytest.importorskip("xarray")
    table = fit(footprints).to_xarray()
    assert table.sizes["footprint"] == COUNT
    assert table["reflectance"].shape == (COUNT, 2)
    assert table["height stderr"].shape == (COUNT,)
    assert "converged" in str(table["status"].values[0])


def test_bad_input_is_refused(footprints):
    observed, noise, time = footprints
    for change, words in (
        ((observed[0], noise, time), "observed has the shape"),
        ((observed, np.ones(3), time), "noise has the shape"),
        ((observed, -1.0, time), "noise = -1"),
        ((observed, noise, time[:-1]), "observed has the shape"),
    ):
        with pytest.raises(ValueError, match=words):
            fit(change)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lanes": 0}, r"lanes = 0 is outside the admissible range \[1, inf\) of integers"),
        ({"starts": 0}, "starts = 0 is outside"),
        ({"starts": 1.5}, "starts = 1.5 is outside"),
        ({"max_steps": 0}, "max_steps = 0 is outside"),
        ({"max_steps": np.nan}, "max_steps = nan is outside"),
        ({"n_photons": 4}, r"n_photons = 4 is outside the admissible range \[8, inf\)"),
        ({"n_rays": 0}, "n_rays = 0 is outside"),
        ({"max_orders": 0}, "max_orders = 0 is outside"),
        ({"noise_floor": 2.0}, "noise_floor = 2 is outside"),
        ({"scale": (2.0, 1.0)}, "scale = .* is not low < high"),
        ({"unknowns": []}, "unknowns is empty"),
        ({"start": {"depth": np.zeros(COUNT)}}, "start has 'depth'; admissible are 'height', 'reflectance'"),
        ({"start": {"height": np.zeros(3)}}, r"start of 'height' has the shape \(3,\)"),
        ({"start": {"height": np.full(COUNT, 5.0)}}, "unknown 'height' starts from 5, which is outside"),
    ],
)
def test_bad_arguments_are_refused(footprints, change, words):
    with pytest.raises(ValueError, match=words):
        fit(footprints, **change)


KINDS = """
import jax, numpy as np, inversion, jaxlidar as jl
from inversion import Unknown
lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground())
given = {
    "observed": np.ones((1, 1, 9)), "lidar": lidar, "scene": scene,
    "unknowns": [Unknown("ground.height", bounds=(-1.0, 1.0))],
    "noise": 1.0, "time": np.arange(-4.0, 5.0), "key": jax.random.key(0),
}
def many(**changes):
    inversion.retrieve_many(**given | changes)
def one(**changes):
    inversion.retrieve(**given | {"observed": np.ones((1, 9))} | changes)
def profile(**changes):
    two = [*given["unknowns"], Unknown("ground.reflectance", bounds=(0.0, 1.0))]
    named = {"name": "ground.height", "values": [0.0, 0.1], "unknowns": two}
    inversion.profile_likelihood(**given | {"observed": np.ones((1, 9))} | named | changes)
def bound(**changes):
    inversion.cramer_rao(**{k: v for k, v in given.items() if k != "observed"} | changes)
for call in (
    lambda: many(observed="all"), lambda: many(observed=None), lambda: many(noise="low"),
    lambda: many(time=None), lambda: many(key=3), lambda: many(solver=None), lambda: many(lidar=scene),
    lambda: many(scene=[lidar]), lambda: many(unknowns=given["unknowns"][0]), lambda: many(unknowns=["z"]),
    lambda: many(starts="two"), lambda: many(start=[0.0]), lambda: many(path=3), lambda: many(progress=3),
    lambda: many(key=jax.random.split(given["key"])), lambda: many(start={"ground.height": "low"}),
    lambda: one(observed="all"), lambda: one(progress=3),
    lambda: one(unknowns=given["unknowns"][0]), lambda: one(solver=None),
    lambda: one(max_steps=None), lambda: bound(unknowns=iter(given["unknowns"])), lambda: bound(noise=None),
    lambda: one(lidar=None), lambda: one(scene=lidar), lambda: one(plan="p"), lambda: bound(key=None),
    lambda: profile(solver=None), lambda: profile(key=0), lambda: profile(values="all"),
    lambda: profile(steps=9), lambda: profile(max_steps=0), lambda: profile(starts=1.5),
    lambda: profile(scale=2.0), lambda: profile(progress=3), lambda: profile(noise=[1.0, 2.0]),
    lambda: Unknown(3, bounds=(0.0, 1.0)), lambda: Unknown(apply=3, name="x", start=0.5, bounds=(0.0, 1.0)),
):
    try:
        call()
        print("accepted")
    except (TypeError, ValueError) as error:
        print(type(error).__name__, error)
"""


def test_things_of_another_kind_are_refused():
    """Without the tests' own checks of types."""
    done = subprocess.run([sys.executable, "-c", KINDS], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines() == [
        "TypeError observed is a str; admissible are real numbers",
        "TypeError observed is None; admissible are real numbers",
        "TypeError noise is a str; admissible are real numbers",
        "ValueError time = None, but observed is an array: its sample times are needed",
        "TypeError key is an int; admissible is a JAX random key, as jax.random.key(0) makes it",
        "ValueError solver = None is no Gauss-Newton method of optimistix",
        "TypeError lidar is a Scene; admissible is one Lidar, or a sequence of one for each footprint",
        "TypeError scene 0 is a Lidar; admissible is a Scene",
        "TypeError unknowns is an Unknown; admissible is a sequence of Unknown",
        "TypeError unknowns[0] is a str; admissible is an Unknown",
        "TypeError starts is a str; admissible is an integer of at least 1",
        "TypeError start is a list; admissible is a mapping from names of unknowns to values",
        "TypeError path is an int; admissible is a path, or None",
        "TypeError progress = 3 is no function",
        "ValueError key has shape (2,): several keys; admissible is one JAX random key",
        "TypeError start of 'ground.height' is a str; admissible are real numbers",
        "TypeError observed is a str; admissible are real numbers",
        "TypeError progress = 3 is no function",
        "TypeError unknowns is an Unknown; admissible is a sequence of Unknown",
        "ValueError solver = None is no Gauss-Newton method of optimistix",
        "TypeError max_steps is None; admissible is an integer of at least 1",
        "TypeError unknowns is a list_iterator; admissible is a sequence of Unknown",
        "TypeError noise is None; admissible are real numbers",
        "TypeError lidar is None; admissible is a Lidar",
        "TypeError scene is a Lidar; admissible is a Scene",
        "TypeError plan is a str; admissible is a Plan",
        "TypeError key is None; admissible is a JAX random key, as jax.random.key(0) makes it",
        "ValueError solver = None is no Gauss-Newton method of optimistix",
        "TypeError key is an int; admissible is a JAX random key, as jax.random.key(0) makes it",
        "TypeError values is a str; admissible are real numbers",
        "TypeError got an unexpected keyword argument 'steps'",
        "ValueError max_steps = 0 is outside the admissible range [1, inf) of integers",
        "ValueError starts = 1.5 is outside the admissible range [1, inf) of integers",
        "ValueError scale = 2.0 is not a pair (low, high)",
        "TypeError progress = 3 is no function",
        "ValueError noise has the shape (2,), which does not broadcast to (1, 9)",
        "TypeError an unknown: where = 3 is no path and no function",
        "TypeError unknown 'x': apply = 3 is no function",
    ]
