"""Invariance of waveforms under chunk size, position and orientation of the scene, division of voxels, and
the number of wavelengths.

Layout: a crown of random voxels, leaf (R != T) and bark, over sloping ground, off nadir. The random numbers
depend on the index of a photon alone, so that changes that do not alter its path are compared photon by
photon: tolerance 1e-4 of the peak, for the rounding of distances. Others are compared by a z-test.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import SINGLE_SAMPLE, agrees, batch_mean, single_sample_lidar, slab, slow_unless

KEY = jax.random.key(31)
SHAPE, EDGE = (6, 6, 8), 1.0
EXTINCTION = np.random.default_rng(31).uniform(0.0, 0.5, SHAPE)
LEAF = {"reflectance": np.array([0.1, 0.45, 0.3]), "transmittance": np.array([0.05, 0.4, 0.2])}
SIZES = {"max_orders": 4, "n_rays": 512, "bin_width": 0.5, "window": (-80.0, 60.0)}


def build(shift=(0.0, 0.0, 0.0), turns=0, divide=1, zenith=20.0, pick=slice(None), empty=0):
    """Return lidar and scene, moved by `shift`, turned clockwise by quarter `turns` about the aim point."""
    k = np.rot90(EXTINCTION, -turns, axes=(0, 1))
    for axis in range(3):
        k = np.repeat(k, divide, axis=axis)
    k = np.pad(k, ((empty, empty), (empty, empty), (0, empty)))
    origin = np.array([-3.0 - empty * EDGE, -3.0 - empty * EDGE, 0.5]) + shift
    voxels = jl.VoxelMap.from_extinction(leaf=0.8 * k, bark=0.2 * k, voxel_size=EDGE / divide, origin=origin)
    aspect, azimuth = np.deg2rad(30.0), np.deg2rad(50.0)
    # The height of a sloping plane is given at the origin.
    downhill = shift[0] * np.sin(aspect) + shift[1] * np.cos(aspect)
    wavelength = np.array([532.0, 1064.0, 1550.0])[pick]
    leaf = jl.LeafOptics(**{name: value[pick] for name, value in LEAF.items()})
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, bark=np.array([0.2, 0.4, 0.5])[pick], hotspot=False),
        ground=jl.Ground(
            height=shift[2] + np.tan(np.deg2rad(10.0)) * downhill,
            slope=10.0,
            aspect=30.0 + 90.0 * turns,
            reflectance=np.array([0.1, 0.3, 0.2])[pick],
        ),
    )
    tilt = np.tan(np.deg2rad(zenith)) * shift[2]
    # Point where the beam axis crosses z = 0 if it aims at the shifted scene.
    position = (shift[0] + tilt * np.sin(azimuth), shift[1] + tilt * np.cos(azimuth))
    lidar = jl.Lidar(
        wavelength=wavelength,
        altitude=1000.0 + shift[2],
        divergence=4.0,
        zenith=zenith,
        azimuth=50.0 + 90.0 * turns,
        position=position,
    )
    return lidar, scene


@pytest.fixture(scope="module")
def reference_wave():
    lidar, scene = build()
    plan = jl.plan(lidar, scene, n_photons=4096, **SIZES)
    return plan, jl.simulate(lidar, scene, key=KEY, plan=plan, n_photons=4096)


def assert_alike(actual, expected, rtol=1e-4):
    peak = float(np.max(expected))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=rtol * peak)


def traced(lidar, scene, plan, key):
    setup = jl.make_setup(lidar, scene, plan)
    return jl.waveform_of(jl.trace_scene(setup, key), setup).reflectance


@pytest.mark.slow
def test_the_chunk_size_does_not_matter(reference_wave, monkeypatch):
    plan, wave = reference_wave
    monkeypatch.setattr("jaxlidar.trace.photons.higher_orders.PHOTONS_PER_CHUNK", 96)
    monkeypatch.setattr("jaxlidar.trace.first.first_order.RAYS_AT_ONCE", 100)
    # Two functions, so that JAX compiles each with its chunk size.
    trace_small_chunks = eqx.filter_jit(lambda *arguments: traced(*arguments))
    lidar, scene = build()
    key = jax.random.fold_in(KEY, 0)
    small_chunks = trace_small_chunks(lidar, scene, plan, key)
    monkeypatch.undo()
    trace_default_chunks = eqx.filter_jit(lambda *arguments: traced(*arguments))
    assert_alike(small_chunks, trace_default_chunks(lidar, scene, plan, key), 1e-5)
    assert float(np.max(wave.components["higher"])) > 0.01 * float(np.max(wave.reflectance))


@pytest.mark.parametrize("parts", ["ground", "canopy", "plates"])
def test_optics_of_one_order_are_applied_by_history_or_in_the_trace(parts):
    lidar, scene = build(zenith=0.0)
    if parts != "canopy":
        scene = eqx.tree_at(lambda s: s.canopy, scene, None)
    if parts == "plates":
        plate = jl.Plate(5.0, np.array([0.2, 0.4, 0.5]), np.array([0.1, 0.3, 0.2]), coverage=0.6)
        scene = jl.Scene(plates=[plate], ground=scene.ground)
    plans = (jl.plan(lidar, scene, max_orders=1, n_rays=64, histories=keeps) for keeps in (True, False))
    by_history, applied = (jl.simulate(lidar, scene, key=KEY, plan=plan, rtol=0.1) for plan in plans)
    assert float(jnp.max(by_history.reflectance)) > 1e-3
    assert_alike(applied.reflectance, by_history.reflectance, 1e-5)
    assert_alike(applied.lost, by_history.lost, 1e-5)
    for name, fraction in by_history.energy_budget.items():
        np.testing.assert_allclose(applied.energy_budget[name], fraction, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_one_trace_serves_every_wavelength(reference_wave):
    plan, wave = reference_wave
    for i in range(3):
        lidar, scene = build(pick=slice(i, i + 1))
        single = jl.simulate(lidar, scene, key=KEY, plan=plan, n_photons=4096)
        assert_alike(single.reflectance[0], wave.reflectance[i], 1e-6)
        for name, component in single.components.items():
            assert_alike(component[0], wave.components[name][i], 1e-5)


@pytest.mark.slow
def test_moving_everything_sideways_changes_nothing(reference_wave):
    plan, wave = reference_wave
    lidar, scene = build(shift=(250.0, -120.0, 0.0))
    moved = jl.simulate(lidar, scene, key=KEY, plan=plan, n_photons=4096)
    assert_alike(moved.reflectance, wave.reflectance)


@pytest.mark.slow
def test_empty_voxels_around_the_crown_change_nothing(reference_wave):
    _, wave = reference_wave
    lidar, scene = build(empty=3)
    larger = jl.plan(lidar, scene, n_photons=4096, **SIZES)
    padded_wave = jl.simulate(lidar, scene, key=KEY, plan=larger, n_photons=4096)
    assert_alike(padded_wave.reflectance, wave.reflectance)
    for name, share in padded_wave.energy_budget.items():
        np.testing.assert_allclose(share, wave.energy_budget[name], atol=1e-4, err_msg=name)


@pytest.mark.slow
def test_a_lower_scene_shifts_the_time(reference_wave):
    """Scene and sensor 3 m lower: light arrives 2 * 3 m / (c cos zenith) later."""
    _, wave = reference_wave
    delay = 2 * 3.0 / (0.299792458 * np.cos(np.deg2rad(20.0)))
    lidar, scene = build(shift=(0.0, 0.0, -3.0))
    later = tuple(t + round(delay) for t in SIZES["window"])
    shifted = jl.plan(lidar, scene, n_photons=4096, **(SIZES | {"window": later}))
    lowered = jl.simulate(lidar, scene, key=KEY, plan=shifted, n_photons=4096)
    for a, b in zip(lowered.reflectance, wave.reflectance):
        assert float(a.sum()) == pytest.approx(float(b.sum()), rel=1e-3)
        centroids = [float((r * w.time).sum() / r.sum()) for r, w in ((a, lowered), (b, wave))]
        assert centroids[0] - centroids[1] == pytest.approx(delay, abs=0.02)


def order_sums(wave):
    return wave.components["first"].sum(axis=1), wave.components["higher"].sum(axis=1)


BATCHES = {"max_orders": 4, "n_photons": 16384, "n_rays": 512, **SINGLE_SAMPLE}


@pytest.fixture(scope="module")
def totals():
    return expectation()


def expectation(**changes):
    """First and higher orders of the whole waveform, and their standard errors, at three wavelengths."""
    lidar, scene = build(**changes)
    far_lidar = single_sample_lidar(
        wavelength=lidar.wavelength, divergence=0.01, zenith=20.0, azimuth=lidar.azimuth, aperture=80.0
    )
    return batch_mean(far_lidar, scene, jl.plan(far_lidar, scene, **BATCHES), seed=5, quantity=order_sums)


@pytest.mark.parametrize(
    "changes",
    slow_unless([{"turns": 1}], [{"turns": 1}, {"divide": 2}]),
    ids=["quarter turn", "voxels in eight"],
)
def test_turning_and_dividing(totals, changes):
    value, stderr = expectation(**changes)
    for a, b, c, d in zip(value, totals[0], stderr, totals[1]):
        assert agrees(a, np.hypot(c, d), b)
    # The same test rejects higher orders that are 5 % off.
    assert not agrees(1.05 * value[1], np.hypot(stderr[1], totals[1][1]), totals[0][1])


@pytest.mark.slow
def test_within_a_transformation():
    """Compiled by the caller, for several scenes at once, and differentiated."""
    lidar = jl.Lidar(divergence=4.0)

    def scene_of(rho):
        canopy = jl.Canopy(slab(0.8), leaf=jl.Isotropic(albedo=0.6), hotspot=False)
        return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=rho))

    plan = jl.plan(lidar, scene_of(0.3), max_orders=2, n_rays=64)

    def reflectance(rho):
        return jl.simulate(lidar, scene_of(rho), key=KEY, plan=plan, n_photons=512).reflectance[0]

    def with_slope(rho):
        return jax.jvp(reflectance, (rho,), (jnp.ones_like(rho),))

    values = jnp.asarray([0.2, 0.4])
    reflectances, slopes = jax.jit(jax.vmap(with_slope))(values)
    for value, mapped in zip(values, reflectances):
        assert_alike(mapped, reflectance(value), 1e-5)
    # Two orders are linear in the reflectance of the ground, which cannot illuminate itself.
    assert_alike(slopes[0], (reflectances[1] - reflectances[0]) / 0.2, 1e-4)
    assert_alike(slopes[1], slopes[0], 1e-4)


def test_the_plan_is_a_value():
    """Equal scenes have equal plans, so that they share compiled programs."""
    lidar, scene = build()
    first, second = (jl.plan(lidar, scene, n_photons=4096, **SIZES) for _ in range(2))
    assert first == second
    assert hash(first) == hash(second)
    assert first != first.with_config(photons_per_batch=513)
