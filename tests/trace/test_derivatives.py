"""Derivatives by automatic differentiation against central differences of converged means.

A crown of 6 x 5 x 8 random voxels of leaf and bark over ground (and, in the second scene, a half-open plate
beneath it), five orders. The functionals are the first three moments of the waveform in time: the zeroth
depends on the returned energy, the others on its times. Both sides are means over independent keys, and their
difference is tested against its standard error. The level is Sidak's for all comparisons of one scene at 1 in
1,000.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import jaxlidar as jl

pytestmark = pytest.mark.slow

KEYS = 12
RANDOM = np.random.default_rng(5)
LEAF, BARK = RANDOM.uniform(0, 1, (6, 5, 8)), RANDOM.uniform(0, 0.3, (6, 5, 8))

# Parameter: value and half the step of the central difference.
COMMON = {
    "leaf extinction": (1.0, 0.1),
    "bark extinction": (1.0, 0.1),
    "one voxel": (1.0, 0.5),
    "voxel size": (1.0, 0.02),
    "canopy height": (1.0, 0.05),
    "ground height": (0.2, 0.05),
    "leaf reflectance": (0.4, 0.05),
    "ground reflectance": (0.5, 0.05),
}
SCENES = {
    "nadir, slope": (0.0, COMMON | {"slope": (10.0, 1.0)}),
    "off nadir, plate": (12.0, COMMON | {"plate height": (0.7, 0.05), "coverage": (0.5, 0.05)}),
}


def build(p):
    """Return the scene of a dict of parameters; those that it lacks have their values of `COMMON`."""
    p = {name: jnp.asarray(value) for name, (value, _) in COMMON.items()} | p
    leaf = jnp.asarray(LEAF) * p["leaf extinction"]
    leaf = leaf.at[2, 2, 6].mul(p["one voxel"])
    voxels = jl.VoxelMap.from_extinction(
        leaf=leaf,
        bark=jnp.asarray(BARK) * p["bark extinction"],
        voxel_size=0.5 * p["voxel size"] * jnp.ones(3),
        origin=jnp.stack([jnp.asarray(-1.5), jnp.asarray(-1.25), p["canopy height"]]),
    )
    optics = jl.LeafOptics(reflectance=p["leaf reflectance"], transmittance=0.3)
    plates = ()
    if "coverage" in p:
        plate = jl.Plate(height=p["plate height"], reflectance=0.3, transmittance=0.3, coverage=p["coverage"])
        plates = (plate,)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=optics, bark=0.3, hotspot=False),
        plates=plates,
        ground=jl.Ground(
            height=p["ground height"],
            reflectance=p["ground reflectance"],
            slope=p.get("slope", 0.0),
            aspect=30.0,
        ),
    )


@pytest.fixture(scope="module", params=SCENES)
def estimates(request):
    """Derivatives by AD and by differences for every parameter, of shape (keys, moments) each."""
    zenith, table = SCENES[request.param]
    lidar = jl.Lidar(
        divergence=2.0, pulse=jl.GaussianPulse(fwhm=4.0), zenith=zenith, azimuth=0.0, wavelength=1064.0
    )
    start = {name: jnp.asarray(value) for name, (value, _) in table.items()}
    plan = jl.plan(lidar, build(start), max_orders=5, n_photons=65536, window=(-60.0, 80.0))
    time = np.arange(plan.n_samples) / 50.0
    moments = jnp.asarray(np.stack([np.ones_like(time), time, time**2], axis=1))

    def measure(p, key):
        scene = build(p)
        setup = jl.make_setup(lidar, scene, plan)
        return jl.total_reflectance(jl.trace_scene(setup, key), setup)[0] @ moments

    value, jacobian = jax.jit(measure), jax.jit(jax.jacfwd(measure))
    keys = jax.random.split(jax.random.key(11), KEYS)
    jacobians = [jacobian(start, k) for k in keys]
    # Other keys, so that the two sides are independent.
    other_keys = jax.random.split(jax.random.key(12), 2 * KEYS)
    estimates_by_name = {}
    for name, (middle, step) in table.items():
        values = [
            np.array([value(start | {name: jnp.asarray(middle + s)}, k) for k in other_keys])
            for s in (-step, step)
        ]
        estimates_by_name[name] = (
            np.array([e[name] for e in jacobians]),
            (values[1] - values[0]) / (2 * step),
        )
    return estimates_by_name


def z_scores(exact, difference):
    """Return the difference of the two means over its standard error."""
    spread = np.sqrt(sum(np.var(a, axis=0, ddof=1) / len(a) for a in (exact, difference)))
    return (exact.mean(axis=0) - difference.mean(axis=0)) / spread


def limit(comparisons):
    """Return the two-sided bound on |z| at a level of 1 in 1,000 for all comparisons together (Sidak)."""
    return norm.isf(0.5 * (1 - 0.999 ** (1 / comparisons)))


def test_derivatives_agree_with_differences(estimates):
    bound = limit(3 * len(estimates))
    scores = {name: z_scores(*pair) for name, pair in estimates.items()}
    wrong = {name: z for name, z in scores.items() if np.any(np.abs(z) > bound)}
    assert not wrong


def test_a_planted_wrong_derivative_is_rejected(estimates):
    """The test has the power to reject derivatives 30 % or 50 % too large, and one of the wrong sign."""
    bound = limit(3 * len(estimates))
    for name, factor in (("voxel size", 1.5), ("ground reflectance", 1.3), ("canopy height", -1.0)):
        exact, difference = estimates[name]
        assert np.any(np.abs(z_scores(factor * exact, difference)) > bound), name


def test_derivatives_are_not_noisier_than_their_differences(estimates):
    """The spread per key of AD stays within a few times that of differences at common keys."""
    for name, (exact, difference) in estimates.items():
        assert np.all(np.std(exact, axis=0) < 10 * np.std(difference, axis=0)), name


def test_forward_and_reverse_agree():
    """The derivative along v by forward mode is the product of v and the gradient by reverse mode."""
    _, table = SCENES["nadir, slope"]
    lidar = jl.Lidar(divergence=2.0, wavelength=1064.0)
    start = {name: jnp.asarray(value) for name, (value, _) in table.items()}
    plan = jl.plan(lidar, build(start), max_orders=3, n_photons=2048, n_rays=128, window=(-60.0, 40.0))
    key = jax.random.key(0)

    def measure(p):
        scene = build(p)
        setup = jl.make_setup(lidar, scene, plan)
        return jnp.sum(jl.total_reflectance(jl.trace_scene(setup, key), setup) ** 2)

    gradient = eqx.filter_jit(jax.grad(measure))(start)
    tangent = {name: jnp.asarray(0.5 + 0.1 * i) for i, name in enumerate(start)}
    forward = eqx.filter_jit(lambda: jax.jvp(measure, (start,), (tangent,))[1])()
    reverse = sum(gradient[name] * tangent[name] for name in start)
    assert float(forward) == pytest.approx(float(reverse), rel=2e-4)
