r"""Truth of one beam against closed forms: slabs, plates, slopes, half-planes of canopy, amplitudes.

A slab of plant area density a from its top z1 down to z0, seen at the zenith angle theta (mu = cos(theta)),
lets the fraction exp(-G a (z1 - z) / mu) pass down to z. A beam of radius w (at 1/e^2, or the edge of a
top-hat) meets a plane of slope alpha at heights whose standard deviation is tan(alpha) w / 2: the variance of
x is w^2/4 for both profiles. Of a half-plane x > d a Gaussian beam lights the share Phi(-2 d / w), a top-hat
the segment (arccos(q) - q sqrt(1 - q^2)) / pi, q = d / w.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import jaxlidar as jl
from tests.helpers import BY_PRECISION, slow_unless

KEY = jax.random.key(3)
FAR_ABOVE = {"altitude": 4e5, "pulse": jl.GaussianPulse(fwhm=6.0)}
NARROW_BEAM = FAR_ABOVE | {"divergence": 1e-3}
# A footprint of radius 5 m.
WIDE_BEAM = FAR_ABOVE | {"divergence": 0.025}
# Height that a sample spans, m.
SAMPLE_HEIGHT = 0.5 * jl.SPEED_OF_LIGHT
LEAF = jl.LeafOptics(0.45, 0.3)


def stand(lad, *, bark=None, size=1.0, origin=(-20.0, -20.0, 2.0), ground=None, angles="spherical", **canopy):
    """Return a canopy above ground."""
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=size, origin=origin, leaf_angles=angles, bark=bark)
    canopy = {"leaf": LEAF, "bark": None if bark is None else 0.4, "hotspot": False} | canopy
    return jl.Scene(canopy=jl.Canopy(voxels, **canopy), ground=ground or jl.Ground(reflectance=0.3))


def sample_ends(truth):
    """Return the heights of the lower ends of all samples."""
    height = np.asarray(truth.height, float)
    return height + 0.5 * np.diff(height)[0]


@pytest.mark.slow
@BY_PRECISION
@pytest.mark.parametrize(
    ("zenith", "angles"), slow_unless([(40.0, "spherical")], [(0.0, "planophile"), (40.0, "spherical")])
)
def test_the_truth_of_a_slab(precision, zenith, angles):
    leaf_density, bark, base, top = 0.6, 0.1, 2.0, 12.0
    shape = (40, 40, 5)
    scene = stand(
        np.full(shape, leaf_density),
        bark=np.full(shape, bark),
        size=(1.0, 1.0, 2.0),
        angles=angles,
        sides="periodic",
    )
    # Without divergence: off nadir, shells of equal range cut a wide beam at many heights.
    truth = jl.truth_of(jl.Lidar(zenith=zenith, **FAR_ABOVE, divergence=0.0), scene)
    mu = np.cos(np.deg2rad(zenith))
    G = 0.5
    if angles != "spherical":
        G = float(jl.LeafAngles.named(angles).tables()[0][-1])
    depth = np.clip(top - sample_ends(truth), 0.0, top - base)
    tolerance = 2e-5 if precision == "float32" else 1e-9
    gap = np.exp(-(G * leaf_density + bark) * depth / mu)
    assert np.allclose(truth.gap_probability, gap, atol=tolerance)
    assert np.allclose(truth.plant_area_index, (leaf_density + 2 * bark) * depth, atol=50 * tolerance)
    assert not np.allclose(
        truth.gap_probability, np.exp(-(G * leaf_density + bark) * (depth + 0.1) / mu), atol=1e-3
    )
    inside = (np.asarray(truth.height) < top - 0.2) & (np.asarray(truth.height) > base + 0.2)
    outside = (np.asarray(truth.height) > top + 0.2) | (np.asarray(truth.height) < base - 0.2)
    for name, density in (("leaf", leaf_density), ("bark", 2 * bark)):
        profile = np.asarray(getattr(truth, f"{name}_area_density"), float)
        assert np.allclose(profile[inside], density, rtol=50 * tolerance), name
        assert np.all(profile[outside] == 0.0), name
    expected = top + np.log(0.99) * mu / (G * leaf_density + bark)
    assert float(truth.top_height) == pytest.approx(expected, abs=SAMPLE_HEIGHT)


@pytest.mark.slow
def test_plates_intercept_in_turn():
    plates = [jl.Plate(3.0, 0.4, coverage=0.5), jl.Plate(7.0, 0.2, 0.3, coverage=0.25), jl.Plate(-9.0, 0.4)]
    scene = jl.Scene(plates=plates, ground=jl.Ground(reflectance=0.3))
    truth = jl.truth_of(jl.Lidar(**NARROW_BEAM), scene)
    expected = np.where(sample_ends(truth) < 3.0, 0.375, np.where(sample_ends(truth) < 7.0, 0.75, 1.0))
    assert np.allclose(truth.gap_probability, expected, atol=1e-6)
    assert float(truth.top_height) == pytest.approx(7.0, abs=SAMPLE_HEIGHT)
    heights = {name: float(z) for name, z in truth.surface_height.items()}
    assert np.isnan(heights.pop("plate 3"))
    assert heights == pytest.approx({"ground": 0.0, "plate 1": 3.0, "plate 2": 7.0}, abs=1e-4)
    assert np.allclose(truth.plant_area_index, 0.0)
    # Amplitude of each layer at its height: an opaque sheet lets the fraction 1 - coverage pass twice.
    amplitudes = {name: float(jnp.sum(a)) for name, a in truth.returns.items()}
    through = 0.75 + 0.25 * 0.3
    layers = {"plate 2": 0.25 * 0.2, "plate 1": 0.5 * 0.4 * through**2, "ground": 0.3 * 0.25 * through**2}
    assert amplitudes == pytest.approx(layers | {"plate 3": 0.0}, rel=1e-4)
    for name, a in truth.returns.items():
        if name != "plate 3":
            centre = float(jnp.sum(a[0] * truth.height) / jnp.sum(a[0]))
            assert centre == pytest.approx(heights[name], abs=0.1), name


@BY_PRECISION
@pytest.mark.parametrize("profile", ["gaussian", "top-hat"])
def test_slopes_spread_heights(profile, precision):
    lidar = jl.Lidar(profile=profile, position=(40.0, 0.0), **WIDE_BEAM)
    ground = jl.Ground(height=1500.0, slope=20.0, aspect=90.0)
    truth = jl.truth_of(lidar, jl.Scene(ground=ground))
    slope = np.tan(np.deg2rad(20.0))
    height = 1500.0 - 40.0 * slope
    # Nearer to the sensor the beam is narrower.
    spread = 2.5 * slope * (1.0 - height / 4e5)
    accuracy = 1e-3 if precision == "float32" else 1e-4
    assert float(truth.surface_height["ground"]) == pytest.approx(height, abs=accuracy)
    assert float(truth.surface_spread["ground"]) == pytest.approx(spread, rel=accuracy)
    # Above terrain the footprint is a set of rays.
    x = np.arange(-40.0, 121.0, 20.0)
    heights = np.broadcast_to(1500.0 - slope * x[:, None], (x.size, x.size))
    hill = jl.Terrain(heights + 1e-3 * (x > 110.0), spacing=20.0, origin=(-40.0, -80.0))
    rays = jl.truth_of(lidar, jl.Scene(ground=hill))
    assert float(rays.surface_height["ground"]) == pytest.approx(height, abs=2e-3)
    assert float(rays.surface_spread["ground"]) == pytest.approx(spread, rel=5e-3)
    assert np.isnan(float(rays.top_height))


def test_level_ground_has_no_spread_off_nadir():
    truth = jl.truth_of(jl.Lidar(zenith=30.0, **WIDE_BEAM), jl.Scene(ground=jl.Ground(2.0)))
    assert float(truth.surface_height["ground"]) == pytest.approx(2.0, abs=1e-5)
    assert float(truth.surface_spread["ground"]) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["gaussian", "top-hat"])
def test_half_of_a_footprint_is_weighted_by_its_light(profile):
    """The canopy on x > 2 is far denser than that on x < 2; 4096 rays leave an error of a thousandth."""
    lad = np.full((40, 1, 4), 0.1)
    lad[22:] = 1.0
    scene = stand(lad, size=(1.0, 40.0, 2.0))
    lidar = jl.Lidar(profile=profile, **WIDE_BEAM)
    q = 2.0 / 5.0
    segment = (np.arccos(q) - q * np.sqrt(1 - q * q)) / np.pi
    lit_fraction = {"gaussian": norm.cdf(-2.0 * q), "top-hat": segment}

    def gap(covered):
        return covered * np.exp(-0.5 * 8.0) + (1.0 - covered) * np.exp(-0.5 * 0.8)

    def truth_of_rays(rays):
        plan = jl.plan(lidar, scene, max_orders=1, n_rays=rays)
        return jl.truth_of(lidar, scene, plan=plan)

    fine = truth_of_rays(4096)
    assert float(fine.gap_probability[-1]) == pytest.approx(gap(lit_fraction[profile]), abs=1e-3)
    area = 8.0 * lit_fraction[profile] + 0.8 * (1.0 - lit_fraction[profile])
    assert float(fine.plant_area_index[-1]) == pytest.approx(area, rel=3e-3)
    other_fraction = lit_fraction["top-hat" if profile == "gaussian" else "gaussian"]
    assert float(fine.gap_probability[-1]) != pytest.approx(gap(other_fraction), abs=1e-3)
    # Fewer rays are near it.
    assert np.allclose(truth_of_rays(512).gap_probability, fine.gap_probability, atol=8e-3)


SCENES = {
    "leaf and bark, hot spot": lambda: stand(
        np.full((40, 40, 10), 0.3), bark=np.full((40, 40, 10), 0.05), hotspot=True
    ),
    "straight transmission": lambda: dataclasses.replace(
        stand(
            np.full((40, 40, 10), 0.3), leaf=jl.LeafOptics([0.1, 0.4], [0.1, 0.4]), transmission="straight"
        ),
        atmosphere=jl.Atmosphere(visibility=5.0, lidar_ratio=50.0),
    ),
    "mirror": lambda: jl.Scene(
        plates=[jl.Plate(3.0, 0.4, coverage=0.5)],
        ground=jl.Ground(reflectance=0.3, law=jl.Specular(roughness=0.02)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_returns_are_the_first_order_without_the_pulse(name):
    lidar = jl.Lidar(wavelength=(532.0, 1064.0), **NARROW_BEAM)
    scene = SCENES[name]()
    wave = jl.simulate(lidar, scene, key=KEY, max_orders=1, footprint="fixed", truth=True)
    truth = wave.truth
    assert np.array_equal(truth.time, wave.time)
    assert np.array_equal(truth.height, wave.height)
    assert set(truth.returns) == set(wave.components) - {"first", "higher"}
    for material, returned in truth.returns.items():
        recorded, returned = np.asarray(wave.components[material]), np.asarray(returned)
        if material == "air":
            continue
        assert np.allclose(returned.sum(axis=1), recorded.sum(axis=1), rtol=1e-3), material
        # The pulse is symmetric and does not move the centroid.
        centres = [(a * np.asarray(wave.height)).sum(axis=1) / a.sum(axis=1) for a in (returned, recorded)]
        assert np.allclose(*centres, atol=0.08), material
    assert np.allclose(wave.first_order_share, 1.0)
    if scene.canopy is not None:
        # Gaps are geometric: transmission by leaves does not count.
        bark = 0.05 if scene.canopy.voxels.bark is not None else 0.0
        assert float(truth.gap_probability[-1]) == pytest.approx(np.exp(-10 * (0.15 + bark)), rel=1e-3)


@pytest.mark.slow
def test_first_order_fractions():
    wave = jl.simulate(jl.Lidar(), SCENES["leaf and bark, hot spot"](), key=KEY, max_orders=3, rtol=0.2)
    total = wave.reflectance.sum(axis=1)
    assert np.allclose(wave.first_order_share, 1.0 - wave.components["higher"].sum(axis=1) / total, atol=1e-6)
    assert 0.5 < float(wave.first_order_share[0]) < 0.99
    dark = jax.tree.map(jnp.zeros_like, wave)
    assert np.array_equal(dark.first_order_share, [1.0])


@pytest.mark.slow
@pytest.mark.parametrize("k", [0.0, 0.2, 40.0])
def test_derivatives_are_those_of_the_closed_form(k, precision):
    lidar = jl.Lidar(**NARROW_BEAM)

    def scene(k):
        voxels = jl.VoxelMap(jnp.full((40, 40, 10), k), None, 1.0, (-20.0, -20.0, 2.0))
        ground = jl.Ground(reflectance=0.3)
        return jl.Scene(canopy=jl.Canopy(voxels, leaf=LEAF, hotspot=False), ground=ground)

    plan = jl.plan(lidar, scene(0.2), max_orders=1, n_rays=1)

    def truth(k):
        return jl.truth_of(lidar, scene(k), plan=plan)

    value, tangent = jax.jvp(jax.jit(truth), (jnp.asarray(k),), (jnp.ones(()),))
    for leaf in (*jax.tree.leaves(value), *jax.tree.leaves(tangent)):
        assert np.all(np.isfinite(leaf)) or (k == 0.0 and leaf.ndim == 0)
    # The gap probability is rounded as a number near one.
    assert float(tangent.gap_probability[-1]) == pytest.approx(-10.0 * np.exp(-10.0 * k), abs=1e-4)
    assert float(tangent.plant_area_index[-1]) == pytest.approx(20.0, rel=1e-5)
    back = jax.grad(lambda k: truth(k).gap_probability.sum())(jnp.asarray(k))
    assert float(back) == pytest.approx(float(tangent.gap_probability.sum()), rel=1e-3, abs=1e-5)


@pytest.mark.slow
def test_absent_quantities_are_nan_and_all_others_finite():
    for scene in (jl.Scene(plates=[jl.Plate(1.0, 0.5)]), stand(np.ones((40, 40, 3)), ground=jl.Ground(-3.0))):
        truth = jl.truth_of(jl.Lidar(**NARROW_BEAM), scene)
        assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(truth))
    empty = jl.truth_of(jl.Lidar(**NARROW_BEAM), jl.Scene(ground=jl.Ground()))
    assert np.isnan(float(empty.top_height))
    assert np.array_equal(np.asarray(empty.gap_probability), np.ones(empty.time.size))
    # Solid voxels leave no gap.
    solid = jl.VoxelMap.from_probability(leaf=np.ones((4, 4, 3)), voxel_size=10.0, origin=(-20, -20, 0))
    none = jl.truth_of(jl.Lidar(**NARROW_BEAM), jl.Scene(canopy=jl.Canopy(solid, leaf=LEAF, hotspot=False)))
    assert float(none.gap_probability[-1]) == pytest.approx(0.0, abs=1e-6)
    # Small gaps have their relative precision: 1 less what is intercepted would have rounding of 1e-6.
    deep = jl.VoxelMap.from_extinction(leaf=np.full((4, 4, 3), 0.4), voxel_size=10.0, origin=(-20, -20, 0))
    little = jl.truth_of(jl.Lidar(**NARROW_BEAM), jl.Scene(canopy=jl.Canopy(deep, leaf=LEAF, hotspot=False)))
    assert float(little.gap_probability[-1]) == pytest.approx(np.exp(-12.0), rel=1e-3)


@pytest.mark.slow
def test_a_window_that_opens_at_the_first_return_has_finer_truth():
    lidar = jl.Lidar(receiver=jl.Receiver(window="first return"), **NARROW_BEAM)
    wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground()), key=KEY, truth=True)
    assert wave.truth.time.size > wave.time.size
    assert float(wave.truth.surface_height["ground"]) == pytest.approx(0.0, abs=1e-5)


def test_bad_input_is_refused():
    lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground())
    with pytest.raises(TypeError, match="truth"):
        jl.simulate(lidar, scene, key=KEY, truth="yes")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="plan"):
        jl.truth_of(lidar, scene, plan=3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="the plan does not fit"):
        jl.truth_of(lidar, jl.Scene(ground=jl.Ground(100.0)), plan=jl.plan(lidar, scene))
    assert jl.simulate(lidar, scene, key=KEY).truth is None
