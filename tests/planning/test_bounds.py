"""What a plan leaves out changes no more than the bound that it states, and not absurdly less."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import batch_mean, first_wave, slab, slow_unless

GROUND = jl.Ground(reflectance=0.3)
PLATE = jl.Plate(height=3.0, reflectance=0.4, transmittance=0.3, coverage=0.5)
LEAF = jl.LeafOptics(reflectance=0.1, transmittance=0.05)
LEAVES = jl.Canopy(slab(0.8), leaf=LEAF)
TREES = jl.Canopy(slab(0.8, 0.1), leaf=LEAF, bark=0.3)
HAZE = jl.Atmosphere(visibility=10.0, lidar_ratio=30.0)


def planned(lidar, scene, **settings):
    return jl.plan(lidar, scene, **({"n_photons": 512, "n_rays": 256, "window": (-100.0, 50.0)} | settings))


def effect(plan, name):
    return next(e for e in plan.effects if e.name == name)


# Order one.

FAR = jl.Lidar(divergence=5.0)
SLOPING = jl.Scene(ground=jl.Ground(reflectance=0.3, slope=20.0, aspect=30.0))
# Trees around a clearing in the middle of the footprint.
EDGES = np.zeros((8, 8, 4))
EDGES[[0, 1, 6, 7]] = 0.1
CLEARING = jl.Canopy(
    jl.VoxelMap.from_extinction(leaf=EDGES, voxel_size=(5.0, 5.0, 2.5), origin=(-20.0, -20.0, 4.0)),
    leaf=jl.LeafOptics(reflectance=0.5, transmittance=0.4),
)
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
    "slope spread, below trees": (
        FAR,
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

# Others show the same of more than they need.
DEFAULT = (
    "slope spread",
    "divergence",
    "field of view",
    "jitter",
    "extinction",
    "backscatter",
    "plates",
    "mirror",
)


def change(with_, without_, measure):
    """What `jaxlidar.Effect` bounds."""
    a, b = (np.asarray(w.reflectance, float) for w in (with_, without_))
    sums = a.sum(axis=1), b.sum(axis=1)
    if measure == "sum":
        return np.max(np.abs(sums[0] - sums[1]) / np.maximum(*sums))
    return np.max(np.abs(a - b).sum(axis=1) / (sums[0] + sums[1]))


@pytest.mark.parametrize("case", slow_unless(DEFAULT, CASES))
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


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(("leaves over ground",), MANY))
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
        jl.Scene(canopy=jl.Canopy(slab(30.0), leaf=jl.Isotropic(albedo=1.0)), ground=GROUND),
        {"multiple scattering": 1.0, "leaf": 1.0},
    ),
    "all dark": (
        jl.Lidar(),
        jl.Scene(
            canopy=jl.Canopy(slab(1.0), leaf=jl.Isotropic(albedo=0.0)), ground=jl.Ground(reflectance=0.0)
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


def test_what_is_traced_may_change_all():
    found = {}

    @jax.grad
    def run(reflectance):
        scene = jl.Scene(plates=(PLATE,), ground=jl.Ground(reflectance=reflectance))
        found["plan"] = planned(jl.Lidar(), scene)
        return reflectance

    run(0.3)
    assert effect(found["plan"], "plates").bound == 1.0
    assert effect(found["plan"], "leaf").bound == 0.0
