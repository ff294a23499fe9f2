"""Unknowns by path: located in a scene or refused with the nearest paths, and sent to other processes."""

import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import LogNormal, Unknown
from inversion.fit.unknowns import bind_unknowns
from tests.helpers import ask
from tests.quick_compilation import optimise_programs

SCENE = jl.Scene(
    canopy=jl.Canopy(
        jl.VoxelMap.from_lad(np.ones((1, 1, 2)), voxel_size=1.0), leaf=jl.Prospect(), hotspot=False
    ),
    plates=(jl.Plate(height=5.0, reflectance=0.3), jl.Plate(height=6.0, reflectance=0.3)),
    ground=jl.Ground(height=0.1, reflectance=0.3),
)
SELECTORS = {
    "ground.height": lambda s: s.ground.height,
    "canopy.leaf.Cab": lambda s: s.canopy.leaf.Cab,
    "canopy.voxels.leaf": lambda s: s.canopy.voxels.leaf,
    "plates[0].height": lambda s: s.plates[0].height,
    "plates[1].height": lambda s: s.plates[1].height,
}


@pytest.mark.parametrize("path", SELECTORS)
def test_a_path_picks_the_array_that_a_function_picks(path):
    (by_path,) = bind_unknowns([Unknown(path, bounds=(-1000.0, 1000.0))], SCENE)
    (by_function,) = bind_unknowns([Unknown(SELECTORS[path], bounds=(-1000.0, 1000.0))], SCENE)
    assert by_path.name == by_function.name == path
    assert by_path.setter == by_function.setter
    np.testing.assert_array_equal(by_path.start, by_function.start)
    (named,) = bind_unknowns([Unknown(path, bounds=(-1000.0, 1000.0), name="x")], SCENE)
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
def test_a_path_of_no_array_is_refused_with_the_nearest(path, nearest):
    message = rf"where = '.*' is no array of this scene; the nearest are '{nearest}"
    with pytest.raises(ValueError, match=message):
        bind_unknowns([Unknown(path, bounds=(0.0, 1.0))], SCENE)


def unknowns():
    return [
        Unknown("ground.height", bounds=(-2.0, 2.0), prior=(0.0, 1.0), start=0.0),
        Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness", prior=LogNormal(0.3, 0.5)),
    ]


def test_unknowns_can_be_pickled():
    copies = pickle.loads(pickle.dumps(unknowns()))
    for copy, original in zip(copies, unknowns(), strict=True):
        assert (copy.where, copy.name) == (original.where, original.name)
        assert jax.tree.structure(copy) == jax.tree.structure(original)
        assert jax.tree.all(jax.tree.map(np.array_equal, copy, original))
    by_lambda = Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0))
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(by_lambda)


def retrieve(observed, unknowns):
    scene = jl.Scene(ground=jl.Ground(height=0.0, reflectance=0.5))
    return ask(inversion.retrieve, observed, jl.Lidar(), scene, unknowns, noise=1e-3, key=jax.random.key(1))


@pytest.mark.slow
def test_a_spawned_process_gives_the_same_retrieval():
    """Problem and result are both sent. Spawned, as a process forked after JAX was used may wait for ever."""
    scene = jl.Scene(ground=jl.Ground(height=0.1, reflectance=0.3))
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), optimise_programs) as pool:
        from_worker = pool.submit(retrieve, wave, unknowns()).result(timeout=300)
    from_this_process = retrieve(wave, unknowns())
    assert from_worker.status == from_this_process.status
    for name, value in from_this_process.values.items():
        np.testing.assert_array_equal(from_worker.values[name], value)
    assert float(from_worker.values["ground.height"]) == pytest.approx(0.1, abs=0.01)
