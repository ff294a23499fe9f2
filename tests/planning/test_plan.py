"""Plans have only the effects of the scene, programs only those of the plan; users can override choices."""

import dataclasses
import re

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning.effects import EFFECT_NAMES, without_effects
from tests.helpers import slab

GROUND = jl.Ground(reflectance=0.3)
PLATE = jl.Plate(height=3.0, reflectance=0.4, transmittance=0.3, coverage=0.5)
LEAF = jl.LeafOptics(reflectance=0.1, transmittance=0.05)
LEAVES = jl.Canopy(slab(0.8), leaf=LEAF, hotspot=False)
TREES = jl.Canopy(slab(0.8, 0.1), leaf=LEAF, bark=0.3, hotspot=False)
HAZE = jl.Atmosphere(visibility=10.0, lidar_ratio=30.0)
SIZES = {"n_photons": 4096, "n_rays": 256, "window": (-100.0, 50.0)}
LOOPS = ("scan[", "while[", "cond[")
RANDOM = ("random_", "threefry")


def traced(lidar, scene, plan):
    """Return the trace as text of its jaxpr; arrays of the lidar are in it if they are used."""

    setup = jl.make_setup(lidar, scene, plan)

    def run(scene, key):
        return jl.trace_scene(dataclasses.replace(setup, scene=scene), key)

    return str(eqx.filter_make_jaxpr(run)(setup.scene, jax.random.key(0))[0])


def planned(lidar, scene, **settings):
    return jl.plan(lidar, scene, **(SIZES | settings))


def effect(plan, name):
    return next(e for e in plan.effects if e.name == name)


# Effects that are off are not compiled.


@pytest.mark.parametrize("slope", [0.0, 10.0])
def test_ground_alone_has_no_loop_and_nothing_random(slope):
    lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(slope=slope))
    text = traced(lidar, scene, planned(lidar, scene))
    assert not any(word in text for word in LOOPS + RANDOM)


def test_ground_alone_has_no_loop_with_all_effects_of_a_lidar():
    lidar = jl.Lidar(field_of_view=1.0, jitter=0.5)
    scene = jl.Scene(ground=GROUND, atmosphere=jl.Atmosphere(lidar_ratio=40.0))
    plan = planned(lidar, scene)

    def run(lidar, scene, key):
        setup = jl.make_setup(lidar, scene, plan)
        return jl.waveform_of(jl.trace_scene(setup, key), setup).reflectance

    text = str(eqx.filter_make_jaxpr(run)(lidar, scene, jax.random.key(0))[0])
    assert not any(word in text for word in LOOPS + RANDOM)


def test_the_first_order_draws_only_the_shift_of_the_footprint():
    scene = jl.Scene(canopy=LEAVES, ground=GROUND)
    off = {"multiple scattering": False}
    fixed = traced(jl.Lidar(), scene, planned(jl.Lidar(), scene, effects=off, footprint="fixed"))
    assert not any(word in fixed for word in RANDOM)
    assert traced(jl.Lidar(), scene, planned(jl.Lidar(), scene, effects=off)).count("random_bits[") == 1
    assert traced(jl.Lidar(), scene, planned(jl.Lidar(), scene)).count("random_bits[") > 1


def test_a_beam_without_width_is_one_ray_that_is_not_random():
    scene = jl.Scene(canopy=LEAVES, ground=GROUND)
    plan = planned(jl.Lidar(), scene, max_orders=1, effects={"divergence": False})
    assert plan.n_rays == 1
    assert not plan.is_random
    assert not any(word in traced(jl.Lidar(), scene, plan) for word in RANDOM)


def test_absent_materials_have_no_channel():
    with_bark, bare = jl.Scene(canopy=TREES, ground=GROUND), jl.Scene(canopy=LEAVES, ground=GROUND)
    plans = [
        planned(jl.Lidar(), with_bark),
        planned(jl.Lidar(), bare, max_orders=3),
        planned(jl.Lidar(), with_bark, max_orders=3, effects={"bark": False}),
    ]
    assert "bark.R" in plans[0].config.channels
    assert plans[1].config.channels == plans[2].config.channels == ("leaf.R", "leaf.T", "ground.R")
    assert traced(jl.Lidar(), bare, plans[1]) == traced(jl.Lidar(), bare, plans[2])
    weights = jax.eval_shape(
        lambda key: jl.trace_scene(jl.make_setup(jl.Lidar(), with_bark, plans[2]), key), jax.random.key(0)
    )
    assert weights.first.shape[:3] == (1, 2, 4)


@pytest.mark.parametrize("canopy", [None, TREES])
def test_the_trace_does_not_depend_on_wavelengths(canopy):
    scene = jl.Scene(canopy=canopy, plates=() if canopy else (PLATE,), ground=GROUND)
    one_wavelength, three_wavelengths = jl.Lidar(), jl.Lidar(wavelength=(532.0, 1064.0, 1550.0))
    plan = planned(one_wavelength, scene, max_orders=3)
    assert traced(one_wavelength, scene, plan) == traced(three_wavelengths, scene, plan)


# Choices.


def test_switching_off_is_the_scene_without():
    scene = jl.Scene(canopy=TREES, plates=(PLATE,), ground=jl.Ground(slope=5.0), atmosphere=HAZE)
    lidar = jl.Lidar(field_of_view=1.0, jitter=0.5)

    def with_fields(**changes):
        return dataclasses.replace(scene, **changes)

    expected = {
        "bark": (lidar, with_fields(canopy=LEAVES)),
        "leaf": (lidar, with_fields(canopy=jl.Canopy(slab(bark=0.1), bark=0.3, hotspot=False))),
        "plates": (lidar, with_fields(plates=())),
        "ground": (lidar, with_fields(ground=None)),
        "slope spread": (lidar, with_fields(ground=jl.Ground())),
        "atmospheric extinction": (lidar, with_fields(atmosphere=None)),
        "atmospheric backscatter": (lidar, with_fields(atmosphere=jl.Atmosphere(visibility=10.0))),
        "jitter": (jl.Lidar(field_of_view=1.0), scene),
        "field of view": (jl.Lidar(jitter=0.5), scene),
        "divergence": (jl.Lidar(field_of_view=1.0, jitter=0.5, divergence=0.0), scene),
        "specular return": (lidar, scene),
    }
    for name, pair in expected.items():
        assert eqx.tree_equal(without_effects(lidar, scene, (name,)), pair), name


def test_without_twice_is_without_once():
    scene = jl.Scene(TREES, (PLATE,), jl.Ground(slope=20.0, height=1.0, aspect=50.0), HAZE)
    lidar = jl.Lidar(zenith=10.0, position=(2.0, 3.0), field_of_view=1.0, jitter=0.1)
    once = without_effects(lidar, scene, EFFECT_NAMES)
    assert eqx.tree_equal(once[1], jl.Scene())
    assert once[0].field_of_view is None
    off = ("slope spread", "leaf")
    first_pass = without_effects(lidar, scene, off)
    twice = without_effects(*first_pass, off)
    assert all(
        np.allclose(a, b, rtol=1e-5) for a, b in zip(*map(jax.tree.leaves, (first_pass, twice)), strict=True)
    )


def test_simulate_passes_choices_on():
    scene = jl.Scene(canopy=TREES, ground=jl.Ground(slope=10.0))
    off = {
        "multiple scattering": False,
        "slope spread": False,
        "divergence": False,
        "leaf": False,
        "bark": True,
    }
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), effects=off)
    assert wave.info["photons"] == 0
    assert set(wave.components) == {"bark", "ground", "first", "higher"}
    expected = 0.3 * np.exp(-0.2) + 0.3 * 2 / 3 * (1 - np.exp(-0.2)) / 2
    assert float(wave.reflectance.sum()) == pytest.approx(expected, rel=1e-4)


BAD = {
    "unknown": ({"thunder": False}, "'thunder' is none of 'leaf', 'bark'"),
    "absent": ({"bark": True}, r"effects\['bark'\] = True, but it is not in the scene.*'ground'"),
    "one plane": ({"multiple scattering": True}, "not in the scene"),
    "ground": ({"ground": False, "slope spread": True}, "'ground' = False; admissible with it is True"),
    "air": (
        {"atmospheric extinction": False, "atmospheric backscatter": True},
        "'atmospheric extinction' = False; admissible with it is True",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_impossible_choices_are_refused(case):
    effects, message = BAD[case]
    scene = jl.Scene(ground=jl.Ground(slope=5.0), atmosphere=HAZE)
    with pytest.raises(ValueError, match=message):
        jl.plan(jl.Lidar(), scene, effects=effects)
    with pytest.raises(ValueError, match=message):
        jl.simulate(jl.Lidar(), scene, key=jax.random.key(0), effects=effects)


@pytest.mark.parametrize(("on", "orders"), [(True, 1), (False, 3)])
def test_orders_asked_for_agree_with_the_choice(on, orders):
    scene = jl.Scene(canopy=LEAVES)
    with pytest.raises(ValueError, match=f"= {on}, but max_orders = {orders}; they must agree"):
        jl.plan(jl.Lidar(), scene, max_orders=orders, effects={"multiple scattering": on})


def test_every_effect_has_a_line_in_the_table():
    scene = jl.Scene(canopy=TREES, ground=GROUND, atmosphere=jl.Atmosphere())
    plan = jl.plan(jl.Lidar(), scene, effects={"bark": False})
    lines = str(plan).splitlines()
    assert max(map(len, lines)) <= 110
    for name in (*EFFECT_NAMES, f"orders beyond {plan.orders}", "scattering within the atmosphere"):
        (line,) = (text for text in lines if text.startswith(name + " "))
        row = effect(plan, name)
        assert line.split()[len(name.split())] == ("yes" if row.simulated else "no")
        assert row.reason in line
        assert 0 <= row.bound <= 1
    assert "switched off" in next(text for text in lines if text.startswith("bark"))


@pytest.mark.parametrize("zenith", [0.0, 60.0])
def test_the_lowest_altitude_is_named_where_a_scene_reaches_up_to_the_sensor(zenith):
    scene = jl.Scene(ground=jl.Ground(height=20.0))

    def plan(altitude):
        return jl.plan(jl.Lidar(altitude=altitude, zenith=zenith), scene, describe=False)

    with pytest.raises(ValueError, match=r"altitude = 10 m: the scene reaches up to the sensor") as refusal:
        plan(10.0)
    lowest = float(re.search(r"admissible is more than (\S+) m", str(refusal.value))[1])
    plan(1.01 * lowest)
    with pytest.raises(ValueError, match="reaches up to the sensor"):
        plan(0.99 * lowest)


@pytest.mark.parametrize(
    ("pulse", "jitter", "rays"),
    [
        (jl.GaussianPulse(0.0), 0.0, 2048),
        pytest.param(jl.GaussianPulse(2.0), 0.0, 2048, marks=pytest.mark.slow),
        (jl.GaussianPulse(2.0), 1.0, 1024),
        pytest.param(jl.GaussianPulse(6.0), 0.0, 1024, marks=pytest.mark.slow),
        # The power of a rectangular pulse jumps: its finest feature is 0.
        (jl.RectangularPulse(2.0), 0.0, 2048),
        (jl.RectangularPulse(6.0), 0.0, 1024),
    ],
    ids=str,
)
def test_short_pulses_take_more_rays(pulse, jitter, rays):
    scene = jl.Scene(plates=[jl.Plate(5.0, 0.4, 0.4)], ground=jl.Ground())
    lidar = jl.Lidar(pulse=pulse, jitter=jitter)
    assert jl.plan(lidar, scene).n_rays == rays
    assert jl.plan(lidar, scene, n_rays=64).n_rays == 64
    assert jl.plan(lidar, scene, max_orders=1).n_rays == 4096
    assert jl.plan(lidar, scene, footprint="fixed").n_rays == 4096


@pytest.mark.parametrize("kind", ["canopy", "meshes[0]"])
def test_a_scene_far_from_every_beam_is_of_another_map(kind):
    """Map coordinates beside a lidar at the origin: nothing would be met, without a word."""
    place = np.array([512345.0, 6123456.0, 0.0])
    voxels = jl.VoxelMap.from_extinction(leaf=np.full((3, 3, 4), 0.4), voxel_size=1.0, origin=place)
    triangle = np.array([[0.0, 0.0, 5.0], [5.0, 0.0, 5.0], [5.0, 5.0, 5.0]])
    scene = {
        "canopy": jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)), ground=jl.Ground()),
        "meshes[0]": jl.Scene(meshes=(jl.MeshSurface((triangle + place, [[0, 1, 2]])),), ground=jl.Ground()),
    }[kind]
    message = re.escape(kind) + " is 6145 km away from every beam; admissible is up to 100 km"
    with pytest.raises(ValueError, match=message):
        jl.plan(jl.Lidar(), scene)
    with pytest.raises(ValueError, match=message):
        jl.simulate_many(
            jl.Survey(jl.Lidar(), position=[(0, 0), (5, 0)]), scene, key=jax.random.key(0), shared=False
        )
    # Beams that come near: straight down, from a satellite, and one of several.
    jl.plan(jl.Lidar(position=place[:2] + 6e4), scene)
    jl.plan(jl.Lidar(sensor=(*(place[:2] - (6e5, 0.0)), 6e5), zenith=45.0, azimuth=90.0), scene)
    jl.plan(jl.Survey(jl.Lidar(), position=[(0, 0), place[:2]]), scene)


PLANS_AS_ARGUMENTS = {
    "simulate": (
        lambda scene: jl.plan(LIDAR_OF_PLANS, scene, max_orders=1, n_rays=256, describe=False),
        lambda scene, plan: jl.simulate(LIDAR_OF_PLANS, scene, key=KEY_OF_PLANS, plan=plan).reflectance,
    ),
    "truth_of": (
        lambda scene: jl.plan(LIDAR_OF_PLANS, scene, max_orders=1, describe=False),
        lambda scene, plan: jl.truth_of(LIDAR_OF_PLANS, scene, plan=plan).gap_probability,
    ),
    "reflectance_factor": (
        lambda scene: jl.plan_reflectance(scene, **ANGLES, n_photons=256, max_orders=2),
        lambda scene, plan: jl.reflectance_factor(scene, **ANGLES, key=KEY_OF_PLANS, plan=plan).reflectance,
    ),
}
LIDAR_OF_PLANS, KEY_OF_PLANS = jl.Lidar(divergence=2.0, zenith=5.0), jax.random.key(0)
ANGLES = {"sun": (30.0, 0.0), "view": (10.0, 90.0), "wavelengths": 865.0}


@pytest.mark.parametrize("name", PLANS_AS_ARGUMENTS)
def test_a_plan_can_be_an_argument_of_a_program(name):
    """Its numbers are traced then; a plan for other lengths shares the program, and gives other values."""
    make, use = PLANS_AS_ARGUMENTS[name]
    voxels = jl.VoxelMap.from_lad(np.full((4, 4, 6), 0.5), voxel_size=0.5, origin=(-1, -1, 2))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.3), hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
    plan = make(scene)
    program = jax.jit(lambda plan: use(scene, plan))
    within = program(plan)
    constant = jax.jit(lambda: use(scene, plan))()
    np.testing.assert_allclose(within, constant, rtol=1e-3, atol=1e-6)
    assert float(np.max(np.abs(within))) > 0.01
    # Rays that start below the canopy: the plan does not cover the scene, which only its numbers tell.
    short = program(plan.with_limits(start_distance=0.0))
    assert program._cache_size() == 1
    assert not np.allclose(short, within, rtol=1e-3, equal_nan=True)
