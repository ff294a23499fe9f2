"""Many fits at once: the same as one at a time, each on its own, and resumed where they were interrupted."""

import dataclasses

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Unknown

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


def fit(footprints, lidar=LIDAR, scene=START, **more):
    observed, noise, time = footprints
    given = {"noise": noise, "time": time, "key": jax.random.key(1), "lanes": 6, **more}
    return inversion.retrieve_many(observed, lidar, scene, UNKNOWNS, **given)


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
    path = tmp_path / "fits.npz"
    whole = fit(footprints)

    def stop(progress):
        if progress.done == 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(footprints, path=path, progress=stop)
    seen = []
    resumed = fit(footprints, path=path, progress=seen.append)
    assert len(seen) <= COUNT - 8
    assert np.array_equal(resumed.values["height"], whole.values["height"])
    assert resumed.status == whole.status
    # Nothing is left to do, and nothing else may be put there.
    assert np.array_equal(fit(footprints, path=path, progress=stop).covariance, whole.covariance)
    observed, noise, time = footprints
    with pytest.raises(ValueError, match="keeps fits of other footprints"):
        fit((observed + 0.1, noise, time), path=path)
    path.write_bytes(b"not fits")
    with pytest.raises(ValueError, match=r"fits\.npz is damaged"):
        fit(footprints, path=path)


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
    for name in ("lanes", "starts"):
        with pytest.raises(ValueError, match=f"{name} = 0 is outside"):
            fit(footprints, **{name: 0})
