"""What a plan of a survey says of the simulation before it runs."""

import jax
import numpy as np

import jaxlidar as jl
from jaxlidar._jax.memory import format_bytes

VOXELS = jl.VoxelMap.from_lad(np.full((12, 12, 3), 0.5), voxel_size=1.0)
SCENE = jl.Scene(canopy=jl.Canopy(VOXELS, leaf=jl.LeafOptics(0.4, 0.4), bark=None), ground=jl.Ground())


LIDAR = jl.Lidar(altitude=4e4, divergence=0.1, wavelength=(532.0, 1064.0))
# Footprints that overlap, and two of different directions.
GRID = jl.Survey.grid(LIDAR, low=(4.0, 4.0), high=(8.0, 8.0), spacing=2.0)
TWO = jl.Survey(LIDAR, [(5.0, 5.0), (6.0, 6.0)], zenith=[0.0, 5.0])


def test_a_plan_says_how_a_survey_is_traced():
    shared = str(jl.plan(GRID, SCENE, rtol=0.2))
    assert "simulate_many: 9 shots; their light is shared, on " in shared
    apart = str(jl.plan(TWO, SCENE, rtol=0.2))
    assert "2 shots; each is traced apart, in eight batches or more of " in apart
    assert "light is not shared: shots have more than one direction" in apart
    assert "one order (max_orders=1) takes rays alone" in apart
    first_order = str(jl.plan(TWO, SCENE, rtol=0.2, max_orders=1))
    assert "photons" not in first_order
    assert "simulate_many" not in str(jl.plan(GRID.middle, SCENE, rtol=0.2))


def test_the_size_of_results_is_that_of_the_simulation():
    many = jl.simulate_many(GRID, SCENE, key=jax.random.key(0), rtol=0.2, max_orders=1)
    arrays = (many.reflectance, many.stderr, many.energy, many.recorded, *many.components.values())
    n_bytes = sum(np.asarray(a).nbytes for a in arrays)
    lines = str(jl.plan(GRID, SCENE, rtol=0.2, max_orders=1)).splitlines()
    assert f"about {format_bytes(n_bytes / 9)} a shot, {format_bytes(n_bytes)} for all" in lines[-1]
