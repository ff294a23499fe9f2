"""Only the effects a scene calls for: what is off is not compiled, what is left out lies within its bound."""

import dataclasses
import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import batch_mean, first_wave, slab

import jaxlidar as jl
from jaxlidar.effects import NAMES, without

GROUND = jl.Ground(reflectance=0.3)
PLATE = jl.Plate(height=3.0, reflectance=0.4, transmittance=0.3, coverage=0.5)
LEAF = jl.LeafOptics(reflectance=0.1, transmittance=0.05)
LEAVES = jl.Canopy(slab(0.8), leaf=LEAF)
TREES = jl.Canopy(slab(0.8, 0.1), leaf=LEAF, bark=0.3)
SIZES = {"n_photons": 512, "n_rays": 256, "window": (-100.0, 50.0)}
LOOPS = ("scan[", "while[", "cond[")
RANDOM = ("random_", "threefry")


def traced(lidar, scene, plan):
    """The trace as text, as it is compiled; the lidar's arrays are in it as far as they are used."""

    def run(scene, key):
        return jl.trace(lidar, scene, plan, key)

    return str(eqx.filter_make_jaxpr(run)(scene, jax.random.key(0))[0])


def planned(lidar, scene, **settings):
    return jl.plan(lidar, scene, **(SIZES | settings))


def effect(plan, name):
    return next(e for e in plan.effects if e.name == name)


# What is off is not compiled.


@pytest.mark.parametrize("slope", [0.0, 10.0])
def test_ground_alone_has_no_loop_and_nothing_random(slope):
    lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(slope=slope))
    text = traced(lidar, scene, planned(lidar, scene))
    assert not any(word in text for word in LOOPS + RANDOM)


def test_ground_alone_with_all_that_a_lidar_may_have_has_no_loop_either():
    lidar = jl.Lidar(field_of_view=1.0, jitter=0.5)
    scene = jl.Scene(ground=GROUND, atmosphere=jl.Atmosphere(lidar_ratio=40.0))
    plan = planned(lidar, scene)

    def run(lidar, scene, key):
        return jl.waveform(jl.trace(lidar, scene, plan, key), lidar, scene, plan).reflectance

    text = str(eqx.filter_make_jaxpr(run)(lidar, scene, jax.random.key(0))[0])
    assert not any(word in text for word in LOOPS + RANDOM)


def test_one_order_draws_nothing_but_the_shift_of_the_footprint():
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


def test_what_is_not_there_has_no_letter():
    with_bark, bare = jl.Scene(canopy=TREES, ground=GROUND), jl.Scene(canopy=LEAVES, ground=GROUND)
    plans = [
        planned(jl.Lidar(), with_bark),
        planned(jl.Lidar(), bare, max_orders=3),
        planned(jl.Lidar(), with_bark, max_orders=3, effects={"bark": False}),
    ]
    assert "bark.R" in plans[0].layout.letters
    assert plans[1].layout.letters == plans[2].layout.letters == ("leaf.R", "leaf.T", "ground.R")
    assert traced(jl.Lidar(), bare, plans[1]) == traced(jl.Lidar(), bare, plans[2])
    weights = jax.eval_shape(lambda key: jl.trace(jl.Lidar(), with_bark, plans[2], key), jax.random.key(0))
    assert weights.first.shape[0] == 2
    assert weights.first.shape[1] == 4


@pytest.mark.parametrize("canopy", [None, TREES])
def test_the_trace_never_sees_a_wavelength(canopy):
    scene = jl.Scene(canopy=canopy, plates=() if canopy else (PLATE,), ground=GROUND)
    one, three = jl.Lidar(), jl.Lidar(wavelength=(532.0, 1064.0, 1550.0))
    plan = planned(one, scene, max_orders=3)
    assert traced(one, scene, plan) == traced(three, scene, plan)


# What is left out lies within its bound.

FAR = jl.Lidar(divergence=5.0)
SLOPING = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=20.0, aspect=30.0))
HAZE = jl.Atmosphere(visibility=10.0, lidar_ratio=30.0)
CASES = {
    "slope spread": (FAR, SLOPING, "slope spread"),
    "slope spread, off axis": (jl.Lidar(divergence=2.0, position=(3.0, -2.0)), SLOPING, "slope spread"),
    "divergence": (FAR, SLOPING, "divergence"),
    "divergence, flat": (jl.Lidar(divergence=60.0), jl.Scene(ground=GROUND), "divergence"),
    "divergence, top-hat, slanted": (
        jl.Lidar(divergence=3.0, profile="top-hat", zenith=20.0),
        jl.Scene(ground=GROUND),
        "divergence",
    ),
    "divergence, rectangular pulse": (
        jl.Lidar(divergence=3.0, pulse=jl.RectangularPulse(length=1.0)),
        jl.Scene(ground=jl.Ground(slope=20.0)),
        "divergence",
    ),
    "field of view": (jl.Lidar(divergence=5.0, field_of_view=6.0), jl.Scene(ground=GROUND), "field of view"),
    "jitter": (jl.Lidar(jitter=1.0), SLOPING, "jitter"),
    "jitter, trees": (
        jl.Lidar(jitter=2.0, pulse=jl.RectangularPulse(length=3.0)),
        jl.Scene(canopy=TREES, ground=GROUND),
        "jitter",
    ),
    "extinction": (FAR, jl.Scene(ground=GROUND, atmosphere=jl.Atmosphere()), "atmospheric extinction"),
    "extinction, two wavelengths": (
        jl.Lidar(wavelength=(532.0, 1550.0)),
        jl.Scene(canopy=LEAVES, ground=GROUND, atmosphere=HAZE),
        "atmospheric extinction",
    ),
    "backscatter": (
        jl.Lidar(wavelength=532.0),
        jl.Scene(ground=jl.Ground(reflectance=0.02), atmosphere=HAZE),
        "atmospheric backscatter",
    ),
    "hot spot": (
        jl.Lidar(),
        jl.Scene(canopy=jl.Canopy(slab(0.8), leaf=LEAF, hotspot=True), ground=GROUND),
        "hot spot",
    ),
    "leaf": (jl.Lidar(), jl.Scene(canopy=TREES, ground=GROUND), "leaf"),
    "bark": (jl.Lidar(), jl.Scene(canopy=TREES, ground=GROUND), "bark"),
    "bright bark": (
        jl.Lidar(),
        jl.Scene(canopy=jl.Canopy(slab(0.1, 0.1), leaf=LEAF, bark=0.9), ground=jl.Ground(reflectance=0.02)),
        "bark",
    ),
    "plates": (jl.Lidar(), jl.Scene(plates=(PLATE,), ground=GROUND), "plates"),
    "ground": (jl.Lidar(), jl.Scene(plates=(PLATE,), ground=GROUND), "ground"),
    "mirror": (
        jl.Lidar(),
        jl.Scene(ground=jl.Ground(reflectance=0.1, law=jl.Specular(roughness=0.2))),
        "specular return",
    ),
}


def change(with_, without_, measure):
    """What `jaxlidar.Effect` bounds."""
    a, b = (np.asarray(w.reflectance, float) for w in (with_, without_))
    sums = a.sum(axis=1), b.sum(axis=1)
    if measure == "sum":
        return np.max(np.abs(sums[0] - sums[1]) / np.maximum(*sums))
    return np.max(np.abs(a - b).sum(axis=1) / (sums[0] + sums[1]))


@pytest.mark.parametrize("case", CASES)
def test_what_order_one_changes_lies_within_the_bound(case):
    lidar, scene, name = CASES[case]
    settings = {"max_orders": 1, "footprint": "fixed"}
    plans = [planned(lidar, scene, **settings, effects={name: on}) for on in (True, False)]
    row = effect(plans[0], name)
    assert row.simulated
    assert not effect(plans[1], name).simulated
    assert effect(plans[1], name).bound == pytest.approx(row.bound, rel=1e-3)
    found = change(*(first_wave(lidar, scene, plan) for plan in plans), row.measure)
    # Both are in single precision, and rays stand for a footprint.
    assert 0 < found <= 1.003 * row.bound + 1e-6
    assert found >= row.bound / 30


def sum_of(wave):
    return wave.reflectance.sum(axis=1)


def orders_of(wave):
    return {key: wave.components[key].sum(axis=1) for key in ("first", "higher")}


DARK = jl.Canopy(slab(1.0, width=400.0), leaf=LEAF, sides="periodic")
MANY = {
    "leaves": jl.Scene(canopy=DARK),
    "leaves over ground": jl.Scene(canopy=DARK, ground=jl.Ground(reflectance=0.2)),
    "plate over ground": jl.Scene(plates=(PLATE,), ground=GROUND),
    "two plates": jl.Scene(plates=(PLATE, jl.Plate(height=1.0, reflectance=0.5)), ground=GROUND),
    "isotropic": jl.Scene(canopy=jl.Canopy(slab(1.0), leaf=jl.Isotropic(albedo=0.3)), ground=GROUND),
}


LONG = ("leaves", "two plates", "isotropic")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in MANY])
def test_higher_orders_lie_within_the_bound(name):
    scene, lidar = MANY[name], jl.Lidar()
    plan = planned(lidar, scene, max_orders=5)
    mean, stderr = batch_mean(lidar, scene, plan, seed=3, count=8, quantity=orders_of)
    found = mean["higher"] / (mean["first"] + mean["higher"])
    bound = effect(plan, "multiple scattering").bound
    assert np.all(found - 4 * stderr["higher"] / mean["first"] <= bound)
    assert np.all(found >= bound / 40)
    rest = effect(plan, "orders beyond 5")
    assert not rest.simulated
    assert 0 < rest.bound < bound


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bark", "field of view"])
def test_what_all_orders_change_lies_within_the_bound(name):
    canopy = jl.Canopy(slab(0.4, 0.1, width=400.0), leaf=LEAF, bark=0.1, sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.1))
    lidar = jl.Lidar(divergence=5.0, field_of_view=5.0)
    plans = [planned(lidar, scene, max_orders=4, effects={name: on}) for on in (True, False)]
    (a, one), (b, other) = (batch_mean(lidar, scene, p, seed=5, count=8, quantity=sum_of) for p in plans)
    found = np.abs(a - b) / np.maximum(a, b)
    bound = effect(plans[0], name).bound
    assert np.all(found - 4 * np.hypot(one, other) / np.maximum(a, b) <= bound)
    assert np.all(found >= bound / 30)


def test_brighter_scenes_have_larger_bounds_up_to_one():
    def bound(albedo):
        scene = jl.Scene(canopy=jl.Canopy(slab(1.0), leaf=jl.Isotropic(albedo=albedo)), ground=GROUND)
        return effect(planned(jl.Lidar(), scene, max_orders=8), "orders beyond 8").bound

    bounds = [bound(a) for a in (0.1, 0.5, 0.9, 1.0)]
    assert bounds == sorted(bounds)
    assert bounds[-1] == 1.0


# Choices.


def test_switching_off_is_the_scene_without():
    scene = jl.Scene(canopy=TREES, plates=(PLATE,), ground=jl.Ground(slope=5.0), atmosphere=HAZE)
    lidar = jl.Lidar(field_of_view=1.0, jitter=0.5)

    def less(**changes):
        return dataclasses.replace(scene, **changes)

    expected = {
        "bark": (lidar, less(canopy=LEAVES)),
        "leaf": (lidar, less(canopy=jl.Canopy(slab(bark=0.1), bark=0.3))),
        "plates": (lidar, less(plates=())),
        "ground": (lidar, less(ground=None)),
        "slope spread": (lidar, less(ground=jl.Ground())),
        "atmospheric extinction": (lidar, less(atmosphere=None)),
        "atmospheric backscatter": (lidar, less(atmosphere=jl.Atmosphere(visibility=10.0))),
        "jitter": (jl.Lidar(field_of_view=1.0), scene),
        "field of view": (jl.Lidar(jitter=0.5), scene),
        "divergence": (jl.Lidar(field_of_view=1.0, jitter=0.5, divergence=0.0), scene),
        "specular return": (lidar, scene),
    }
    for name, pair in expected.items():
        assert eqx.tree_equal(without(lidar, scene, (name,)), pair), name


def test_without_twice_is_without_once():
    scene = jl.Scene(TREES, (PLATE,), jl.Ground(slope=20.0, height=1.0, aspect=50.0), HAZE)
    lidar = jl.Lidar(zenith=10.0, position=(2.0, 3.0), field_of_view=1.0, jitter=0.1)
    once = without(lidar, scene, NAMES)
    assert eqx.tree_equal(once[1], jl.Scene())
    assert once[0].field_of_view is None
    off = ("slope spread", "leaf")
    level = without(lidar, scene, off)
    again = without(*level, off)
    assert all(np.allclose(a, b, rtol=1e-5) for a, b in zip(*map(jax.tree.leaves, (level, again))))


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
def test_choices_that_cannot_be_are_refused(case):
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
    for name in (*NAMES, f"orders beyond {plan.orders}", "scattering within the atmosphere"):
        (line,) = (text for text in lines if text.startswith(name + " "))
        row = effect(plan, name)
        assert line.split()[len(name.split())] == ("yes" if row.simulated else "no")
        assert row.reason in line
        assert 0 <= row.bound <= 1
    assert "switched off" in next(text for text in lines if text.startswith("bark"))
