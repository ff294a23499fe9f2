"""Derivatives of a fit with respect to record, noise, lidar and scene: central differences of fits.

Fits end within a twentieth of a standard error of the minimum, so that steps of the differences move the
estimates by several. Records without noise leave no residual, which the derivatives neglect to second order.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import LogNormal, Recorder, Unknown
from inversion.fit.data import SampleNoise
from tests.helpers import ask

WINDOW = (-30.0, 30.0)
TRUTH = jl.Scene(ground=jl.Ground(height=0.5, reflectance=0.3, slope=5.0))
HEIGHT = Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
REFLECTANCE = Unknown("ground.reflectance", bounds=(0.0, 1.0), name="reflectance")


def lidar_of(fwhm=4.0):
    return jl.Lidar(pulse=jl.GaussianPulse(fwhm=fwhm), divergence=2.0)


WAVE = jl.simulate(lidar_of(), TRUTH, key=jax.random.key(0), window=WINDOW)
TIME, RECORD = np.asarray(WAVE.time), jnp.asarray(WAVE.reflectance)


def estimates(record, noise=0.002, fwhm=4.0, slope=5.0, unknowns=(HEIGHT, REFLECTANCE), **options):
    scene = jl.Scene(ground=jl.Ground(slope=slope))
    more = {"noise": noise, "time": TIME, "key": jax.random.key(1)} | options
    values = ask(inversion.retrieve, record, lidar_of(fwhm), scene, list(unknowns), **more).values
    return jnp.stack([value for _, value in sorted(values.items())])


def check(function, at, step, atol, rtol=0.03):
    """Compare forward and reverse derivatives with one another, and with a central difference."""
    forward = jax.jvp(function, (at,), (jnp.ones_like(at),))[1]
    _, pull = jax.vjp(function, at)
    reverse = jnp.stack([jnp.sum(pull(row)[0]) for row in jnp.eye(len(forward))])
    np.testing.assert_allclose(reverse, forward, rtol=1e-3, atol=1e-4 * float(jnp.max(jnp.abs(forward))))
    difference = (function(at + step) - function(at - step)) / (2.0 * step)
    np.testing.assert_allclose(forward, difference, rtol=rtol, atol=atol)
    return forward


def record_of(height, reflectance):
    scene = jl.Scene(ground=jl.Ground(height=height, reflectance=reflectance, slope=5.0))
    return jl.simulate(lidar_of(), scene, key=jax.random.key(0), window=WINDOW).reflectance


def higher_and_brighter(s):
    """Return the record of ground that is s m higher and brighter by 0.6 s, to first order."""
    return RECORD + s * HIGHER_AND_BRIGHTER


HIGHER_AND_BRIGHTER = (record_of(0.55, 0.33) - record_of(0.45, 0.27)) / 0.1


def test_the_record():
    forward = check(lambda s: estimates(higher_and_brighter(s)), jnp.asarray(0.0), 0.05, 0.01)
    np.testing.assert_allclose(forward, [1.0, 0.6], rtol=0.02)


@pytest.mark.slow
def test_lidar_and_scene():
    # A wrong pulse or slope leaves a residual: one of second order at the middle of the differences.
    check(lambda fwhm: estimates(RECORD, fwhm=fwhm), jnp.asarray(4.0), 0.2, 0.01)
    check(lambda slope: estimates(RECORD, slope=slope), jnp.asarray(5.0), 1.0, 0.001)


def test_priors_and_noise():
    # Record and priors disagree, so that the estimate depends on the weight of the record.
    unknowns = (
        Unknown("ground.height", bounds=(-2.0, 2.0), name="height", prior=(0.45, 0.01)),
        Unknown("ground.reflectance", bounds=(0.0, 1.0), name="reflectance", prior=LogNormal(0.27, 0.02)),
    )
    forward = check(lambda noise: estimates(RECORD, noise, unknowns=unknowns), jnp.asarray(0.003), 0.001, 0.2)
    assert np.all(np.abs(forward) > 1.0)
    check(lambda s: estimates(s * RECORD, 0.003, unknowns=unknowns), jnp.asarray(1.0), 0.05, 0.01)


def test_unknowns_at_a_bound_do_not_move():
    below = Unknown("ground.reflectance", bounds=(0.0, 0.25), name="reflectance", start=0.2)
    skewed = jnp.interp(TIME, TIME + 1.0, RECORD[0])[None] * 0.3 + 0.7 * RECORD
    forward = check(lambda s: estimates(s * skewed, unknowns=(HEIGHT, below)), jnp.asarray(1.0), 0.05, 0.01)
    assert float(forward[1]) == 0.0


def test_what_a_recorder_adds():
    recorder = Recorder(width=(0.1, 5.0), offset=(-0.1, 0.1), correlation=0.3)

    def with_recorder(s):
        record = s * RECORD + 0.01 * s
        return estimates(record, recorder=recorder, unknowns=(HEIGHT,), scale=(0.1, 10.0))

    # Height, offset, width and scale; the offset follows the record, and so does the scale.
    forward = check(with_recorder, jnp.asarray(1.0), 0.1, 0.02)
    np.testing.assert_allclose(forward[1], 0.01, atol=1e-3)


def test_several_wavelengths_and_left_out_samples():
    lidar = jl.Lidar(wavelength=(532.0, 1064.0))
    wave = jl.simulate(lidar, TRUTH, key=jax.random.key(0), window=WINDOW)
    noise = np.full(wave.reflectance.shape, 0.002)
    noise[0] = np.inf
    record = jnp.where(jnp.isfinite(noise), wave.reflectance, jnp.nan)

    def reflectance(record):
        more = {"noise": noise, "time": wave.time, "key": jax.random.key(1)}
        return ask(inversion.retrieve, record, lidar, TRUTH, [REFLECTANCE], **more).values["reflectance"]

    gradient = jax.grad(reflectance)(record)
    np.testing.assert_array_equal(gradient[0], 0.0)
    np.testing.assert_allclose(jnp.sum(gradient[1] * wave.reflectance[1]), 0.3, rtol=0.01)


def test_a_waveform_and_the_fitted_scene():
    # Everything else of the result is as without derivatives.
    fits = []

    def reflectance_of_fit(wave):
        scene, key = jl.Scene(ground=jl.Ground()), jax.random.key(1)
        fits.append(
            ask(inversion.retrieve, wave, lidar_of(), scene, [REFLECTANCE, HEIGHT], noise=0.002, key=key)
        )
        return fits[-1].scene.ground.reflectance

    gradient = eqx.filter_grad(reflectance_of_fit)(WAVE)
    np.testing.assert_allclose(jnp.sum(gradient.reflectance * WAVE.reflectance), 0.3, rtol=0.02)
    assert fits[0].converged
    assert "converged after" in fits[0].status


@pytest.mark.slow
def test_within_programs():
    scene, key = jl.Scene(ground=jl.Ground(slope=5.0)), jax.random.key(1)

    def fit(record, **options):
        unknowns, more = [HEIGHT, REFLECTANCE], {"noise": 0.002, "time": TIME, "key": key, **options}
        return ask(inversion.retrieve, record, lidar_of_program, scene, unknowns, **more)

    lidar_of_program = lidar_of()
    alone, within = fit(RECORD), jax.jit(fit)(RECORD)
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(within), strict=True):
        np.testing.assert_array_equal(a, b)
    assert within.converged
    assert not jax.jit(lambda record: fit(record, max_steps=1))(RECORD).converged
    assert "program" in within.status

    def height(record):
        return fit(record).values["height"]

    np.testing.assert_allclose(jax.jit(jax.grad(height))(RECORD), jax.grad(height)(RECORD), rtol=1e-6)
    records = jnp.stack([higher_and_brighter(s) for s in (-0.1, 0.1)])
    np.testing.assert_allclose(jax.vmap(height)(records), jnp.stack([*map(height, records)]), rtol=1e-6)


def test_a_scene_that_a_program_traces_needs_a_plan():
    with pytest.raises(ValueError, match="plan = None, but the lidar, the scene or the times"):
        jax.jit(lambda slope: estimates(RECORD, slope=slope))(5.0)


def test_second_derivatives_are_refused():
    with pytest.raises(ValueError, match="do not support JVP"):
        jax.hessian(lambda s: estimates(s * RECORD)[1])(1.0)


def test_precision_is_the_inverse_of_the_covariance():
    random = np.random.default_rng(0)
    sigma, shared = random.uniform(0.5, 2.0, 5), random.normal(size=(5, 2))
    correlation = 0.4 ** np.abs(np.subtract.outer(np.arange(5), np.arange(5)))
    x = random.normal(size=(5, 3))
    covariance = correlation * np.outer(sigma, sigma) + shared @ shared.T
    noise = SampleNoise(sigma, shared, correlation)
    np.testing.assert_allclose(noise.times_precision(x), np.linalg.solve(covariance, x))
    np.testing.assert_allclose(SampleNoise(sigma).times_precision(x), x / sigma[:, None] ** 2)


@pytest.mark.slow
def test_a_canopy_with_higher_orders():
    lidar = lidar_of()
    options = {"noise": 0.001, "key": jax.random.key(1), "n_photons": 4096, "n_rays": 64, "max_orders": 3}

    def scene(density=0.5, reflectance=0.3):
        lad = jnp.full((1, 1, 4), density)
        voxels = jl.VoxelMap.from_lad(lad, voxel_size=2.0, origin=(-1.0, -1.0, 0.0))
        canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.3), sides="periodic")
        return jl.Scene(canopy=canopy, ground=jl.Ground(height=-0.5, reflectance=reflectance))

    def scale_leaf_area(scene, factor):
        return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda leaf: factor * leaf)

    factor = Unknown(apply=scale_leaf_area, name="factor", start=1.0, bounds=(0.3, 3.0))
    height = Unknown("ground.height", bounds=(-1.0, 0.0), name="height")
    planned = {"window": (-80.0, 20.0), "n_photons": 20000, "max_orders": 3}
    wave = jl.simulate(lidar, scene(0.6), key=jax.random.key(0), **planned)

    def estimates(density, reflectance):
        fit = ask(inversion.retrieve, wave, lidar, scene(density, reflectance), [factor, height], **options)
        return jnp.stack([fit.values["factor"], fit.values["height"]])

    # Leaf area is fitted: its factor is inversely proportional to the density that it multiplies.
    forward = check(lambda density: estimates(density, 0.3), jnp.asarray(0.5), 0.05, 0.02)
    np.testing.assert_allclose(forward, [-float(estimates(0.5, 0.3)[0]) / 0.5, 0.0], atol=1e-3, rtol=1e-3)
    check(lambda reflectance: estimates(0.5, reflectance), jnp.asarray(0.3), 0.02, 0.05)
