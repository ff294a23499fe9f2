r"""First order from a homogeneous slab over ground, against the closed form, bin by bin.

Layout: a slab of vertical optical depth tau and thickness H on ground of reflectance rho, a narrow beam at
the zenith angle theta, mu = cos(theta). With kappa = 2 (independent ways out and in), or 1 with the hot spot,
the light from path lengths up to s in the slab carries

    sum over materials m of  f_m rho_m (tau_m / tau) (1 - exp(-kappa tau s / H)) / kappa,    0 <= s <= H / mu,
    ground  rho mu exp(-kappa tau / mu),

f_m the intensity factor of backscatter: 2/3 for spherically oriented facets (Ross's R/3 per leaf area, of
which the extinction coefficient is half), 1/4 for isotropic scattering, <(n.w)^2> / G(w) for any leaf angles.
Where leaves transmit straight on, tau_leaf is scaled by 1 - T and R by 1 / (1 - T).

Tolerance: the integrals are exact in every bin; rounding and the tables of G leave less than 1e-4.
"""

import jax
import numpy as np
import pytest
from scipy.integrate import quad

import jaxlidar as jl
from jaxlidar import SPEED_OF_LIGHT
from tests.helpers import first_wave, slab

KEY = jax.random.key(22)
THICKNESS, RHO = 10.0, 0.45
LEAF = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
INSTANT_PENCIL = {"pulse": jl.RectangularPulse(length=0.0), "divergence": 0.0, "altitude": 4e5}
FIRST_ORDER = {"max_orders": 1, "footprint": "fixed", "n_rays": 64}

# name: optical depths of leaf and bark, keywords of the canopy, intensity factor times reflectance of both.
CASES = {
    "leaf": (1.2, None, {"leaf": LEAF}, (0.4 * 2 / 3, 0.0)),
    "isotropic": (1.2, None, {"leaf": jl.Isotropic(0.8)}, (0.8 / 4, 0.0)),
    "bark": (None, 0.7, {"bark": 0.5}, (0.0, 0.5 * 2 / 3)),
    "isotropic bark": (None, 0.7, {"bark": jl.Isotropic(0.5)}, (0.0, 0.5 / 4)),
    "leaf and bark": (0.9, 0.5, {"leaf": LEAF, "bark": 0.5}, (0.4 * 2 / 3, 0.5 * 2 / 3)),
    "straight": (0.9, 0.5, {"leaf": LEAF, "bark": 0.5, "transmission": "straight"}, (0.0, 0.0)),
}


def expected(case, kappa, mu, path):
    """Return the cumulative reflectance of leaf and of bark down to `path`, and that of the ground."""
    leaf, bark, canopy, (leaf_factor, bark_factor) = CASES[case]
    leaf, bark = leaf or 0.0, bark or 0.0
    if canopy.get("transmission") == "straight":
        leaf, leaf_factor, bark_factor = leaf * 0.7, 0.4 / 0.7 * 2 / 3, 0.5 * 2 / 3
    depth = leaf + bark
    depth_fraction = np.clip(path, 0.0, THICKNESS / mu) / THICKNESS
    decay = -np.expm1(-kappa * depth * depth_fraction) / (kappa * depth)
    return leaf_factor * leaf * decay, bark_factor * bark * decay, RHO * mu * np.exp(-kappa * depth / mu)


@pytest.mark.parametrize(
    ("case", "zenith", "hotspot"),
    [
        pytest.param("leaf", 0.0, False, marks=pytest.mark.slow),
        ("isotropic", 0.0, True),
        pytest.param("bark", 0.0, False, marks=pytest.mark.slow),
        ("isotropic bark", 0.0, True),
        ("leaf and bark", 30.0, False),
        pytest.param("leaf and bark", 30.0, True, marks=pytest.mark.slow),
        pytest.param("straight", 0.0, False, marks=pytest.mark.slow),
        pytest.param("straight", 30.0, True, marks=pytest.mark.slow),
    ],
)
def test_cumulative_profile(case, zenith, hotspot):
    leaf, bark, canopy, _ = CASES[case]
    voxels = slab(leaf, bark, thickness=THICKNESS)
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, hotspot=hotspot, sides="periodic", **canopy),
        ground=jl.Ground(reflectance=RHO),
    )
    lidar = jl.Lidar(zenith=zenith, azimuth=35.0, **INSTANT_PENCIL)
    wave = first_wave(lidar, scene, jl.plan(lidar, scene, bin_width=0.1, **FIRST_ORDER))
    mu, kappa = np.cos(np.deg2rad(zenith)), 1.0 if hotspot else 2.0
    edges = np.asarray(wave.time, float) + 0.5
    path = THICKNESS / mu + 0.5 * SPEED_OF_LIGHT * edges
    in_leaf, in_bark, ground = expected(case, kappa, mu, path)
    total = in_leaf[-1] + in_bark[-1] + ground
    materials = {name for name, depth in (("leaf", leaf), ("bark", bark)) if depth is not None}
    assert set(wave.components) == {*materials, "ground", "first", "higher"}
    for name in materials:
        profile = np.cumsum(np.asarray(wave.components[name][0], float))
        exact_profile = {"leaf": in_leaf, "bark": in_bark}[name]
        # Bins are smooth over 0.15 ns: edges that lie so near the ends of the slab are left out.
        clear = (np.abs(path) > 0.05) & (np.abs(path - THICKNESS / mu) > 0.05)
        np.testing.assert_allclose(profile[clear], exact_profile[clear], atol=1e-4 * total)
    np.testing.assert_allclose(wave.components["ground"].sum(), ground, rtol=1e-4)
    np.testing.assert_allclose(wave.reflectance.sum(), total, rtol=1e-4)
    # The same test rejects the other assumption on the hot spot.
    *profiles, other_ground = expected(case, 3.0 - kappa, mu, path)
    other_total = sum(profile[-1] for profile in profiles) + other_ground
    assert abs(float(wave.reflectance.sum()) - other_total) > 0.01 * total


@pytest.fixture(scope="module")
def reference():
    return first_order((1, 1, 1))


def first_order(shape, **changes):
    """Return the waveform of a slab divided into voxels, by a beam 2 m wide and a pulse of 3 ns."""
    lidar = jl.Lidar(zenith=20.0, azimuth=70.0, divergence=2.0, pulse=jl.GaussianPulse(fwhm=3.0))
    canopy = jl.Canopy(slab(0.9, 0.5, shape=shape), leaf=LEAF, bark=0.5, sides="periodic", hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=RHO, slope=15.0))
    return first_wave(lidar, scene, jl.plan(lidar, scene, window=(-110.0, 30.0), **(FIRST_ORDER | changes)))


@pytest.mark.parametrize(
    ("shape", "changes"),
    [
        ((1, 1, 1), {"max_step": 1.3}),
        ((40, 31, 7), {}),
        pytest.param((2, 3, 20), {"bin_width": 0.05}, marks=pytest.mark.slow),
    ],
)
def test_steps_voxels_and_fine_bins_do_not_change_the_waveform(reference, shape, changes):
    wave = first_order(shape, **changes)
    peak = float(reference.reflectance.max())
    np.testing.assert_allclose(wave.reflectance, reference.reflectance, atol=1e-4 * peak)
    np.testing.assert_allclose(wave.reflectance.sum(), reference.reflectance.sum(), rtol=1e-4)


def test_the_first_order_is_not_random(reference):
    lidar = jl.Lidar(**INSTANT_PENCIL)
    scene = jl.Scene(canopy=jl.Canopy(slab(1.0), leaf=LEAF, hotspot=False))
    plan = jl.plan(lidar, scene, **FIRST_ORDER)
    assert not plan.is_random
    a, b = (jl.simulate(lidar, scene, key=jax.random.key(seed), plan=plan) for seed in (1, 2))
    np.testing.assert_array_equal(a.reflectance, b.reflectance)
    np.testing.assert_array_equal(a.stderr, 0.0)
    assert a.info["photons"] == 0


# de Wit's densities of leaf inclination; Beta with the moments of Goel and Strebel.
DENSITIES = {
    "spherical": np.sin,
    "planophile": lambda t: 2 / np.pi * (1 + np.cos(2 * t)),
    "erectophile": lambda t: 2 / np.pi * (1 - np.cos(2 * t)),
    "plagiophile": lambda t: 2 / np.pi * (1 - np.cos(4 * t)),
    "extremophile": lambda t: 2 / np.pi * (1 + np.cos(4 * t)),
    "uniform": lambda t: 2 / np.pi + 0.0 * t,
}


def mean_cosines(density, theta):
    """Return G(theta), the mean of |n . w|, and the mean of (n . w)^2, by quadrature over leaf inclination.

    For a leaf inclined by t, n . w = a + b cos(phi) with a = cos(theta) cos(t), b = sin(theta) sin(t), and
    the azimuth phi is uniform. If a < b the sign changes at phi = arccos(-a / b).
    """

    def over_azimuth(t):
        a, b = np.cos(theta) * np.cos(t), np.sin(theta) * np.sin(t)
        if a >= b:
            return a
        half_turn = np.arccos(-a / b)
        return (a * (2 * half_turn - np.pi) + 2 * b * np.sin(half_turn)) / np.pi

    kink = [np.pi / 2 - theta]
    first, _ = quad(lambda t: density(t) * over_azimuth(t), 0, np.pi / 2, points=kink, epsabs=1e-9)
    square, _ = quad(
        lambda t: density(t) * ((np.cos(theta) * np.cos(t)) ** 2 + 0.5 * (np.sin(theta) * np.sin(t)) ** 2),
        0,
        np.pi / 2,
    )
    return first, square


@pytest.fixture(scope="module")
def angle_plan():
    """One plan for all distributions of leaf angles and zenith angles up to 57.3 degrees."""
    lidar = jl.Lidar(zenith=57.3, azimuth=10.0, **INSTANT_PENCIL)
    return jl.plan(
        lidar, jl.Scene(canopy=canopy_of("uniform"), ground=jl.Ground(reflectance=RHO)), **FIRST_ORDER
    )


def canopy_of(name):
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), 0.15),
        voxel_size=(40.0, 40.0, 2.5),
        origin=(-20, -20, 0),
        leaf_angles=jl.LeafAngles.named(name),
    )
    return jl.Canopy(voxels, leaf=LEAF, sides="periodic", hotspot=False)


LEAF_AREA_INDEX = 1.5


def first_order_by_angles(name, theta):
    """Return the first order of the ground and of leaves with a distribution of inclinations.

    With the optical depth tau = G L / cos(theta), the ground returns rho cos(theta) exp(-2 tau) and the
    leaves R <(n . w)^2> / G (1 - exp(-2 tau)) / 2.
    """
    projection, square = mean_cosines(DENSITIES[name], theta)
    depth = projection * LEAF_AREA_INDEX / np.cos(theta)
    return np.array(
        [RHO * np.cos(theta) * np.exp(-2 * depth), 0.4 * square / projection * -np.expm1(-2 * depth) / 2]
    )


@pytest.mark.parametrize("zenith", [0.0, 30.0, 57.3])
@pytest.mark.parametrize("name", DENSITIES)
def test_leaf_angles_set_extinction_and_backscatter(angle_plan, name, zenith):
    """The ground gives G, the leaves the mean squared cosine; no other distribution has both of them."""
    scene = jl.Scene(canopy=canopy_of(name), ground=jl.Ground(reflectance=RHO))
    wave = first_wave(jl.Lidar(zenith=zenith, azimuth=10.0, **INSTANT_PENCIL), scene, angle_plan)
    theta = np.deg2rad(zenith)
    returned = np.array([float(wave.components[material].sum()) for material in ("ground", "leaf")])
    np.testing.assert_allclose(returned, first_order_by_angles(name, theta), rtol=1e-4)
    # About 57 degrees all distributions have nearly the same G, so that only both returns together tell them.
    for wrong in set(DENSITIES) - {name}:
        assert np.max(np.abs(returned / first_order_by_angles(wrong, theta) - 1)) > 0.01, wrong


def test_spherical_leaves_need_no_table():
    assert jl.VoxelMap.from_lad(np.ones((1, 1, 1)), voxel_size=1.0).leaf_angles is None


def test_beta_distributions_have_the_given_moments():
    """Mean and standard deviation in degrees, to the midpoint rule over cells of one degree."""
    angles = jl.LeafAngles.beta(57.0, 20.0)
    middle = np.arange(90) + 0.5
    p = np.asarray(angles.normalised(), float)
    assert p @ middle == pytest.approx(57.0, abs=0.05)
    assert np.sqrt(p @ (middle - p @ middle) ** 2) == pytest.approx(20.0, abs=0.1)
