r"""First order from a homogeneous slab over ground, against the closed form, bin by bin.

Layout: a slab of vertical optical depth tau and thickness H on ground of reflectance rho, a narrow beam at
the zenith angle theta, mu = cos(theta). With kappa = 2 (independent ways out and in), or 1 with the hot spot,
light from down to the path s carries

    sum over materials m of  f_m rho_m (tau_m / tau) (1 - exp(-kappa tau s / H)) / kappa,    0 <= s <= H / mu,
    ground  rho mu exp(-kappa tau / mu),

f_m the view factor of backscatter: 2/3 for spherically oriented facets (Ross's R/3 per leaf area, of which
the extinction coefficient is half), 1/4 for isotropic scattering, <(n.w)^2> / G(w) for any leaf angles. Where
leaves transmit straight on, tau_leaf is scaled by 1 - T and R by 1 / (1 - T).

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
SHORT = {"pulse": jl.RectangularPulse(length=0.0), "divergence": 0.0, "altitude": 4e5}
FIRST = {"max_orders": 1, "footprint": "fixed", "n_rays": 64}

# name: optical depths of leaf and bark, the keywords of the canopy, view factor times reflectance of both.
CASES = {
    "leaf": (1.2, None, {"leaf": LEAF}, (0.4 * 2 / 3, 0.0)),
    "isotropic": (1.2, None, {"leaf": jl.Isotropic(0.8)}, (0.8 / 4, 0.0)),
    "bark": (None, 0.7, {"bark": 0.5}, (0.0, 0.5 * 2 / 3)),
    "isotropic bark": (None, 0.7, {"bark": jl.Isotropic(0.5)}, (0.0, 0.5 / 4)),
    "leaf and bark": (0.9, 0.5, {"leaf": LEAF, "bark": 0.5}, (0.4 * 2 / 3, 0.5 * 2 / 3)),
    "straight": (0.9, 0.5, {"leaf": LEAF, "bark": 0.5, "transmission": "straight"}, (0.0, 0.0)),
}


def expected(case, kappa, mu, path):
    """Cumulative reflectance of leaf and of bark down to `path`, and of the ground."""
    leaf, bark, canopy, (leaf_factor, bark_factor) = CASES[case]
    leaf, bark = leaf or 0.0, bark or 0.0
    if canopy.get("transmission") == "straight":
        leaf, leaf_factor, bark_factor = leaf * 0.7, 0.4 / 0.7 * 2 / 3, 0.5 * 2 / 3
    depth = leaf + bark
    inside = np.clip(path, 0.0, THICKNESS / mu) / THICKNESS
    decay = -np.expm1(-kappa * depth * inside) / (kappa * depth)
    return leaf_factor * leaf * decay, bark_factor * bark * decay, RHO * mu * np.exp(-kappa * depth / mu)


@pytest.mark.parametrize(
    ("case", "zenith", "hotspot"),
    [
        ("leaf", 0.0, False),
        ("isotropic", 0.0, True),
        ("bark", 0.0, False),
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
    lidar = jl.Lidar(zenith=zenith, azimuth=35.0, **SHORT)
    wave = first_wave(lidar, scene, jl.plan(lidar, scene, bin_width=0.1, **FIRST))
    mu, kappa = np.cos(np.deg2rad(zenith)), 1.0 if hotspot else 2.0
    edges = np.asarray(wave.time, float) + 0.5
    path = THICKNESS / mu + 0.5 * SPEED_OF_LIGHT * edges
    in_leaf, in_bark, ground = expected(case, kappa, mu, path)
    total = in_leaf[-1] + in_bark[-1] + ground
    for name, sought in (("leaf", in_leaf), ("bark", in_bark)):
        if name in wave.components:
            found = np.cumsum(np.asarray(wave.components[name][0], float))
            # Bins are smooth over 0.15 ns: edges that lie so near the ends of the slab are left out.
            clear = (np.abs(path) > 0.05) & (np.abs(path - THICKNESS / mu) > 0.05)
            np.testing.assert_allclose(found[clear], sought[clear], atol=1e-4 * total)
    np.testing.assert_allclose(wave.components["ground"].sum(), ground, rtol=1e-4)
    np.testing.assert_allclose(wave.reflectance.sum(), total, rtol=1e-4)
    other = sum(part[-1] if np.ndim(part) else part for part in expected(case, 3.0 - kappa, mu, path))
    assert abs(float(wave.reflectance.sum()) - other) > 0.01 * total


@pytest.fixture(scope="module")
def reference():
    return first_order((1, 1, 1))


def first_order(shape, **changes):
    """Waveform of a slab divided into voxels, for a beam 2 m wide of a pulse of 3 ns."""
    lidar = jl.Lidar(zenith=20.0, azimuth=70.0, divergence=2.0, pulse=jl.GaussianPulse(fwhm=3.0))
    canopy = jl.Canopy(slab(0.9, 0.5, shape=shape), leaf=LEAF, bark=0.5, sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=RHO, slope=15.0))
    return first_wave(lidar, scene, jl.plan(lidar, scene, window=(-110.0, 30.0), **(FIRST | changes)))


@pytest.mark.parametrize(
    ("shape", "changes"),
    [
        ((1, 1, 1), {"max_step": 1.3}),
        ((40, 31, 7), {}),
        ((2, 3, 20), {"bin_width": 0.05}),
    ],
)
def test_nothing_depends_on_steps_voxels_and_fine_bins(reference, shape, changes):
    wave = first_order(shape, **changes)
    peak = float(reference.reflectance.max())
    np.testing.assert_allclose(wave.reflectance, reference.reflectance, atol=1e-4 * peak)
    np.testing.assert_allclose(wave.reflectance.sum(), reference.reflectance.sum(), rtol=1e-4)


def test_nothing_is_drawn_at_random(reference):
    lidar = jl.Lidar(**SHORT)
    scene = jl.Scene(canopy=jl.Canopy(slab(1.0), leaf=LEAF))
    plan = jl.plan(lidar, scene, **FIRST)
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
    """G(theta), the mean of |n . w|, and the mean of (n . w)^2, by quadrature over leaf inclination."""

    def over_azimuth(t):
        a, b = np.cos(theta) * np.cos(t), np.sin(theta) * np.sin(t)
        if a >= b:
            return a
        turn = np.arccos(-a / b)
        return (a * (2 * turn - np.pi) + 2 * b * np.sin(turn)) / np.pi

    kink = [np.pi / 2 - theta]
    first, _ = quad(lambda t: density(t) * over_azimuth(t), 0, np.pi / 2, points=kink, epsabs=1e-9)
    square, _ = quad(
        lambda t: density(t) * ((np.cos(theta) * np.cos(t)) ** 2 + 0.5 * (np.sin(theta) * np.sin(t)) ** 2),
        0,
        np.pi / 2,
    )
    return first, square


@pytest.fixture(scope="module")
def leaning():
    """One plan for all leaf angles and zenith angles up to 57.3 degrees."""
    lidar = jl.Lidar(zenith=57.3, azimuth=10.0, **SHORT)
    return jl.plan(lidar, jl.Scene(canopy=leafy("uniform"), ground=jl.Ground(reflectance=RHO)), **FIRST)


def leafy(name):
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), 0.15),
        voxel_size=(40.0, 40.0, 2.5),
        origin=(-20, -20, 0),
        leaf_angles=jl.LeafAngles.named(name),
    )
    return jl.Canopy(voxels, leaf=LEAF, sides="periodic")


@pytest.mark.parametrize("zenith", [0.0, 30.0, 57.3])
@pytest.mark.parametrize("name", DENSITIES)
def test_leaf_angles_set_extinction_and_backscatter(leaning, name, zenith):
    """Leaf area index 1.5: the ground gives G, the leaves give the mean squared cosine."""
    scene = jl.Scene(canopy=leafy(name), ground=jl.Ground(reflectance=RHO))
    wave = first_wave(jl.Lidar(zenith=zenith, azimuth=10.0, **SHORT), scene, leaning)
    theta = np.deg2rad(zenith)
    projection, square = mean_cosines(DENSITIES[name], theta)
    depth = projection * 1.5 / np.cos(theta)
    ground = RHO * np.cos(theta) * np.exp(-2 * depth)
    leaf = 0.4 * square / projection * -np.expm1(-2 * depth) / 2
    print(
        "REL",
        name,
        zenith,
        wave.components["ground"].sum() / ground - 1,
        wave.components["leaf"].sum() / leaf - 1,
    )
    np.testing.assert_allclose(wave.components["ground"].sum(), ground, rtol=1e-4)
    np.testing.assert_allclose(wave.components["leaf"].sum(), leaf, rtol=1e-4)
    assert (
        name == "spherical"
        or abs(projection - 0.5) < 0.02
        or ground != pytest.approx(RHO * np.cos(theta) * np.exp(-1.5 / np.cos(theta)), rel=1e-2)
    )


def test_spherical_leaves_need_no_table():
    assert jl.VoxelMap.from_lad(np.ones((1, 1, 1)), voxel_size=1.0).leaf_angles is None


def test_beta_distributions_have_the_moments_asked_for():
    """Mean and standard deviation in degrees, to the midpoint rule over cells of one degree."""
    angles = jl.LeafAngles.beta(57.0, 20.0)
    middle = np.arange(90) + 0.5
    p = np.asarray(angles.normalised(), float)
    assert p @ middle == pytest.approx(57.0, abs=0.05)
    assert np.sqrt(p @ (middle - p @ middle) ** 2) == pytest.approx(20.0, abs=0.1)
