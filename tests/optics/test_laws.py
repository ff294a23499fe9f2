"""Laws of reflection and phase functions: the built-in ones, and Minnaert's from `examples/minnaert.py`.

Samples are tested against densities (chi-squared over cells of equal solid angle), densities against
intensity factors, both for conservation and reciprocity, and returns against the closed form

    sum of apparent reflectance = R (k + 1) / 2 cos^(2 k - 1)(slope)

of Minnaert's law; its derivatives against differences of converged means.
"""

import importlib.util
from pathlib import Path
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution

import jaxlidar as jl
from jaxlidar.extend import dot, vec
from tests.helpers import SINGLE_SAMPLE, agrees, batch_mean, single_sample_lidar, slow_unless

ROOT = Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("minnaert", ROOT / "examples" / "minnaert.py")
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
Minnaert = module.Minnaert

UP = (0.0, 0.0, 1.0)
TILTED = tuple(np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0]))
LAWS = {
    "Lambertian": jl.Lambertian(),
    "equal-angle": jl.EqualAngle(),
    "Minnaert 1.5": Minnaert(k=1.5),
    "Minnaert 4": Minnaert(k=4.0),
}
PHASES = {
    "isotropic": jl.Isotropic(albedo=0.5),
    "forward": jl.HenyeyGreenstein(albedo=0.5, g=0.7),
    "backward": jl.HenyeyGreenstein(albedo=0.5, g=-0.4),
    "nearly isotropic": jl.HenyeyGreenstein(albedo=0.5, g=1e-3),
}


def direction(zenith, azimuth):
    """Downward direction of travel, of angles in degrees; the zenith is that of the opposite direction."""
    z, a = np.deg2rad(zenith), np.deg2rad(azimuth)
    return np.array([np.sin(z) * np.cos(a), np.sin(z) * np.sin(a), -np.cos(z)])


def arrays(vector, like):
    """One vector for each element of the array `like`."""
    return vec(jnp.full(like.shape, c, like.dtype) for c in vector)


def sphere(polar=400, azimuth=200):
    """Directions and their solid angles: Gauss-Legendre in the cosine, even in azimuth."""
    x, weight = np.polynomial.legendre.leggauss(polar)
    phi = (np.arange(azimuth) + 0.5) * (2 * np.pi / azimuth)
    c, a = (m.ravel() for m in np.meshgrid(x, phi, indexing="ij"))
    s = np.sqrt(1 - c * c)
    directions = vec(jnp.asarray(v) for v in (s * np.cos(a), s * np.sin(a), c))
    return directions, np.repeat(weight, azimuth) * (2 * np.pi / azimuth)


def density_of(law, incident, normal, out):
    """Density of a law of reflection, or of a phase function, which has no normal."""
    if isinstance(law, jl.AbstractPhase):
        return law.density(incident, out)
    return law.density(incident, normal, out)


def sample_from(law, incident, normal, u, v):
    """Directions drawn from a law of reflection, or from a phase function, which has no normal."""
    if isinstance(law, jl.AbstractPhase):
        return law.sample(incident, u, v)
    return law.sample(incident, normal, u, v)


def cells(out):
    """Number of the cell, 24 in height and 12 in azimuth, of equal solid angle."""
    x, y, z = (np.asarray(c, float) for c in out)
    height = np.clip(((z + 1) * 12).astype(int), 0, 23)
    azimuth = ((np.arctan2(y, x) / (2 * np.pi)) % 1.0 * 12).astype(int) % 12
    return 12 * height + azimuth


def p_value(sampler, density, normal=TILTED, samples=200_000, seed=7):
    """P-value of the hypothesis that directions drawn from `sampler` have the density of `density`."""
    u, v = jax.random.uniform(jax.random.key(seed), (2, samples), minval=1e-7)
    incident = arrays(direction(35.0, 20.0), u)
    drawn = sample_from(sampler, incident, arrays(normal, u), u, v)
    # The horizon, where densities jump, crosses cells: integrate finely.
    out, weight = sphere(1440, 720)
    like = out[0]
    p = np.asarray(density_of(density, arrays(direction(35.0, 20.0), like), arrays(normal, like), out), float)
    expected = samples * np.bincount(cells(out), p * weight, 288)
    observed = np.bincount(cells(drawn), minlength=288)
    # Chi-squared needs counts that are nearly normal: rare cells are counted together.
    is_rare = expected < 20
    expected = np.append(expected[~is_rare], expected[is_rare].sum())
    observed = np.append(observed[~is_rare], observed[is_rare].sum())
    expected, observed = expected[expected > 1], observed[expected > 1]
    statistic = np.sum((observed - expected) ** 2 / expected)
    return chi2_distribution.sf(statistic, len(expected) - 1)


@pytest.mark.parametrize("name", [*LAWS, *PHASES])
def test_samples_have_the_density(name):
    law = (LAWS | PHASES)[name]
    assert p_value(law, law) > 1e-3


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("Minnaert 1.5", jl.Lambertian()), ("forward", jl.HenyeyGreenstein(albedo=0.5, g=0.68))],
)
def test_a_wrong_density_is_noticed(name, wrong):
    assert p_value((LAWS | PHASES)[name], wrong) < 1e-6


@pytest.mark.parametrize("name", [*LAWS, *PHASES])
@pytest.mark.parametrize("zenith", [0.0, 50.0, 80.0])
def test_laws_conserve_energy_and_agree_with_themselves(name, zenith):
    law = (LAWS | PHASES)[name]
    out, weight = sphere()
    incident, normal = arrays(direction(zenith, 40.0), out[0]), arrays(UP, out[0])
    density = np.asarray(density_of(law, incident, normal, out), float)
    # The equal-angle density is singular at the normal, and softened there.
    assert np.sum(density * weight) == pytest.approx(1.0, abs=5e-3 if name == "equal-angle" else 1e-4)
    if isinstance(law, jl.AbstractPhase):
        factor, albedo, bound = law.intensity_factor(incident, out), 1.0, law.largest_intensity_factor()
    else:
        albedo = np.asarray(law.albedo(incident, normal), float)
        assert np.all((albedo >= 0) & (albedo <= 1))
        # A wider aperture would soften the equal-angle singularity visibly.
        half_angle = 2e-4
        factor = law.intensity_factor(incident, normal, out, jnp.asarray(half_angle))
        bound = law.largest_intensity_factor(half_angle)
    factor = np.asarray(factor, float)
    np.testing.assert_allclose(factor, np.pi * albedo * density, rtol=2e-3, atol=1e-6)
    assert np.max(factor) <= bound * (1 + 1e-5)


def test_minnaert_is_reciprocal_and_equal_angle_is_not():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 3, 1000))
    a, b = (np.stack([*v[:2], np.abs(v[2])]) / np.linalg.norm(v, axis=0) for v in (a, b))
    up = arrays(UP, jnp.zeros(1000))

    def asymmetry(law):
        """Largest relative change of the BRDF when incident and view direction are exchanged."""

        def brdf(source, out):
            incident, out = (vec(jnp.asarray(v)) for v in (-source, out))
            intensity = law.intensity_factor(incident, up, out, jnp.asarray(1e-3))
            return np.asarray(intensity / dot(up, out), float)

        return np.max(np.abs(brdf(a, b) / brdf(b, a) - 1))

    assert asymmetry(Minnaert(k=2.5)) < 1e-4
    assert asymmetry(jl.EqualAngle()) > 0.1


@pytest.mark.parametrize("slope", [0.0, 30.0])
def test_first_return_of_minnaert(slope):
    """With k = 1.7: R (k + 1)/2 cos^(2 k - 1) returns, R cos^(k - 1) is reflected."""
    scene = jl.Scene(ground=jl.Ground(reflectance=0.4, slope=slope, law=Minnaert(k=1.7)))
    lidar = single_sample_lidar()
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), **SINGLE_SAMPLE)
    cosine = np.cos(np.deg2rad(slope))
    assert float(wave.reflectance.sum()) == pytest.approx(0.4 * 1.35 * cosine**2.4, rel=1e-4)
    # Light that the law does not scatter is absorbed.
    assert float(wave.energy_budget["absorbed by ground"][0]) == pytest.approx(
        1 - 0.4 * cosine**0.7, rel=1e-4
    )
    assert float(sum(wave.energy_budget.values())[0]) == pytest.approx(1.0, abs=1e-5)


def below_plate(p, law=Minnaert):
    """Sloping ground below a half-open plate that scatters diffusely: light reaches it from all sides."""
    plate = jl.Plate(height=4.0, reflectance=0.4, transmittance=0.5, coverage=0.6, transmission="diffuse")
    ground = jl.Ground(reflectance=0.9, slope=p["slope"], aspect=20.0, law=law(k=p["k"]))
    return jl.Scene(plates=(plate,), ground=ground)


START = {"slope": jnp.asarray(20.0), "k": jnp.asarray(1.6)}
LIDAR = single_sample_lidar()


@pytest.mark.slow
def test_the_energy_budget_of_all_orders_adds_up():
    wave = jl.simulate(LIDAR, below_plate(START), key=jax.random.key(1), n_photons=65536, **SINGLE_SAMPLE)
    assert float(sum(wave.energy_budget.values())[0]) == pytest.approx(1.0, abs=1e-4)


def derivative_error(law, name, step):
    """Difference of derivatives by JAX and by central differences, means of batches; its standard error."""
    plan = jl.plan(
        LIDAR, below_plate(START, law), max_orders=4, n_photons=524288, n_rays=512, **SINGLE_SAMPLE
    )

    def measure(value, key):
        setup = jl.make_setup(LIDAR, below_plate(START | {name: value}, law), plan)
        return jl.waveform_of(jl.trace_scene(setup, key), setup).components["higher"].sum()

    derivative = jax.jit(lambda v, k: jax.jvp(lambda v: measure(v, k), (v,), (jnp.ones_like(v),))[1])
    value = jax.jit(measure)
    by_jax = np.array([derivative(START[name], k) for k in jax.random.split(jax.random.key(3), 12)])
    keys = jax.random.split(jax.random.key(4), 24)
    # The same keys on both sides: their noise nearly cancels.
    lower, upper = (np.array([value(START[name] + s, k) for k in keys]) for s in (-step, step))
    differences = (upper - lower) / (2 * step)
    stderr = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in (by_jax, differences)))
    return by_jax.mean() - differences.mean(), stderr


@pytest.mark.slow
@pytest.mark.parametrize(("name", "step"), slow_unless([("slope", 1.0)], [("k", 0.05), ("slope", 1.0)]))
def test_derivatives_of_a_law_of_ones_own(name, step):
    error, stderr = derivative_error(Minnaert, name, step)
    assert abs(error) < 4 * stderr


@final
class WrongDensity(jl.AbstractLaw):
    """Minnaert's law with Lambert's density in place of its own."""

    k: jax.Array

    def intensity_factor(self, incident, normal, view, half_angle):
        return Minnaert(self.k).intensity_factor(incident, normal, view, half_angle)

    def albedo(self, incident, normal):
        return Minnaert(self.k).albedo(incident, normal)

    def sample(self, incident, normal, u, v):
        return Minnaert(self.k).sample(incident, normal, u, v)

    def density(self, incident, normal, out):
        return jl.Lambertian().density(incident, normal, out)

    def largest_intensity_factor(self, half_angle):
        return Minnaert(self.k).largest_intensity_factor(half_angle)


@pytest.mark.slow
def test_a_density_that_is_wrong_spoils_derivatives_visibly():
    error, stderr = derivative_error(WrongDensity, "k", 0.05)
    assert abs(error) > 6 * stderr


@pytest.mark.slow
def test_the_anisotropy_of_leaves_above_ground_is_counted_once():
    """Photons that leaves send to the ground under voxels: z-test against differences of converged means.

    Planted: the derivative of their density twice, when they are sent on and when their landing points move.
    """
    voxels = jl.VoxelMap.from_lad(np.full((12, 12, 2), 0.4), voxel_size=1.0, origin=(-6.0, -6.0, 3.0))
    lidar, ground, g, step = jl.Lidar(divergence=3.0), jl.Ground(reflectance=0.5), 0.3, 0.05

    def scene_of(g):
        return jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.HenyeyGreenstein(0.8, g)), ground=ground)

    plan = jl.plan(lidar, scene_of(g), max_orders=2, window=(-90.0, 80.0), n_photons=16384, n_rays=64)

    @jax.jit
    def value_and_derivative(g, key):
        def from_ground(g):
            wave = jl.simulate(lidar, scene_of(g), plan=plan, key=key)
            return wave.components["ground"].sum()

        return jax.jvp(from_ground, (g,), (1.0,))

    keys = jax.random.split(jax.random.key(3), 16)
    derivative = np.array([value_and_derivative(g, key)[1] for key in keys[:8]])
    upper, lower = (
        np.array([value_and_derivative(g + s, key)[0] for key in keys[8:]]) for s in (step, -step)
    )
    difference = (upper - lower) / (2.0 * step)
    stderr = np.hypot(*(x.std(ddof=1) / np.sqrt(x.size) for x in (derivative, difference)))
    assert abs(derivative.mean() - difference.mean()) < 4.0 * stderr
    assert abs(2.0 * derivative.mean() - difference.mean()) > 20.0 * stderr


def total_return(wave):
    """Apparent reflectance of the whole record, by wavelength."""
    return wave.reflectance.sum(axis=1)


@pytest.mark.slow
def test_scattering_between_surfaces_follows_the_law():
    """Three scatterings: a plate that transmits all light diffusely, Minnaert's ground, and the plate again.

    The plate (R = 0, T = 1, opaque) sends all light down by the cosine law. The ground reflects the fraction
    R 2/(k + 1) of diffuse light, and the plate transmits all of it, by the cosine law again: the sum is
    R 2/(k + 1).
    """
    plate = jl.Plate(height=4.0, reflectance=0.0, transmittance=1.0, transmission="diffuse")
    scene = jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=0.5, law=Minnaert(k=2.0)))
    plan = jl.plan(LIDAR, scene, max_orders=3, n_photons=131072, n_rays=64, **SINGLE_SAMPLE)
    mean, stderr = batch_mean(LIDAR, scene, plan, seed=2, count=16, quantity=total_return)
    assert agrees(mean, stderr, 0.5 * 2 / 3, bound=1e-3, sigmas=4.0)
    assert not agrees(mean, stderr, 0.5, bound=1e-3, sigmas=4.0)


BAD = [
    (lambda: jl.HenyeyGreenstein(albedo=1.2), r"albedo = 1.2 is outside the admissible range \[0, 1\]"),
    (
        lambda: jl.HenyeyGreenstein(albedo=0.5, g=1.0),
        r"g = 1 is outside the admissible range \[-0.95, 0.95\]",
    ),
    (lambda: jl.Specular(roughness=-0.1), r"roughness = -0.1 is outside the admissible range \[0, 0.5\]"),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()
