"""Many fits: equal to single fits, independent of one another, and resumed after an interruption."""

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
from tests.helpers import ask, slow_unless
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


def fit(footprints, lidar=LIDAR, scene=START, unknowns=UNKNOWNS, **options):
    observed, noise, time = footprints
    options = {"noise": noise, "time": time, "key": jax.random.key(1), "lanes": 6, **options}
    return ask(inversion.retrieve_many, observed, lidar, scene, unknowns, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", slow_unless([{}], [{}, {"starts": 2}, {"max_orders": 2, "n_photons": 1024, "max_steps": 3}])
)
def test_workers_give_the_same_fits(footprints, options):
    """With a lidar and a start for each footprint, and one scene for all."""
    options |= {"lidar": [LIDAR] * COUNT, "start": {"height": np.linspace(-0.2, 0.7, COUNT)}, "lanes": 2}
    in_process, reports = fit(footprints, **options), []
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        by_workers = fit(footprints, **options, executor=pool, progress=reports.append)
    assert in_process.status == by_workers.status
    for name in ("values", "stderr", "covariance", "reduced_chi2", "converged", "steps", "fitted"):
        a, b = (jax.tree.leaves(getattr(fits, name)) for fits in (in_process, by_workers))
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True)), name
    assert [p.done for p in reports] == list(range(1, COUNT + 1))


@pytest.mark.slow
def test_a_worker_that_dies_costs_its_fits_a_second_try(footprints, tmp_path):
    expected, path = fit(footprints, lanes=2), tmp_path / "fits.zarr"
    dying = Dying([1])
    assert np.array_equal(fit(footprints, lanes=2, executor=dying).fitted, expected.fitted)
    assert dying.submitted.count(1) == 2
    with pytest.raises(RuntimeError, match="the workers of chunk 1 died twice"):
        fit(footprints, lanes=2, executor=Dying([1, 1]), path=path)
    # The store has the fits of the other chunks.
    reports = []
    resumed = fit(footprints, lanes=2, path=path, progress=reports.append)
    assert np.array_equal(resumed.fitted, expected.fitted)
    assert reports[0].done > 1


def test_every_footprint_is_retrieved_within_its_errors(footprints):
    reports = []
    fits = fit(footprints, progress=reports.append)
    assert np.all(fits.converged)
    z = np.concatenate([np.ravel((fits.values[k] - TRUTH[k]) / fits.stderr[k]) for k in TRUTH])
    assert 0.7 < np.std(z) < 1.3
    assert np.max(np.abs(z)) < 4
    # Negative control: the truth of the neighbour.
    neighbour_z = np.ravel((fits.values["height"][1:] - TRUTH["height"][:-1]) / fits.stderr["height"][1:])
    assert np.median(np.abs(neighbour_z)) > 4
    assert [p.done for p in reports] == list(range(1, COUNT + 1))
    assert str(reports[-1]).startswith(f"{COUNT} of {COUNT} fits, {COUNT} converged, ")
    assert reports[-1].left == 0.0
    assert fits.fitted.shape == footprints[0].shape
    assert fits.labels == ("height", "reflectance[0]", "reflectance[1]")


def test_the_result_has_an_axis_of_footprints_in_memory_and_in_files(footprints, tmp_path):
    observed, noise, time = footprints
    fits = fit((observed[:3], noise, time))
    assert isinstance(fits, inversion.Retrieval)
    assert len(fits) == len(list(fits)) == len(fits.quality) == 3
    assert fits.correlation.shape == (3, 3, 3)
    assert fits.residuals.shape == (3, *observed[0].shape)
    chi2 = np.sum(fits.residuals**2, axis=(1, 2)) / (observed[0].size - 3)
    np.testing.assert_allclose(chi2, fits.reduced_chi2, rtol=1e-6)
    one = fits[1]
    assert (one.status, one.labels, one.quality) == (fits.status[1], fits.labels, fits.quality[1])
    assert one.values["reflectance"].tolist() == fits.values["reflectance"][1].tolist()
    np.testing.assert_array_equal(one.correlation, fits.correlation[1])
    np.testing.assert_array_equal(one.band("height")[0], fits.band("height")[0][1])
    assert str(one).startswith("height ")
    assert str(fits) == "3 fits of height, reflectance: 3 converged"
    assert (one.scene, one.waveform) == (None, None)
    with pytest.raises(IndexError, match="footprint 3: there are 3"):
        fits[3]
    for refused in (len, iter, lambda fit: fit[0], lambda fit: fit.to_xarray()):
        with pytest.raises(TypeError, match="no axis of footprints"):
            refused(one)
    for name in ("fits.nc", "fits.zarr"):
        for result in (fits, one):
            jl.io.save(result, tmp_path / name)
            stored = jl.open(tmp_path / name)
            assert jax.tree.structure(stored) == jax.tree.structure(result)
            jax.tree.map(np.testing.assert_array_equal, stored, result)


def test_many_fits_are_the_single_fits(footprints):
    observed, noise, time = footprints
    fits = fit(footprints)
    for i in (0, 7, COUNT - 1):
        single = ask(
            inversion.retrieve,
            observed[i],
            LIDAR,
            START,
            UNKNOWNS,
            noise=noise,
            time=time,
            key=jax.random.key(1),
        )
        for name in TRUTH:
            assert np.allclose(fits.values[name][i], single.values[name], rtol=1e-4, atol=1e-5)
            assert np.allclose(fits.stderr[name][i], single.stderr[name], rtol=1e-3)
        assert fits.steps[i] == single.steps
        assert fits.status[i] == single.status


def test_a_failed_fit_does_not_affect_its_neighbours(footprints):
    observed, noise, time = footprints
    damaged = observed.copy()
    damaged[3] = 1e3 * np.random.default_rng(1).normal(size=damaged[3].shape)
    expected, fits = fit(footprints), fit((damaged, noise, time), max_steps=50)
    is_neighbour = np.arange(COUNT) != 3
    assert not fits.converged[3] or fits.reduced_chi2[3] > 1e3
    assert np.array_equal(expected.values["height"][is_neighbour], fits.values["height"][is_neighbour])
    assert np.all(np.isfinite(fits.values["height"]))


@pytest.mark.slow
def test_each_footprint_may_have_its_own_pulse_and_start(footprints):
    wide_pulse = dataclasses.replace(LIDAR, pulse=jl.GaussianPulse(fwhm=6.0))
    lidars = [LIDAR if i % 2 else wide_pulse for i in range(COUNT)]
    starts = [
        START if i % 3 else jl.Scene(ground=jl.Ground(reflectance=np.array([0.5, 0.2]))) for i in range(COUNT)
    ]
    fits = fit(footprints, lidar=lidars, scene=starts)
    # Recorded with the narrow pulse: the wide one does not fit.
    assert fits.reduced_chi2[1::2].max() < 2 < 10 < fits.reduced_chi2[0::2].min()
    with pytest.raises(ValueError, match="lidar has 3 elements; admissible is one, or 20"):
        fit(footprints, lidar=lidars[:3])
    # One scene with a reflectance for all wavelengths.
    unequal = [START] * (COUNT - 1) + [jl.Scene(ground=jl.Ground(reflectance=0.3))]
    with pytest.raises(ValueError, match="scene 19 differs from the first"):
        fit(footprints, scene=unequal)


def test_an_interrupted_run_goes_on_from_its_store(footprints, tmp_path):
    path = tmp_path / "fits.zarr"
    expected = fit(footprints)

    def stop(progress):
        if progress.done == 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(footprints, path=path, progress=stop)
    reports = []
    resumed = fit(footprints, path=path, progress=reports.append)
    assert [p.done for p in reports] == list(range(10, COUNT + 1))
    assert np.array_equal(resumed.values["height"], expected.values["height"])
    assert resumed.status == expected.status
    # No fit is left, and the store takes no other problem.
    assert np.array_equal(fit(footprints, path=path, progress=stop).covariance, expected.covariance)
    observed, noise, time = footprints
    with pytest.raises(ValueError, match="holds results of another problem, which differs in observed"):
        fit((observed + 0.1, noise, time), path=path)


@pytest.mark.slow
def test_several_starts_find_a_minimum_that_one_start_misses(footprints):
    observed, noise, time = footprints
    far_start = jl.Scene(ground=jl.Ground(height=-1.9, reflectance=np.array([0.3, 0.3])))
    options = {"noise": noise, "time": time, "key": jax.random.key(1), "starts": 8}
    fits = ask(inversion.retrieve_many, observed[-2:], LIDAR, far_start, UNKNOWNS, **options)
    assert np.all(fits.converged)
    assert np.allclose(fits.values["height"], TRUTH["height"][-2:], atol=0.05)
    assert all("of 8 starts ended there" in s for s in fits.status)


def test_results_go_to_xarray(footprints):
    pytest.importorskip("xarray")
    table = fit(footprints).to_xarray()
    assert table.sizes["footprint"] == COUNT
    assert table["reflectance"].shape == (COUNT, 2)
    assert table["height stderr"].shape == (COUNT,)
    assert "converged" in str(table["status"].values[0])


def test_inadmissible_records_are_refused(footprints):
    observed, noise, time = footprints
    for change, message in (
        ((observed[0], noise, time), "observed is one record"),
        ((observed, np.ones(3), time), "noise has the shape"),
        ((observed, -1.0, time), "noise = -1"),
        ((observed, noise, time[:-1]), "observed has the shape"),
    ):
        with pytest.raises(ValueError, match=message):
            fit(change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lanes": 0}, r"lanes = 0 is outside the admissible range \[1, inf\) of integers"),
        ({"starts": 0}, "starts = 0 is outside"),
        ({"max_steps": 0}, "max_steps = 0 is outside"),
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
def test_inadmissible_arguments_are_refused(footprints, change, message):
    with pytest.raises(ValueError, match=message):
        fit(footprints, **change)


WRONG_TYPES = """
import jax, numpy as np, inversion, jaxlidar as jl
from inversion import Unknown
from tests.helpers import ask
lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground())
arguments = {
    "observed": np.ones((1, 1, 9)), "lidar": lidar, "scene": scene,
    "unknowns": [Unknown("ground.height", bounds=(-1.0, 1.0))],
    "noise": 1.0, "time": np.arange(-4.0, 5.0), "key": jax.random.key(0),
}
def fit_many(**changes):
    ask(inversion.retrieve_many, **arguments | changes)
def fit_one(**changes):
    ask(inversion.retrieve, **arguments | {"observed": np.ones((1, 9))} | changes)
def profile(**changes):
    two_unknowns = [*arguments["unknowns"], Unknown("ground.reflectance", bounds=(0.0, 1.0))]
    named = {"name": "ground.height", "values": [0.0, 0.1], "unknowns": two_unknowns}
    ask(inversion.profile_likelihood, **arguments | {"observed": np.ones((1, 9))} | named | changes)
def bound(**changes):
    ask(inversion.cramer_rao, **arguments | {"observed": None} | changes)
for call in (
    lambda: fit_many(observed="all"),
    lambda: fit_many(observed=None),
    lambda: fit_many(noise="low"),
    lambda: fit_many(time=None),
    lambda: fit_many(key=3),
    lambda: fit_many(lidar=scene),
    lambda: fit_many(scene=[lidar]),
    lambda: fit_many(unknowns=arguments["unknowns"][0]),
    lambda: fit_many(unknowns=["z"]),
    lambda: fit_many(starts="two"),
    lambda: fit_many(starts=1.5),
    lambda: fit_many(max_steps=np.nan),
    lambda: fit_many(start=[0.0]),
    lambda: fit_many(path=3),
    lambda: fit_many(progress=3),
    lambda: fit_many(key=jax.random.split(arguments["key"])),
    lambda: fit_many(start={"ground.height": "low"}),
    lambda: fit_one(observed="all"),
    lambda: fit_one(progress=3),
    lambda: fit_one(unknowns=arguments["unknowns"][0]),
    lambda: fit_one(max_steps=None),
    lambda: fit_one(max_steps=np.nan),
    lambda: fit_one(starts=1.5),
    lambda: bound(unknowns=iter(arguments["unknowns"])),
    lambda: bound(noise=None),
    lambda: fit_one(lidar=None),
    lambda: fit_one(scene=lidar),
    lambda: fit_one(plan="p"),
    lambda: bound(key=None),
    lambda: profile(key=0),
    lambda: profile(values="all"),
    lambda: profile(steps=9),
    lambda: profile(max_steps=0),
    lambda: profile(starts=1.5),
    lambda: profile(scale=2.0),
    lambda: profile(progress=3),
    lambda: profile(noise=[1.0, 2.0]),
    lambda: inversion.retrieve(arguments["observed"], key=arguments["key"]),
    lambda: Unknown(3, bounds=(0.0, 1.0)),
    lambda: Unknown(apply=3, name="x", start=0.5, bounds=(0.0, 1.0)),
):
    try:
        call()
        print("accepted")
    except (TypeError, ValueError) as error:
        print(type(error).__name__, error)
"""


def test_arguments_of_the_wrong_type_are_refused():
    """In another process, without the type checks of the tests."""
    process = subprocess.run([sys.executable, "-c", WRONG_TYPES], check=True, capture_output=True, text=True)
    assert process.stdout.splitlines() == [
        "TypeError observed is a str; admissible are real numbers",
        "ValueError problem has observed = None; admissible with it is cramer_rao alone",
        "TypeError noise is a str; admissible are real numbers",
        "ValueError time = None, but observed is an array: its sample times are needed",
        "TypeError key is an int; admissible is a JAX random key, as jax.random.key(0) makes it",
        "TypeError lidar is a Scene; admissible is one Lidar, or a sequence of one for each record",
        "TypeError scene 0 is a Lidar; admissible is a Scene",
        "TypeError unknowns is an Unknown; admissible is a sequence of Unknown",
        "TypeError unknowns[0] is a str; admissible is an Unknown",
        "TypeError starts is a str; admissible is an integer of at least 1",
        "ValueError starts = 1.5 is outside the admissible range [1, inf) of integers",
        "ValueError max_steps = nan is outside the admissible range [1, inf) of integers",
        "TypeError start is a list; admissible is a mapping from names of unknowns to values",
        "TypeError path is an int; admissible is a path, or None",
        "TypeError progress = 3 is no function",
        "ValueError key has shape (2,): several keys; admissible is one JAX random key",
        "TypeError start of 'ground.height' is a str; admissible are real numbers",
        "TypeError observed is a str; admissible are real numbers",
        "TypeError progress = 3 is no function",
        "TypeError unknowns is an Unknown; admissible is a sequence of Unknown",
        "TypeError max_steps is None; admissible is an integer of at least 1",
        "ValueError max_steps = nan is outside the admissible range [1, inf) of integers",
        "ValueError starts = 1.5 is outside the admissible range [1, inf) of integers",
        "TypeError unknowns is a list_iterator; admissible is a sequence of Unknown",
        "TypeError noise is None; admissible are real numbers",
        "TypeError lidar is None; admissible is a Lidar",
        "TypeError scene is a Lidar; admissible is a Scene",
        "TypeError plan is a str; admissible is a Plan",
        "TypeError key is None; admissible is a JAX random key, as jax.random.key(0) makes it",
        "TypeError key is an int; admissible is a JAX random key, as jax.random.key(0) makes it",
        "TypeError values is a str; admissible are real numbers",
        "TypeError profile_likelihood() got an unexpected keyword argument 'steps'",
        "ValueError max_steps = 0 is outside the admissible range [1, inf) of integers",
        "ValueError starts = 1.5 is outside the admissible range [1, inf) of integers",
        "ValueError scale = 2.0 is not a pair (low, high)",
        "TypeError progress = 3 is no function",
        "ValueError noise has the shape (2,), which does not broadcast to (1, 9)",
        "TypeError problem is an array of float64; admissible is an inversion.Problem",
        "TypeError an unknown: where = 3 is no path and no function",
        "TypeError unknown 'x': apply = 3 is no function",
    ]


@pytest.mark.parametrize("n_scenes", [1, 2])
def test_lidars_of_several_directions_share_a_plan(n_scenes):
    """A plan for the first beam alone, at nadir, would bias the others: a height of 0.19 m."""
    lidars = [jl.Lidar(zenith=zenith) for zenith in (0.0, 20.0, 10.0)]
    truth = jl.Scene(ground=jl.Ground(height=0.2, reflectance=0.35))
    start = jl.Scene(ground=jl.Ground(height=0.0, reflectance=0.5))
    waves = [jl.simulate(lidar, truth, key=jax.random.key(0), window=(-40.0, 40.0)) for lidar in lidars]
    observed = np.stack([wave.reflectance for wave in waves])
    arguments = observed, lidars, start if n_scenes == 1 else [start] * 3, UNKNOWNS
    options = {"noise": 1e-3, "time": waves[0].time}
    many = ask(inversion.retrieve_many, *arguments, **options, key=jax.random.key(1))
    np.testing.assert_allclose(many.values["height"], 0.2, atol=0.002)
    np.testing.assert_allclose(many.values["reflectance"].ravel(), 0.35, atol=0.002)
    plan = jl.plan(lidars[0], truth, window=(-40.0, 40.0), n_photons=1024)
    with pytest.raises(ValueError, match="the plan does not fit"):
        ask(inversion.retrieve_many, *arguments, **options, plan=plan, key=jax.random.key(1))
