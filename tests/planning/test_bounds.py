"""Effects that a plan leaves out change the waveform by less than their bounds, and not by far less."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.optics.facets import FACET_BACKSCATTER
from tests.helpers import batch_mean, first_wave, slab, slow_unless

GROUND = jl.Ground(reflectance=0.3)
PLATE = jl.Plate(height=3.0, reflectance=0.4, transmittance=0.3, coverage=0.5)
LEAF = jl.LeafOptics(reflectance=0.1, transmittance=0.05)
LEAVES = jl.Canopy(slab(0.8), leaf=LEAF, hotspot=False)
TREES = jl.Canopy(slab(0.8, 0.1), leaf=LEAF, bark=0.3, hotspot=False)
HAZE = jl.Atmosphere(visibility=10.0, lidar_ratio=30.0)


def planned(lidar, scene, **settings):
    return jl.plan(lidar, scene, **({"n_photons": 4096, "n_rays": 256, "window": (-100.0, 50.0)} | settings))


def effect(plan, name):
    return next(e for e in plan.effects if e.name == name)


# First order.

WIDE_LIDAR = jl.Lidar(divergence=5.0)
SLOPING = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=20.0, aspect=30.0))
# Trees around a clearing in the middle of the footprint.
CLEARING_EXTINCTION = np.zeros((8, 8, 4))
CLEARING_EXTINCTION[[0, 1, 6, 7]] = 0.1
CLEARING = jl.Canopy(
    jl.VoxelMap.from_extinction(
        leaf=CLEARING_EXTINCTION, voxel_size=(5.0, 5.0, 2.5), origin=(-20.0, -20.0, 4.0)
    ),
    leaf=jl.LeafOptics(reflectance=0.5, transmittance=0.4),
    hotspot=False,
)
CASES = {
    "slope spread": (WIDE_LIDAR, SLOPING, "slope spread"),
    "slope spread, off axis": (jl.Lidar(divergence=2.0, position=(3.0, -2.0)), SLOPING, "slope spread"),
    "divergence": (WIDE_LIDAR, SLOPING, "divergence"),
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
    "extinction": (WIDE_LIDAR, jl.Scene(ground=GROUND, atmosphere=jl.Atmosphere()), "atmospheric extinction"),
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
        jl.Scene(
            canopy=jl.Canopy(slab(0.1, 0.1), leaf=LEAF, bark=0.9, hotspot=False),
            ground=jl.Ground(reflectance=0.02),
        ),
        "bark",
    ),
    "plates": (jl.Lidar(), jl.Scene(plates=(PLATE,), ground=GROUND), "plates"),
    "ground": (jl.Lidar(), jl.Scene(plates=(PLATE,), ground=GROUND), "ground"),
    "slope spread, below trees": (
        WIDE_LIDAR,
        jl.Scene(canopy=CLEARING, ground=jl.Ground(slope=3.0)),
        "slope spread",
    ),
    "field of view, clearing": (
        jl.Lidar(divergence=20.0, field_of_view=12.0),
        jl.Scene(canopy=CLEARING, ground=jl.Ground(reflectance=0.02)),
        "field of view",
    ),
    "field of view, bright where it looks": (
        jl.Lidar(divergence=20.0, field_of_view=10.0),
        jl.Scene(ground=jl.Ground(law=jl.EqualAngle())),
        "field of view",
    ),
    "opaque plate": (
        jl.Lidar(),
        jl.Scene(plates=(jl.Plate(height=3.0, reflectance=0.4),), ground=GROUND),
        "plates",
    ),
    "plate that ends in the ground": (
        jl.Lidar(divergence=20.0),
        jl.Scene(plates=(jl.Plate(height=0.0, reflectance=0.4, slope=5.0),), ground=GROUND),
        "ground",
    ),
    "plate before a slope that faces the beam": (
        jl.Lidar(zenith=60.0, azimuth=180.0),
        jl.Scene(plates=(PLATE,), ground=jl.Ground(slope=60.0)),
        "ground",
    ),
    "mirror": (
        jl.Lidar(),
        jl.Scene(ground=jl.Ground(reflectance=0.1, law=jl.Specular(roughness=0.2))),
        "specular return",
    ),
}

# The other cases repeat these effects in larger scenes.
FAST_CASES = (
    "slope spread",
    "field of view",
    "extinction",
    "plates",
)


def relative_change(with_, without_, measure):
    """Return the change that `jaxlidar.planning.effects.Effect` bounds."""
    with_samples, without_samples = (np.asarray(w.reflectance, float) for w in (with_, without_))
    sums = with_samples.sum(axis=1), without_samples.sum(axis=1)
    if measure == "sum":
        return np.max(np.abs(sums[0] - sums[1]) / np.maximum(*sums))
    return np.max(np.abs(with_samples - without_samples).sum(axis=1) / (sums[0] + sums[1]))


@pytest.mark.parametrize("case", slow_unless(FAST_CASES, CASES))
def test_changes_of_the_first_order_lie_within_their_bounds(case):
    lidar, scene, name = CASES[case]
    settings = {"max_orders": 1, "footprint": "fixed"}
    plans = [planned(lidar, scene, **settings, effects={name: on}) for on in (True, False)]
    row = effect(plans[0], name)
    assert row.simulated
    assert not effect(plans[1], name).simulated
    assert effect(plans[1], name).bound == pytest.approx(row.bound, rel=1e-3)
    measured_change = relative_change(*(first_wave(lidar, scene, plan) for plan in plans), row.measure)
    # 0.3 % for single precision and the footprint of finite rays.
    assert 0 < measured_change <= 1.003 * row.bound + 1e-6
    assert measured_change >= row.bound / 30


def test_a_bright_canopy_is_compared_with_the_background_in_full():
    """In closed form, order one of bark over dark ground, which is seen through it by y = exp(-2 tau).

    Without the bark the scene is darker by (A - (1 - y) R) / (A + y R), at most by A / (A + R).
    """
    depth, bark, ground = 0.5, 0.9, 0.02
    scene = jl.Scene(
        jl.Canopy(slab(bark=depth), bark=bark, hotspot=False), ground=jl.Ground(reflectance=ground)
    )
    bound = effect(planned(jl.Lidar(), scene, max_orders=1), "bark").bound
    transmittance = np.exp(-2 * depth)
    bark_return = bark * FACET_BACKSCATTER * (1 - transmittance) / 2
    change = (bark_return - (1 - transmittance) * ground) / (bark_return + transmittance * ground)
    np.testing.assert_allclose(bound, bark_return / (bark_return + ground), rtol=1e-3)
    assert change < bound


def sum_of(wave):
    return wave.reflectance.sum(axis=1)


def orders_of(wave):
    return {key: wave.components[key].sum(axis=1) for key in ("first", "higher")}


DARK = jl.Canopy(slab(1.0, width=400.0), leaf=LEAF, sides="periodic", hotspot=False)
HIGHER_ORDER_SCENES = {
    "leaves": jl.Scene(canopy=DARK),
    "leaves over ground": jl.Scene(canopy=DARK, ground=jl.Ground(reflectance=0.2)),
    "plate over ground": jl.Scene(plates=(PLATE,), ground=GROUND),
    "two plates": jl.Scene(plates=(PLATE, jl.Plate(height=1.0, reflectance=0.5)), ground=GROUND),
    "isotropic": jl.Scene(
        canopy=jl.Canopy(slab(1.0), leaf=jl.Isotropic(albedo=0.3), hotspot=False), ground=GROUND
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(("leaves over ground",), HIGHER_ORDER_SCENES))
def test_higher_orders_lie_within_the_bound(name):
    scene, lidar = HIGHER_ORDER_SCENES[name], jl.Lidar()
    plan = planned(lidar, scene, max_orders=5)
    mean, stderr = batch_mean(lidar, scene, plan, seed=3, count=8, quantity=orders_of)
    higher_fraction = mean["higher"] / (mean["first"] + mean["higher"])
    bound = effect(plan, "multiple scattering").bound
    assert np.all(higher_fraction - 4 * stderr["higher"] / mean["first"] <= bound)
    assert np.all(higher_fraction >= bound / 40)
    remaining = effect(plan, "orders beyond 5")
    assert not remaining.simulated
    assert 0 < remaining.bound < bound


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bark", "field of view"])
def test_changes_of_all_orders_lie_within_their_bounds(name):
    canopy = jl.Canopy(slab(0.4, 0.1, width=400.0), leaf=LEAF, bark=0.1, sides="periodic", hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.1))
    lidar = jl.Lidar(divergence=5.0, field_of_view=5.0)
    plans = [planned(lidar, scene, max_orders=4, effects={name: on}) for on in (True, False)]
    (with_effect, stderr_with), (without_effect, stderr_without) = (
        batch_mean(lidar, scene, p, seed=5, count=8, quantity=sum_of) for p in plans
    )
    measured_change = np.abs(with_effect - without_effect) / np.maximum(with_effect, without_effect)
    bound = effect(plans[0], name).bound
    assert np.all(
        measured_change - 4 * np.hypot(stderr_with, stderr_without) / np.maximum(with_effect, without_effect)
        <= bound
    )
    assert np.all(measured_change >= bound / 30)


def test_brighter_scenes_have_larger_bounds_up_to_one():
    def bound(albedo):
        scene = jl.Scene(
            canopy=jl.Canopy(slab(1.0), leaf=jl.Isotropic(albedo=albedo), hotspot=False), ground=GROUND
        )
        return effect(planned(jl.Lidar(), scene, max_orders=8), "orders beyond 8").bound

    bounds = [bound(a) for a in (0.1, 0.5, 0.9, 1.0)]
    assert bounds == sorted(bounds)
    assert bounds[-1] == 1.0


EXTREME = {
    "plate that nothing meets": (
        jl.Lidar(),
        jl.Scene(plates=(jl.Plate(height=3.0, reflectance=0.4, coverage=0.0),), ground=GROUND),
        {"plates": 0.0, "ground": 1.0},
    ),
    "plate that passes all": (
        jl.Lidar(),
        jl.Scene(plates=(jl.Plate(height=3.0, reflectance=0.0, transmittance=1.0),), ground=GROUND),
        {"plates": 0.0, "ground": 1.0},
    ),
    "plate under the ground": (
        jl.Lidar(),
        jl.Scene(plates=(jl.Plate(height=-3.0, reflectance=0.4),), ground=GROUND),
        {"plates": 1.0, "ground": 1.0},
    ),
    "slope that the beam meets from below": (
        jl.Lidar(zenith=60.0),
        jl.Scene(plates=(PLATE,), ground=jl.Ground(slope=80.0)),
        {"plates": 1.0, "slope spread": 1.0},
    ),
    "mirror below a plate": (
        jl.Lidar(),
        jl.Scene(plates=(PLATE,), ground=jl.Ground(law=jl.Specular())),
        {"plates": 1.0, "ground": 1.0, "multiple scattering": 1.0},
    ),
    "no light in view": (jl.Lidar(field_of_view=1e-4), jl.Scene(canopy=LEAVES), {"field of view": 1.0}),
    "nothing dark": (
        jl.Lidar(),
        jl.Scene(canopy=jl.Canopy(slab(30.0), leaf=jl.Isotropic(albedo=1.0), hotspot=False), ground=GROUND),
        {"multiple scattering": 1.0, "leaf": 1.0},
    ),
    "all dark": (
        jl.Lidar(),
        jl.Scene(
            canopy=jl.Canopy(slab(1.0), leaf=jl.Isotropic(albedo=0.0), hotspot=False),
            ground=jl.Ground(reflectance=0.0),
        ),
        {"multiple scattering": 0.0},
    ),
}


@pytest.mark.parametrize("case", EXTREME)
@pytest.mark.filterwarnings("error")
def test_bounds_of_extreme_scenes(case):
    lidar, scene, expected = EXTREME[case]
    plan = planned(lidar, scene, max_orders=1)
    assert all(0 <= e.bound <= 1 for e in plan.effects)
    assert {name: effect(plan, name).bound for name in expected} == pytest.approx(expected, abs=1e-6)


def test_bounds_of_traced_values_are_one():
    plans = {}

    @jax.grad
    def run(reflectance):
        scene = jl.Scene(plates=(PLATE,), ground=jl.Ground(reflectance=reflectance))
        plans["plan"] = planned(jl.Lidar(), scene)
        return reflectance

    run(0.3)
    assert effect(plans["plan"], "plates").bound == 1.0
    assert effect(plans["plan"], "leaf").bound == 0.0
