"""Unknowns by their path: found in a scene or refused with the nearest names, and sent to other processes."""

import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import LogNormal, Unknown
from inversion.fit.unknowns import settle

SCENE = jl.Scene(
    canopy=jl.Canopy(jl.VoxelMap.from_lad(np.ones((1, 1, 2)), voxel_size=1.0), leaf=jl.Prospect()),
    plates=(jl.Plate(height=5.0, reflectance=0.3), jl.Plate(height=6.0, reflectance=0.3)),
    ground=jl.Ground(height=0.1, reflectance=0.3),
)
PLACES = {
    "ground.height": lambda s: s.ground.height,
    "canopy.leaf.Cab": lambda s: s.canopy.leaf.Cab,
    "canopy.voxels.leaf": lambda s: s.canopy.voxels.leaf,
    "plates[0].height": lambda s: s.plates[0].height,
    "plates[1].height": lambda s: s.plates[1].height,
}


@pytest.mark.parametrize("path", PLACES)
def test_a_path_is_the_function_that_picks(path):
    (by_path,) = settle([Unknown(path, bounds=(-1000.0, 1000.0))], SCENE)
    (by_function,) = settle([Unknown(PLACES[path], bounds=(-1000.0, 1000.0))], SCENE)
    assert by_path.name == by_function.name == path
    assert by_path.place == by_function.place
    np.testing.assert_array_equal(by_path.start, by_function.start)
    (named,) = settle([Unknown(path, bounds=(-1000.0, 1000.0), name="x")], SCENE)
    assert named.name == "x"


@pytest.mark.parametrize(
    ("path", "nearest"),
    [
        ("ground.hight", "ground.height"),
        ("canopy.leaf.cab", "canopy.leaf.Cab"),
        ("plates.height", r"plates\[.\].height"),
        ("plates[2].height", r"plates\[.\].height"),
        ("plates[-1].height", r"plates\[.\].height"),
        ("ground", r"ground\.\w+"),
        ("canopy.transmission", r"canopy\.\w+"),
        ("ground.height.real", "ground.height"),
        (" ground.height", "ground.height"),
        ("", r"\w+"),
    ],
)
def test_a_path_that_is_not_there_is_refused_with_the_nearest(path, nearest):
    said = rf"where = '.*' is no array of this scene; the nearest are '{nearest}"
    with pytest.raises(ValueError, match=said):
        settle([Unknown(path, bounds=(0.0, 1.0))], SCENE)


def unknowns():
    return [
        Unknown("ground.height", bounds=(-2.0, 2.0), prior=(0.0, 1.0), start=0.0),
        Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness", prior=LogNormal(0.3, 0.5)),
    ]


def test_unknowns_can_be_pickled():
    back = pickle.loads(pickle.dumps(unknowns()))
    for got, sent in zip(back, unknowns(), strict=True):
        assert (got.where, got.name) == (sent.where, sent.name)
        assert jax.tree.structure(got) == jax.tree.structure(sent)
        assert jax.tree.all(jax.tree.map(np.array_equal, got, sent))
    by_lambda = Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0))
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(by_lambda)


def retrieve(observed, sought):
    scene = jl.Scene(ground=jl.Ground(height=0.0, reflectance=0.5))
    return inversion.retrieve(observed, jl.Lidar(), scene, sought, noise=1e-3, key=jax.random.key(1))


@pytest.mark.slow
def test_a_spawned_process_retrieves_what_this_one_does():
    """Problem and result are both sent; forked after JAX was used, the process would wait for ever."""
    scene = jl.Scene(ground=jl.Ground(height=0.1, reflectance=0.3))
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(retrieve, wave, unknowns()).result(timeout=300)
    here = retrieve(wave, unknowns())
    assert there.status == here.status
    for name, value in here.values.items():
        np.testing.assert_array_equal(there.values[name], value)
    assert float(there.values["ground.height"]) == pytest.approx(0.1, abs=0.01)
