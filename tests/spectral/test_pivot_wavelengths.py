"""Pivot wavelengths represent a spectrum: polynomials in the optics, and standard errors of spectra."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.sampling.waveform_moments import PivotMoments, WaveformMoments
from jaxlidar.spectral.apply_optics import budget_terms, make_waveform_model, total_samples
from jaxlidar.spectral.pivot_wavelengths import find_pivots
from jaxlidar.trace.photons.histories import histories

WAVELENGTH = np.arange(400.0, 2501.0)
LEAF = jl.Prospect(N=1.5, Cab=40.0, Car=8.0, Cant=0.0, Cbrown=0.0, Cw=0.01, Cm=0.009)


def optics(wavelength=WAVELENGTH) -> np.ndarray:
    """Return reflectance and transmittance of leaves, reflectance of bark and of a soil with a water band."""
    soil = 0.1 + 0.3 * (wavelength - 400) / 2100 - 0.05 * np.exp(-(((wavelength - 1900) / 60) ** 2))
    return np.stack([*(np.asarray(x) for x in LEAF(jnp.asarray(wavelength))), np.full_like(soil, 0.4), soil])


def interpolation_error(pivots, values, degree) -> float:
    """Return the largest error of monomials over the largest monomial of degree one or more."""
    exact = np.prod(values[None] ** histories(len(values), degree).exponents[:, :, None], axis=1)
    interpolated = exact[:, np.asarray(pivots.indices)] @ np.asarray(pivots.coefficients, float)
    return float(np.max(np.abs(interpolated - exact) / np.max(exact[1:], axis=0)))


def test_pivots_interpolate_every_product_of_optics():
    values = optics()
    pivots = find_pivots(jnp.asarray(values), 10)
    assert pivots is not None
    assert pivots.indices.size < 64
    assert interpolation_error(pivots, values, 10) < 1e-4
    # Wavelengths chosen for one scattering do not serve ten.
    single_scattering_pivots = find_pivots(jnp.asarray(values), 1)
    assert single_scattering_pivots is not None
    assert interpolation_error(single_scattering_pivots, values, 1) < 1e-4
    assert interpolation_error(single_scattering_pivots, values, 10) > 1e-2


def test_independent_wavelengths_have_no_pivots():
    assert find_pivots(jnp.asarray(np.random.default_rng(0).uniform(size=(8, 200))), 10) is None


def test_a_constant_spectrum_needs_one_pivot():
    pivots = find_pivots(jnp.full((2, 40), 0.5), 4)
    assert pivots is not None
    assert np.count_nonzero(np.any(pivots.coefficients, axis=1)) == 1
    np.testing.assert_allclose(pivots.coefficients[0], 1.0, rtol=1e-5)


def test_the_number_of_pivots_does_not_follow_the_optics():
    """Programs are compiled for their number."""
    sizes = set()
    for depth in (0.2, 0.3, 0.4):
        values = optics()
        values[2] = depth
        pivots = find_pivots(jnp.asarray(values), 10)
        assert pivots is not None
        sizes.add(pivots.indices.size)
    assert len(sizes) == 1


@pytest.mark.slow
@pytest.mark.parametrize("air", [None, jl.Atmosphere(visibility=5.0)], ids=["clear", "hazy"])
def test_a_batch_at_pivots_gives_the_batch(air):
    """Samples and energy budget, with an atmosphere whose transmittance differs between wavelengths too."""
    wavelength = WAVELENGTH[::10]
    lidar = jl.Lidar(wavelength=wavelength, divergence=4.0)
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), 0.4), voxel_size=(4.0, 4.0, 1.0), origin=(-2.0, -2.0, 0.0)
    )
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=LEAF, hotspot=False),
        ground=jl.Ground(reflectance=optics(wavelength)[-1]),
        atmosphere=air,
    )
    setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene, max_orders=4, n_photons=8192))
    response, model = jl.trace_scene(setup, jax.random.key(0)), make_waveform_model(setup)
    pivot_model = model.at_pivots()
    assert pivot_model.pivots is not None
    assert pivot_model.pivots.indices.size < len(wavelength) / 4
    samples = total_samples(response, model)
    np.testing.assert_allclose(
        total_samples(response, pivot_model), samples, atol=1e-4 * float(samples.max())
    )
    for name, fraction in budget_terms(response, model).energy_budget.items():
        np.testing.assert_allclose(
            budget_terms(response, pivot_model).energy_budget[name], fraction, atol=1e-4
        )
    # The same test rejects the coefficients of the neighbouring wavelength.
    wrong_pivots = dataclasses.replace(
        pivot_model.pivots, coefficients=jnp.roll(pivot_model.pivots.coefficients, 1, axis=1)
    )
    wrong_samples = total_samples(response, dataclasses.replace(pivot_model, pivots=wrong_pivots))
    assert not np.allclose(wrong_samples, samples, atol=1e-4 * float(samples.max()))


@pytest.mark.slow
def test_errors_of_a_spectrum_are_those_of_its_wavelengths():
    """Each wavelength has the standard error of a simulation at this wavelength by the same photons."""
    scene = jl.Scene(
        plates=[jl.Plate(5.0, 0.3, 0.4, coverage=0.5)], ground=jl.Ground(reflectance=optics()[-1][::20])
    )
    spectral_lidar = jl.Lidar(wavelength=WAVELENGTH[::20], divergence=2.0)
    settings = {"key": jax.random.key(1), "n_photons": 8192, "max_orders": 5}
    spectrum = jl.simulate(spectral_lidar, scene, **settings)
    for i in (3, 70):
        ground = jl.Ground(reflectance=float(scene.ground.reflectance[i]))
        alone = jl.simulate(
            jl.Lidar(wavelength=WAVELENGTH[20 * i], divergence=2.0),
            dataclasses.replace(scene, ground=ground),
            **settings,
        )
        largest = float(alone.stderr.max())
        np.testing.assert_allclose(spectrum.stderr[i], alone.stderr[0], rtol=1e-3, atol=1e-3 * largest)
        np.testing.assert_allclose(spectrum.reflectance[i], alone.reflectance[0], rtol=1e-5, atol=1e-7)


def test_moments_at_pivots_are_those_at_all_wavelengths():
    """Interpolated moments of batches at pivots are those at all wavelengths, by rounds of any size."""
    random = np.random.default_rng(0)
    coefficients = random.uniform(-1.0, 1.0, (5, 40))
    pivot_moments, moments = PivotMoments(jnp.asarray(coefficients, jnp.float32)), WaveformMoments(40, 7)
    for batches in (8, 3, 21):
        for _ in range(batches):
            pivot_batch = 2.0 + random.uniform(size=(5, 7))
            pivot_moments.add(pivot_batch)
            moments.add(np.pad(coefficients.T @ pivot_batch, ((0, 2), (0, 1))))
        from_pivots, from_all = pivot_moments.errors(), moments.errors()
        # A second call, as after an interrupt, returns the same.
        np.testing.assert_array_equal(from_pivots.stderr, pivot_moments.errors().stderr)
        assert pivot_moments.count == moments.count
        for name in ("total", "stderr"):
            expected = getattr(from_all, name)
            np.testing.assert_allclose(
                getattr(from_pivots, name), expected, atol=3e-6 * np.abs(expected).max()
            )
        assert from_pivots.relative == pytest.approx(from_all.relative, rel=1e-3)
        assert from_pivots.largest == pytest.approx(from_all.largest, rel=1e-5)
