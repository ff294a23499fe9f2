"""Canopies below, in and far above their terrain."""

import warnings

import jax
import numpy as np
import pytest

import jaxlidar as jl

LEAF = jl.LeafOptics(0.4, 0.4)


def canopy(z=0.0, layers=10, **arguments):
    """Return a canopy of 4 x 4 m with layers of 1 m, whose lowest one begins at the height z, m."""
    lad = np.ones((4, 4, layers))
    return jl.Canopy(jl.VoxelMap.from_lad(lad, voxel_size=1.0, origin=(0.0, 0.0, z)), leaf=LEAF, **arguments)


def level(height, nodes=5):
    return jl.Terrain(np.full((nodes, nodes), float(height)), spacing=1.0)


@pytest.mark.parametrize("height", [400.0, 10.0])
def test_a_canopy_below_its_terrain_is_refused(height):
    top = f"its top {height - 10:.3g} m deep"
    with pytest.raises(ValueError, match=rf"below the terrain, {top}.*VoxelMap.above\(terrain\)"):
        jl.Scene(canopy=canopy(), ground=level(height))


@pytest.mark.parametrize(("height", "percentage"), [(9.9, 90), (4.0, 40), (1.6, 10)])
def test_plants_below_the_terrain_are_reported(height, percentage):
    with pytest.warns(jl.MisplacedCanopyWarning, match=rf"{percentage} % .* up to {height:g} m deep"):
        jl.Scene(canopy=canopy(), ground=level(height))


def test_a_canopy_that_hangs_in_the_air_is_reported():
    with pytest.warns(jl.MisplacedCanopyWarning, match=r"lowest plants are 400 m above the terrain"):
        jl.Scene(canopy=canopy(z=400.5), ground=level(0.5))


def test_canopies_that_stand_on_their_terrain_are_accepted():
    slope = jl.Terrain(np.linspace(0.0, 5.0, 5)[:, None] * np.ones(5), spacing=1.0)
    flat_map = canopy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jl.Scene(canopy=canopy(), ground=level(0.0))
        jl.Scene(canopy=canopy(), ground=level(0.6))
        jl.Scene(canopy=canopy(z=5.0), ground=level(0.0))
        lifted = jl.Canopy(flat_map.voxels.above(slope), leaf=LEAF, hotspot=False)
        jl.Scene(canopy=lifted, ground=slope)
        # Neither columns beside the terrain nor what a transformation traces is checked.
        jl.Scene(canopy=canopy(z=500.0), ground=level(0.0).moved(np.array([50.0, 50.0])))
        jax.vmap(lambda h: jl.Scene(canopy=canopy(), ground=jl.Terrain(h, spacing=1.0)).ground.heights)(
            np.full((2, 5, 5), 400.0)
        )
    # The same map, not lifted, is reported.
    with pytest.warns(jl.MisplacedCanopyWarning, match="of the plants lie below"):
        jl.Scene(canopy=flat_map, ground=slope)


def test_a_scene_is_made_where_other_parts_are_traced():
    trees, ground, buried = canopy(), level(0.0), level(400.0)

    @jax.jit
    def height_of_plate(height):
        return jl.Scene(canopy=trees, ground=ground, plates=(jl.Plate(height, 0.3),)).plates[0].height

    assert float(height_of_plate(20.0)) == 20.0
    # What is not traced is checked all the same.
    with pytest.raises(ValueError, match="below the terrain"):
        jax.jit(lambda height: jl.Scene(canopy=trees, ground=buried).ground.spacing + height)(20.0)


def test_the_warning_points_at_the_caller():
    with pytest.warns(jl.MisplacedCanopyWarning) as caught:
        jl.Scene(canopy=canopy(), ground=level(4.0))
    assert caught[0].filename == __file__
