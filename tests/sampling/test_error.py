"""Coverage of the reported standard errors over many seeds, each simulation stopped at its tolerance."""

import jax
import numpy as np
import pytest
import scipy.stats

import jaxlidar as jl
from jaxlidar.sampling.errors import student_widening
from tests.helpers import slab

LIDAR = jl.Lidar(wavelength=1064.0)
SEEDS = 200


def clumps():
    lad = np.where(np.random.default_rng(0).random((12, 12, 10)) < 0.3, 1.5, 0.0)
    return jl.VoxelMap.from_lad(lad, voxel_size=(1.0, 1.0, 1.0), origin=(-6.0, -6.0, 1.0))


LEAF = jl.LeafOptics(reflectance=0.45, transmittance=0.4)
PLATE = jl.Plate(height=3.0, reflectance=0.4, transmittance=0.3, coverage=0.5, transmission="diffuse")
GROUND = jl.Ground(reflectance=0.4)
# Scenes and tolerances; the first needs about eight batches, the others more.
CASES = {
    "plate, eight batches": (jl.Scene(plates=(PLATE,), ground=GROUND), 0.08),
    "plate, few batches": (jl.Scene(plates=(PLATE,), ground=GROUND), 0.04),
    "plate": (jl.Scene(plates=(PLATE,), ground=GROUND), 0.01),
    "stand": (
        jl.Scene(canopy=jl.Canopy(slab(2.0), leaf=LEAF, sides="periodic", hotspot=False), ground=GROUND),
        0.03,
    ),
    "clumps": (jl.Scene(canopy=jl.Canopy(clumps(), leaf=LEAF, hotspot=False), ground=GROUND), 0.03),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_truth_lies_within_two_reported_errors(case):
    scene, rtol = CASES[case]
    plan = jl.plan(LIDAR, scene, max_orders=4, n_photons=8192, n_rays=256, window=(-80.0, 60.0))
    reference = jl.simulate(LIDAR, scene, key=jax.random.key(10**6), plan=plan, rtol=rtol / 10)
    truth = np.asarray(reference.reflectance, float)
    bright = truth > 0.01 * truth.max()
    inside, inside_unwidened, batches = [], [], []
    for seed in range(SEEDS):
        wave = jl.simulate(LIDAR, scene, key=jax.random.key(seed), plan=plan, rtol=rtol)
        error, difference = (
            np.asarray(wave.stderr, float),
            np.abs(np.asarray(wave.reflectance, float) - truth),
        )
        # Samples of the deterministic first order have only rounding errors.
        has_noise = bright & (error > 1e-5 * truth)
        inside.append(np.mean((difference < 2 * error)[has_noise]))
        inside_unwidened.append(
            np.mean((difference < 2 * error / student_widening(wave.info["batches"]))[has_noise])
        )
        batches.append(wave.info["batches"])
        assert wave.info["error"] <= rtol
    assert 0.93 <= np.mean(inside) <= 0.975
    if case == "plate, eight batches":
        # Eight is the least number. Without the widening of Student's distribution, errors would cover too
        # little.
        assert max(batches) == 8
        assert np.mean(inside_unwidened) < 0.93


@pytest.mark.parametrize("batches", [8, 9, 16, 64, 1000])
def test_widening_is_students(batches):
    exact = scipy.stats.t.ppf(scipy.stats.norm.cdf(2.0), batches - 1) / 2.0
    assert student_widening(batches) == pytest.approx(exact, rel=1e-3)
