"""Few wavelengths stand for many: polynomials in the optics, and standard errors of spectra."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._statistics import FewMoments, WaveformMoments
from jaxlidar.spectral.apply_optics import budget_terms, make_waveform_model, total_samples
from jaxlidar.spectral.pivot_wavelengths import find_pivots
from jaxlidar.trace.histories import histories

WAVELENGTH = np.arange(400.0, 2501.0)
LEAF = jl.Prospect(N=1.5, Cab=40.0, Car=8.0, Cant=0.0, Cbrown=0.0, Cw=0.01, Cm=0.009)


def optics(wavelength=WAVELENGTH) -> np.ndarray:
    """Leaf reflectance and transmittance, bark, and a soil with a band of water."""
    soil = 0.1 + 0.3 * (wavelength - 400) / 2100 - 0.05 * np.exp(-(((wavelength - 1900) / 60) ** 2))
    return np.stack([*(np.asarray(x) for x in LEAF(jnp.asarray(wavelength))), np.full_like(soil, 0.4), soil])


def worst(few, values, degree) -> float:
    """What of any monomial is missed, of the largest that is not one at the same wavelength."""
    exact = np.prod(values[None] ** histories(len(values), degree).exponents[:, :, None], axis=1)
    found = exact[:, np.asarray(few.indices)] @ np.asarray(few.coefficients, float)
    return float(np.max(np.abs(found - exact) / np.max(exact[1:], axis=0)))


def test_every_product_of_optics_follows_from_few():
    values = optics()
    few = find_pivots(jnp.asarray(values), 10)
    assert few is not None
    assert few.indices.size < 64
    assert worst(few, values, 10) < 1e-4
    # Wavelengths chosen for one scattering do not serve ten.
    short = find_pivots(jnp.asarray(values), 1)
    assert short is not None
    assert worst(short, values, 1) < 1e-4
    assert worst(short, values, 10) > 1e-2


def test_unlike_wavelengths_have_none_that_stand_for_them():
    assert find_pivots(jnp.asarray(np.random.default_rng(0).uniform(size=(8, 200))), 10) is None


def test_one_value_at_all_wavelengths_needs_one():
    few = find_pivots(jnp.full((2, 40), 0.5), 4)
    assert few is not None
    assert np.count_nonzero(np.any(few.coefficients, axis=1)) == 1
    np.testing.assert_allclose(few.coefficients[0], 1.0, rtol=1e-5)


def test_another_leaf_has_as_many():
    """Programs are compiled for their number."""
    sizes = set()
    for depth in (0.2, 0.3, 0.4):
        values = optics()
        values[2] = depth
        few = find_pivots(jnp.asarray(values), 10)
        assert few is not None
        sizes.add(few.indices.size)
    assert len(sizes) == 1


@pytest.mark.parametrize(
    "air", [None, pytest.param(jl.Atmosphere(visibility=5.0), marks=pytest.mark.slow)], ids=["clear", "hazy"]
)
def test_a_batch_by_few_wavelengths_is_the_batch(air):
    """Samples and energy budget, with an atmosphere whose transmittance differs between wavelengths too."""
    wavelength = WAVELENGTH[::10]
    lidar = jl.Lidar(wavelength=wavelength, divergence=4.0)
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), 0.4), voxel_size=(4.0, 4.0, 1.0), origin=(-2.0, -2.0, 0.0)
    )
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=LEAF),
        ground=jl.Ground(reflectance=optics(wavelength)[-1]),
        atmosphere=air,
    )
    setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene, max_orders=4, n_photons=1024))
    response, exact = jl.trace_scene(setup, jax.random.key(0)), make_waveform_model(setup)
    brief = exact.at_pivots()
    assert brief.pivots is not None
    assert brief.pivots.indices.size < len(wavelength) / 4
    whole = total_samples(response, exact)
    np.testing.assert_allclose(total_samples(response, brief), whole, atol=1e-4 * float(whole.max()))
    for name, share in budget_terms(response, exact).energy_budget.items():
        np.testing.assert_allclose(budget_terms(response, brief).energy_budget[name], share, atol=1e-4)
    # Standard errors need three digits at every wavelength: shares of a neighbour would not do.
    wrong = dataclasses.replace(brief.pivots, coefficients=jnp.roll(brief.pivots.coefficients, 1, axis=1))
    found = total_samples(response, dataclasses.replace(brief, pivots=wrong))
    assert not np.allclose(found, whole, atol=1e-4 * float(whole.max()))


def test_errors_of_a_spectrum_are_those_of_its_wavelengths():
    """One wavelength of many has the standard error that it has by itself, from the same photons."""
    scene = jl.Scene(
        plates=[jl.Plate(5.0, 0.3, 0.4, coverage=0.5)], ground=jl.Ground(reflectance=optics()[-1][::20])
    )
    many = jl.Lidar(wavelength=WAVELENGTH[::20], divergence=2.0)
    how = {"key": jax.random.key(1), "n_photons": 8192, "max_orders": 5}
    spectrum = jl.simulate(many, scene, **how)
    for i in (3, 70):
        ground = jl.Ground(reflectance=float(scene.ground.reflectance[i]))
        alone = jl.simulate(
            jl.Lidar(wavelength=WAVELENGTH[20 * i], divergence=2.0),
            dataclasses.replace(scene, ground=ground),
            **how,
        )
        largest = float(alone.stderr.max())
        np.testing.assert_allclose(spectrum.stderr[i], alone.stderr[0], rtol=1e-3, atol=1e-3 * largest)
        np.testing.assert_allclose(spectrum.reflectance[i], alone.reflectance[0], rtol=1e-5, atol=1e-7)


def test_moments_of_few_wavelengths_are_those_of_all():
    """Over rounds of any size: what is kept of few, spread, is what batches at all wavelengths have."""
    random = np.random.default_rng(0)
    shares = random.uniform(-1.0, 1.0, (5, 40))
    short, whole = FewMoments(jnp.asarray(shares, jnp.float32)), WaveformMoments(40, 7)
    for batches in (8, 3, 21):
        for _ in range(batches):
            few = 2.0 + random.uniform(size=(5, 7))
            short.add(few)
            whole.add(np.pad(shares.T @ few, ((0, 2), (0, 1))))
        mine, each = short.spectra(), whole.spectra()
        # Asked again, as after an interrupt, they are the same.
        np.testing.assert_array_equal(mine.stderr, short.spectra().stderr)
        assert short.count == whole.count
        for name in ("whole", "stderr"):
            expected = getattr(each, name)
            np.testing.assert_allclose(getattr(mine, name), expected, atol=3e-6 * np.abs(expected).max())
        assert mine.relative == pytest.approx(each.relative, rel=1e-3)
        assert mine.largest == pytest.approx(each.largest, rel=1e-5)
