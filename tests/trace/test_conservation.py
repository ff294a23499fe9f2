"""Conservation: the fractions of the emitted energy sum to one.

Absorption by a material is the light that arrives there minus the light that leaves; escaped light, light
after the record and light beyond the last order are counted where they occur. The sum is one to rounding for
each wavelength, unless a photon is lost or counted twice. Without absorbers the absorbed fraction is zero to
the noise of sampling reflection or transmission.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import one_batch, slow_unless

RANDOM = np.random.default_rng(2)
LEAF, BARK = RANDOM.uniform(0, 1, (4, 4, 6)), RANDOM.uniform(0, 0.2, (4, 4, 6))


def scene(leaf=(0.4, 0.3), bark=0.3, ground=0.5, sides="open", plate=None, **canopy):
    voxels = jl.VoxelMap.from_lad(
        LEAF,
        bark=BARK,
        voxel_size=1.0,
        origin=(-2.0, -2.0, 0.5),
        leaf_angles=canopy.pop("angles", "spherical"),
    )
    optics = jl.LeafOptics(reflectance=leaf[0], transmittance=leaf[1])
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=optics, bark=bark, sides=sides, **{"hotspot": False, **canopy}),
        plates=() if plate is None else (plate,),
        ground=None if ground is None else jl.Ground(reflectance=ground),
    )


PLATE = jl.Plate(height=0.3, reflectance=0.4, transmittance=0.5, coverage=0.6)
CASES = {
    "absorbing": (scene(), 0.0),
    "no ground": (scene(ground=None), 0.0),
    "periodic, off nadir": (scene(sides="periodic"), 25.0),
    "planophile leaves": (scene(angles="planophile"), 10.0),
    "plate": (scene(plate=PLATE), 0.0),
    "straight transmission": (scene(transmission="straight"), 0.0),
    "nothing absorbs": (scene(leaf=(0.6, 0.4), bark=1.0, ground=1.0, sides="periodic"), 0.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_energy_budget_sums_to_one(name):
    case_scene, zenith = CASES[name]
    lidar = jl.Lidar(wavelength=(532.0, 1064.0), zenith=zenith, divergence=2.0)
    wave = jl.simulate(lidar, case_scene, key=jax.random.key(4), n_photons=4096, max_orders=4, n_rays=512)
    total = sum(wave.energy_budget.values())
    assert np.allclose(total, 1.0, atol=1e-5)
    assert all(bool(jnp.all(share > -0.02)) for share in wave.energy_budget.values())
    if name == "nothing absorbs":
        absorbed = sum(v for k, v in wave.energy_budget.items() if k.startswith("absorbed"))
        assert np.allclose(absorbed, 0.0, atol=0.01)
        assert float(wave.energy_budget["unfollowed"][0]) > 0.1


@pytest.mark.parametrize("name", slow_unless(["plate"], ["absorbing", "plate"]))
def test_the_energy_budget_of_one_order_sums_to_one(name):
    case_scene, _ = CASES[name]
    wave = jl.simulate(
        jl.Lidar(divergence=2.0),
        case_scene,
        key=jax.random.key(0),
        max_orders=1,
        n_rays=512,
        footprint="fixed",
    )
    assert np.allclose(sum(wave.energy_budget.values()), 1.0, atol=1e-5)


@pytest.mark.slow
def test_small_deposits_on_large_sums():
    """300,000 photons in one batch: added to a sum one by one, single precision gains or loses 0.2 %."""
    lidar, crown = jl.Lidar(divergence=2.0), scene()
    plan = jl.plan(lidar, crown, max_orders=3, n_photons=2_400_000, n_rays=512)
    key = jax.random.key(0)
    setup = jl.make_setup(lidar, crown, plan)
    wave = one_batch(setup, key)
    np.testing.assert_allclose(sum(wave.energy_budget.values()), 1.0, atol=2e-4)


@pytest.mark.slow
def test_light_outside_the_record_is_all_counted():
    """A record far below the slab holds nothing: all returns of order one are outside of it."""
    lidar = jl.Lidar(divergence=2.0)
    outside = []
    for window in (None, (3900.0, 4000.0)):
        plan = jl.plan(lidar, scene(), max_orders=1, window=window, n_rays=512, footprint="fixed")
        setup = jl.make_setup(lidar, scene(), plan)
        response = jl.trace_scene(setup, jax.random.key(0))
        assert (float(response.first.sum()) == 0.0) == (window is not None)
        outside.append(np.asarray(response.first.sum(axis=-1) + response.first_outside))
    # All of what the canopy returns was in the outermost bins, of which a twelfth was lost.
    np.testing.assert_allclose(outside[1], outside[0], rtol=1e-5)


@pytest.mark.slow
def test_a_plate_behind_the_end_of_the_record_absorbs_nothing():
    """The record ends between two black plates that transmit: the lower one is not reached any more."""
    plates = (jl.Plate(5.0, 0.0, 0.5), jl.Plate(30.0, 0.0, 0.5))
    black = jl.Scene(plates=plates, ground=jl.Ground(reflectance=0.5))
    # Heights of 45 to 15 m; a second order, because photons carry the budget.
    window = tuple(-2.0 * z / jl.SPEED_OF_LIGHT for z in (45.0, 15.0))
    wave = jl.simulate(jl.Lidar(), black, key=jax.random.key(1), max_orders=2, n_photons=1024, window=window)
    budget = {name: float(value[0]) for name, value in wave.energy_budget.items()}
    assert budget["absorbed by plate 2"] == pytest.approx(0.5, abs=0.05)
    assert budget["absorbed by plate 1"] == 0.0
    assert budget["after the window"] == pytest.approx(0.5, abs=0.05)
