"""Arguments become arrays by one function, which refuses what is no number.

NumPy's `asarray` drops the mask of an array, and takes booleans and times for numbers.
"""

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from jaxlidar._fields.checks import as_array, as_numpy, check_integer, check_range, concrete

MASKED = np.ma.array([1.0, 2.0], mask=[False, True])


@pytest.mark.parametrize(
    "wrong",
    [
        *(True, np.True_, np.ones(2, bool), [1.0, False], jax.numpy.ones(2, bool)),
        *(np.timedelta64(1, "s"), np.ones(2, "m8[ns]"), np.ones(2, "M8[s]"), np.ones(2, object), 1j),
        *(MASKED, [1.0, np.ma.masked], [MASKED[1], 3.0], (MASKED, [3.0, 4.0])),
    ],
)
def test_what_is_no_number_is_refused(wrong):
    for convert in (as_array, as_numpy):
        with pytest.raises(TypeError, match=r"x is .*; admissible are real numbers"):
            convert(wrong, "x")
    with pytest.raises(TypeError, match="x is "):
        check_integer("x", wrong)
    with pytest.raises(TypeError, match="x is "):
        check_range("x", wrong, 0.0)
    assert concrete(wrong) is None


def test_an_array_without_masked_elements_is_an_array():
    whole = np.ma.array([1.0, 2.0], mask=[False, False])
    for convert in (as_array, as_numpy):
        assert convert(whole, "x").tolist() == [1.0, 2.0]


def test_a_masked_node_of_a_terrain_is_refused():
    """It was taken for the number below the mask: a reflectance of 0.157 in place of 0.300."""
    heights = np.ma.masked_equal(np.where(np.eye(3) > 0, -9999.0, 0.0), -9999.0)
    with pytest.raises(TypeError, match="heights is an array with masked elements"):
        jl.Terrain(heights, spacing=1.0)


@pytest.mark.slow
def test_types_are_promoted_by_the_package_itself():
    """Within strict promotion: periods of canopies, and what retrievals trace."""
    voxels = jl.VoxelMap.from_lad(np.full((2, 2, 3), 0.4), voxel_size=1.0)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), sides="periodic")
    with jax.numpy_dtype_promotion("strict"):
        scene = jl.Scene(canopy=canopy, ground=jl.Ground())
        wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), max_orders=1, rtol=0.1)
        assert wave.reflectance.sum() > 0
        wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground(height=0.5)), key=jax.random.key(0))
        height = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
        start = jl.Scene(ground=jl.Ground())
        problem = inversion.Problem(wave.reflectance, jl.Lidar(), start, [height], noise=1e-3, time=wave.time)
        fit = inversion.retrieve(problem, key=jax.random.key(0))
        assert float(fit.values["height"]) == pytest.approx(0.5, abs=0.01)
        # A plan that is compared with a canopy with open sides, whose heights a transformation traces.
        canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4))
        wood = jl.Scene(canopy=canopy, ground=jl.Ground())
        problem = inversion.Problem(None, jl.Lidar(), wood, [height], noise=1e-3, max_orders=1, n_rays=8)
        assert float(inversion.cramer_rao(problem, key=jax.random.key(0)).stderr["height"]) > 0
