"""Degenerate but admissible input: values and derivatives are finite in both precisions.

Layout: small scenes at the limits of admissible input, with few photons. Values must be finite, and forward
and reverse derivatives those of one function: with g the gradient of the sum of all outputs, the derivative
along ones sums to the sum of g. Tolerance of that: 1 % of the sum of |g|, for rounding only, since both
differentiate the same random numbers. Scenes of one family share a plan, so that it is compiled once.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import BY_PRECISION, slow_unless

SIZE = (2, 2, 3)


@eqx.filter_jit
def evaluate(lidar, scene, plan, key, mode):
    """Return a waveform and its derivatives with respect to all numbers of lidar and scene, by one mode."""
    arrays, static = eqx.partition((lidar, scene), eqx.is_inexact_array)

    def simulated(arrays):
        beam, target = eqx.combine(arrays, static)
        setup = jl.make_setup(beam, target, plan)
        wave = jl.waveform_of(jl.trace_scene(setup, key), setup)
        diagnostics = (wave.components, wave.neglected, wave.energy_budget, wave.time, wave.height)
        return (wave.reflectance, wave.energy / 1e-12), diagnostics

    if mode == "forward":
        tangents = jax.tree.map(jnp.ones_like, arrays)
        return jax.jvp(simulated, (arrays,), (tangents,), has_aux=True)
    outputs, pull, diagnostics = jax.vjp(simulated, arrays, has_aux=True)
    (gradient,) = pull(jax.tree.map(jnp.ones_like, outputs))
    return outputs, gradient, diagnostics


def check(lidar, scene, plan, modes=("reverse",)):
    """Assert that results are finite and of the precision in use, and that derivatives of all modes agree."""
    totals, scale = [], 0.0
    for mode in modes:
        results = evaluate(lidar, scene, plan, jax.random.key(24), mode)
        for name, tree in zip(("value", mode, "diagnostics"), results):
            for path, leaf in jax.tree.leaves_with_path(tree):
                leaf_path = f"{name}{jax.tree_util.keystr(path)}"
                assert np.all(np.isfinite(leaf)), leaf_path
                assert leaf.dtype == jnp.zeros(()).dtype, leaf_path
        terms = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(results[1])]).astype(float)
        totals.append(terms.sum())
        scale = max(scale, np.sum(np.abs(terms)))
    assert np.ptp(totals) <= 0.01 * scale


def canopy(
    p_leaf=0.3, p_bark=0.1, optics=(0.4, 0.3), bark=0.3, ground=0.5, height=0.0, slope=0.0, lidar=None
):
    voxels = jl.VoxelMap.from_probability(
        leaf=np.broadcast_to(p_leaf, SIZE),
        bark=np.broadcast_to(p_bark, SIZE),
        voxel_size=1.0,
        origin=(-1, -1, 1),
    )
    leaf = jl.LeafOptics(reflectance=optics[0], transmittance=optics[1])
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, bark=bark, hotspot=False),
        ground=jl.Ground(height=height, slope=slope, reflectance=ground),
    )
    beam = {"field_of_view": 1.0} | (lidar or {})
    return jl.Lidar(pulse=jl.GaussianPulse(fwhm=beam.pop("pulse_width", 6.0)), **beam), scene


ALTERNATING = np.indices(SIZE).sum(axis=0) % 2
CANOPIES = {
    "ordinary": {},
    "nothing absorbs": {"optics": (0.6, 0.4), "bark": 1.0, "ground": 1.0},
    "everything absorbs": {"optics": (0.0, 0.0), "bark": 0.0, "ground": 0.0},
    "leaves only transmit": {"optics": (0.0, 1.0)},
    "all empty": {"p_leaf": 0.0, "p_bark": 0.0},
    "all solid": {"p_leaf": 1.0, "p_bark": 1.0},
    "no bark": {"p_bark": 0.0},
    "a chequer of nothing and solid": {"p_leaf": ALTERNATING, "p_bark": 1 - ALTERNATING},
    "optical depth 1e-8": {"p_leaf": 1e-8, "p_bark": 1e-8},
    "along the edges of voxels": {"lidar": {"divergence": 0.0}},
    "along a face of the map": {"lidar": {"divergence": 0.0, "position": (-1.0, 0.3)}},
    "along a corner of the map": {"lidar": {"divergence": 0.0, "position": (1.0, 1.0)}},
    "past the map": {"lidar": {"divergence": 0.0, "position": (1.5, 0.0)}},
    "within a voxel": {"lidar": {"divergence": 0.0, "position": (0.5, 0.5)}},
    "ground within the canopy": {"height": 2.3},
    "ground on a face of voxels": {"height": 2.0},
    "ground at the top": {"height": 4.0},
    "ground above the canopy": {"height": 4.5},
    "slope of 80 degrees": {"slope": 80.0},
    "slope of 80 degrees within the canopy": {"slope": 80.0, "height": 2.5},
    "from 400 km": {"lidar": {"altitude": 4e5, "divergence": 1e-3, "aperture": 0.8}},
    "a field of view within the footprint": {"lidar": {"field_of_view": 0.1}},
    "a pulse without width": {"lidar": {"pulse_width": 0.0}},
    "a hairline's aperture": {"lidar": {"aperture": 1e-6}},
}


def plan_of(lidar, scene, **changes):
    settings = {"max_orders": 3, "n_photons": 512, "n_rays": 32, "window": (-45.0, 15.0), "bin_width": 1.0}
    return jl.plan(lidar, scene, **(settings | changes))


@pytest.mark.slow
@pytest.mark.parametrize("name", CANOPIES)
def test_canopies(name, precision):
    plan = plan_of(*canopy(height=4.5, slope=80.0))
    check(*canopy(**CANOPIES[name]), plan, ("forward", "reverse"))


# Classes, not instances: a test constructs them in the precision that it runs in.
LAWS = {"Lambertian": jl.Lambertian, "equal-angle": jl.EqualAngle, "mirror": jl.Specular}
GROUNDS = {
    "met at the normal": ({}, {}),
    "black": ({}, {"reflectance": 0.0}),
    "without divergence": ({"divergence": 0.0}, {}),
    "without width or divergence": ({"divergence": 0.0, "length": 0.0}, {}),
    "steep": ({}, {"slope": 80.0}),
    "nearly upright": ({}, {"slope": 89.9}),
    "from 400 km": ({"altitude": 4e5, "divergence": 1e-3, "aperture": 0.8}, {}),
    "grazing": ({"zenith": 89.0}, {}),
}


@pytest.mark.parametrize("law", slow_unless(["Lambertian"], LAWS))
@pytest.mark.parametrize("name", GROUNDS)
@BY_PRECISION
def test_grounds(name, law, ground_plans, precision):
    beam, ground = GROUNDS[name]
    beam = dict(beam)
    lidar = jl.Lidar(pulse=jl.RectangularPulse(length=beam.pop("length", 4.0)), **beam)
    scene = jl.Scene(ground=jl.Ground(law=LAWS[law](), **ground))
    check(lidar, scene, ground_plans[law])


def test_a_mirror_that_is_tilted_away_returns_nothing():
    scene = jl.Scene(ground=jl.Ground(law=jl.Specular(), slope=10.0))
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), rtol=0.1)
    np.testing.assert_array_equal(wave.reflectance, 0.0)


@pytest.fixture(scope="module")
def ground_plans():
    """One plan for each law; grounds at grazing angles reach far beyond its window, which is admissible."""
    lidar = jl.Lidar(pulse=jl.RectangularPulse(length=4.0))
    scenes = {name: jl.Scene(ground=jl.Ground(slope=80.0, law=law())) for name, law in LAWS.items()}
    return {name: jl.plan(lidar, scene, window=(-20.0, 20.0)) for name, scene in scenes.items()}


@BY_PRECISION
def test_a_scene_with_nothing_in_it(precision):
    lidar = jl.Lidar()
    wave = jl.simulate(lidar, jl.Scene(), key=jax.random.key(0))
    np.testing.assert_array_equal(wave.reflectance, 0.0)
    np.testing.assert_allclose(wave.energy_budget["escaped"], 1.0, rtol=1e-5)
    check(lidar, jl.Scene(), jl.plan(lidar, jl.Scene()), ("forward", "reverse"))


@pytest.mark.slow
@BY_PRECISION
def test_one_voxel_and_one_sample(precision):
    """Of optical depth 1e-8, 1 and 1e4, first order: 2/3 R (1 - exp(-2 tau)) / 2."""
    lidar = jl.Lidar(pulse=jl.RectangularPulse(length=0.0), divergence=1e-3, sampling_interval=100.0)
    leaf = jl.LeafOptics(reflectance=0.6, transmittance=0.0)

    def scene(tau):
        voxels = jl.VoxelMap.from_extinction(
            leaf=np.full((1, 1, 1), tau), voxel_size=1.0, origin=(-0.4, -0.4, 0)
        )
        return jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, hotspot=False))

    plan = jl.plan(
        lidar, scene(1.0), max_orders=1, n_rays=1, window=(0.0, 1.0), bin_width=5.0, footprint="fixed"
    )
    assert plan.n_samples == 1
    for tau in (0.0, 1e-8, 1.0, 1e4):
        check(lidar, scene(tau), plan)
        wave = jl.simulate(lidar, scene(tau), key=jax.random.key(0), plan=plan)
        np.testing.assert_allclose(wave.reflectance, [[-0.2 * np.expm1(-2 * tau)]], rtol=1e-4)


PLATES = {
    "a millimetre above the ground": {},
    "below the ground": {"height": -0.5},
    "nowhere": {"coverage": 0.0},
    "everywhere": {"coverage": 1.0},
    "lossless": {"reflectance": 0.5, "transmittance": 0.5},
    "black": {"reflectance": 0.0, "transmittance": 0.0},
    "upright, nearly": {"slope": 80.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("transmission", ["straight", "diffuse"])
@pytest.mark.parametrize("name", PLATES)
def test_plates(name, transmission, precision):
    usual = {"height": 1e-3, "reflectance": 0.3, "transmittance": 0.4, "coverage": 0.5}

    def scene(**changes):
        plate = jl.Plate(transmission=transmission, **(usual | changes))
        return jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=1.0))

    lidar = jl.Lidar()
    check(lidar, scene(**PLATES[name]), plan_of(lidar, scene(slope=80.0)), ("forward", "reverse"))


OBLIQUE = {
    "ordinary": {},
    "opaque": {"tau": 1e4},
    "thin": {"tau": 1e-8},
    "empty": {"tau": 0.0},
    "lossless": {"reflectance": 0.5, "transmittance": 0.5, "ground": 1.0},
    "grazing": {"zenith": 85.0},
    "along the grid": {"azimuth": 90.0},
    "nadir": {"zenith": 0.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("hotspot", [False, True])
@pytest.mark.parametrize("name", OBLIQUE)
def test_endless_canopies_seen_obliquely(name, hotspot, precision):
    """Planophile leaves in periodic voxels, 45 degrees off nadir."""

    def build(tau=1.0, reflectance=0.3, transmittance=0.4, ground=0.3, zenith=45.0, azimuth=30.0):
        voxels = jl.VoxelMap.from_lad(np.full(SIZE, tau), voxel_size=1.0, leaf_angles="planophile")
        leaf = jl.LeafOptics(reflectance=reflectance, transmittance=transmittance)
        canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=hotspot)
        return jl.Lidar(zenith=zenith, azimuth=azimuth), jl.Scene(
            canopy, ground=jl.Ground(reflectance=ground)
        )

    plan = plan_of(*build(zenith=85.0), window=(-300.0, 60.0), bin_width=2.0, max_step=1.0)
    check(*build(**OBLIQUE[name]), plan, ("forward", "reverse"))
