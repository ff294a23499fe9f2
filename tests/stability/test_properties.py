"""Properties of every admissible scene, by random ones: a canopy of few voxels, a plate and sloping ground.

Structure and shapes stay the same, so that all scenes share one compiled simulation for each precision.
Random numbers do not change either: waveforms that must agree are compared photon by photon, in double
precision, where rounding moves no photon to the other side of a face.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxlidar as jl

KEY = jax.random.key(3)
SHAPE = (2, 2, 3)
CELLS = int(np.prod(SHAPE))

usually = functools.partial(
    settings, deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)
fractions = st.floats(0.0, 1.0)
# Mostly ordinary voxels, and some that are empty or solid.
probabilities = st.one_of(st.floats(0.0, 0.9), st.sampled_from([0.0, 1.0, 1e-8]))
voxel_probabilities = st.lists(probabilities, min_size=CELLS, max_size=CELLS)


@st.composite
def scenes(draw):
    """Numbers of an admissible scene; of reflectance and transmittance the sum and a fraction are drawn."""
    leaf, leaf_reflected, plate, plate_reflected = (draw(fractions) for _ in range(4))
    height = draw(st.floats(-3.0, 3.0))
    # The plate must not lie in the plane of the ground: the order in which light meets them is undefined
    # then.
    plate_heights = st.floats(-1.0, 6.0).filter(lambda h: abs(h - height) > 1e-3)
    return {
        "p_leaf": np.reshape(draw(voxel_probabilities), SHAPE),
        "p_bark": np.reshape(draw(voxel_probabilities), SHAPE),
        "leaf": np.array([leaf * leaf_reflected, leaf * (1 - leaf_reflected)]),
        "plate": np.array([plate * plate_reflected, plate * (1 - plate_reflected)]),
        "bark": draw(fractions),
        "rho": draw(fractions),
        "coverage": draw(fractions),
        "plate height": draw(plate_heights),
        "height": height,
        "slope": draw(st.floats(0.0, 40.0)),
        "aspect": draw(st.floats(0.0, 360.0)),
        "zenith": draw(st.floats(0.0, 20.0)),
        "azimuth": draw(st.floats(0.0, 360.0)),
        "divergence": draw(st.floats(0.0, 2.0)),
        # Away from faces of voxels, where rounding would choose a side.
        "position": np.array([draw(st.sampled_from([-1, 1])) * draw(st.floats(0.05, 0.9)) for _ in range(2)]),
        "origin": np.array([-1.0, -1.0, 0.5]),
    }


def build(p):
    lidar = jl.Lidar(
        divergence=p["divergence"], zenith=p["zenith"], azimuth=p["azimuth"], position=p["position"]
    )
    voxels = jl.VoxelMap.from_probability(
        leaf=p["p_leaf"], bark=p["p_bark"], voxel_size=1.0, origin=p["origin"]
    )
    plate = jl.Plate(
        height=p["plate height"],
        reflectance=p["plate"][0],
        transmittance=p["plate"][1],
        coverage=p["coverage"],
    )
    return lidar, jl.Scene(
        canopy=jl.Canopy(
            voxels,
            leaf=jl.LeafOptics(reflectance=p["leaf"][0], transmittance=p["leaf"][1]),
            bark=p["bark"],
            hotspot=False,
        ),
        plates=(plate,),
        ground=jl.Ground(height=p["height"], reflectance=p["rho"], slope=p["slope"], aspect=p["aspect"]),
    )


@functools.cache
def compiled(precision):
    """Return the program from numbers to a waveform, by the plan of the widest of all scenes."""
    widest = {
        "p_leaf": np.full(SHAPE, 0.5),
        "p_bark": np.full(SHAPE, 0.5),
        "leaf": np.array([0.4, 0.3]),
        "plate": np.array([0.3, 0.3]),
        "bark": 0.4,
        "rho": 0.4,
        "coverage": 0.5,
        "plate height": 6.5,
        "height": -3.0,
        "slope": 40.0,
        "aspect": 0.0,
        "zenith": 20.0,
        "azimuth": 45.0,
        "divergence": 2.0,
        "position": np.zeros(2),
        "origin": np.array([-1.0, -1.0, 0.5]),
    }
    plan = jl.plan(
        *build(arrays(widest)),
        max_orders=3,
        n_photons=1024,
        n_rays=32,
        window=(-80.0, 120.0),
        footprint="fixed",
        max_step=0.5,
    )

    def simulated(p):
        lidar, scene = build(p)
        setup = jl.make_setup(lidar, scene, plan)
        return jl.waveform_of(jl.trace_scene(setup, KEY), setup)

    return jax.jit(simulated, compiler_options={"xla_backend_optimization_level": 0})


def arrays(p):
    return {name: jnp.asarray(value, float) for name, value in p.items()}


def simulate(p, precision="float64"):
    with jax.enable_x64(precision == "float64"):
        return jax.tree.map(np.asarray, compiled(precision)(arrays(p)))


def assert_alike(actual, expected, tolerance=1e-6):
    actual, expected = np.asarray(actual, float), np.asarray(expected, float)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * np.max(expected) + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", "float64"])
@usually(max_examples=25)
@given(p=scenes())
def test_finite_and_not_negative_and_no_more_than_was_emitted(precision, p):
    wave = simulate(p, precision)
    for path, value in jax.tree.leaves_with_path(wave):
        assert np.all(np.isfinite(value)), path
    slack = 1e-6 * float(np.max(wave.reflectance)) + 1e-9
    for name, component in {**wave.components, "all": wave.reflectance}.items():
        assert float(np.min(component)) >= -slack, name
    assert np.sum(wave.energy) <= 1e-3
    np.testing.assert_allclose(np.sum(list(wave.energy_budget.values()), axis=0), 1.0, atol=2e-5)
    for name in ("returned", "escaped", "after the window", "unfollowed"):
        assert float(wave.energy_budget[name][0]) >= -1e-6, name


@pytest.mark.slow
@usually(max_examples=20)
@given(scenes(), fractions)
def test_brighter_ground_never_darkens(p, other_reflectance):
    low, high = sorted((p["rho"], other_reflectance))
    dark, bright = (np.asarray(simulate(p | {"rho": rho}).reflectance) for rho in (low, high))
    assert np.all(bright - dark >= -1e-6 * np.max(bright) - 1e-12)
    ground = np.asarray(simulate(p | {"rho": high}).components["ground"])
    if high - low > 0.1 and np.max(ground) > 1e-3:
        assert np.max(bright - dark) > 0


@pytest.mark.slow
@usually(max_examples=20)
@given(scenes(), st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))
def test_moving_everything_sideways(p, east, north):
    shift, aspect = np.array([east, north]), np.deg2rad(p["aspect"])
    # Heights are those at x = y = 0.
    rise = np.tan(np.deg2rad(p["slope"])) * (east * np.sin(aspect) + north * np.cos(aspect))
    moved = p | {
        "position": p["position"] + shift,
        "origin": p["origin"] + np.append(shift, 0.0),
        "height": p["height"] + rise,
    }
    moved_wave, wave = (simulate(q) for q in (moved, p))
    assert_alike(moved_wave.reflectance, wave.reflectance)


@pytest.mark.slow
@usually(max_examples=20)
@given(scenes(), st.integers(1, 3))
def test_turning_everything_about_the_vertical(p, quarters):
    """Clockwise by quarter turns: the first order of a beam without divergence, through open voxels."""
    p = p | {"divergence": 0.0}
    turned = dict(p)
    for _ in range(quarters):
        turned["p_leaf"] = np.rot90(turned["p_leaf"], -1)
        turned["p_bark"] = np.rot90(turned["p_bark"], -1)
        x, y = turned["position"]
        turned["position"] = np.array([y, -x])
        turned["aspect"] += 90.0
        turned["azimuth"] += 90.0
    turned_wave, wave = (simulate(q) for q in (turned, p))
    assert_alike(turned_wave.components["first"], wave.components["first"])
