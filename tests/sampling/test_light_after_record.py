"""Warnings of truncated light: light that arrives after the record, and orders beyond the last."""

import functools
import importlib
import time
import warnings

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning import orders
from jaxlidar.simulation.one_scene import LateLightWarning
from tests.helpers import slab

# The package's name `simulate` is the function.
simulation = importlib.import_module("jaxlidar.simulation.one_scene")
KEY = jax.random.key(5)
# Planes so far apart that the longest record of the plan ends early.
BRIGHT = jl.Scene(plates=(jl.Plate(300.0, 0.4, 0.5),), ground=jl.Ground(reflectance=0.9))
LIDAR, PALE = jl.Lidar(), jl.Ground(reflectance=0.3)


def dense(albedo, depth=10.0, reflectance=None):
    leaf = jl.LeafOptics(0.5 * albedo, 0.5 * albedo)
    canopy = jl.Canopy(slab(depth, thickness=10.0), leaf=leaf, sides="periodic", hotspot=False)
    ground = None if reflectance is None else jl.Ground(reflectance=reflectance)
    return jl.Scene(canopy=canopy, ground=ground)


def late(wave):
    return float(np.max(wave.energy_budget["after the window"]))


def test_a_window_of_the_plan_warns_and_one_of_the_user_does_not():
    with pytest.warns(LateLightWarning, match=r"% of the returned light is still on its way .* give window="):
        wave = jl.simulate(LIDAR, BRIGHT, key=KEY, n_photons=2_000, max_orders=4)
    assert late(wave) > 0.01
    assert "of the returned light is still on its way when the record ends" in str(wave)
    end = float(wave.time[-1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        user_window = jl.simulate(
            LIDAR, BRIGHT, key=KEY, n_photons=2_000, max_orders=4, window=(-2100.0, end)
        )
    assert late(user_window) > 0.01
    assert "of the returned light is still on its way when the record ends" in str(user_window)


def test_the_warning_follows_the_tolerance():
    """Of the light that returns, some 16 % are on their way; a tolerance of 0.3 admits them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wave = jl.simulate(LIDAR, BRIGHT, key=KEY, n_photons=2_000, max_orders=4, rtol=0.3)
    assert float(wave.neglected[0] / wave.reflectance.sum()) > 0.01


@functools.cache
def shrub(end):
    """Simulate a small canopy with open sides on a slope, from which light grazes the ground.

    It is recorded until `end`, ns. Dark and bright leaves return less and more than the ground does.
    """
    density = np.random.default_rng(0).uniform(0.0, 1.0, (8, 8, 20))
    canopy = jl.Canopy(
        jl.VoxelMap.from_lad(density, voxel_size=0.5), leaf=jl.LeafOptics([0.06, 0.46], [0.06, 0.46])
    )
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3, slope=5.0))
    lidar = jl.Lidar(wavelength=[532.0, 1064.0], position=(2.0, 2.0))
    plan = jl.plan(lidar, scene, window=(-90.0, end), describe=False)
    automatic_plan = jl.plan(lidar, scene, describe=False)
    return jl.simulate(lidar, scene, key=KEY, plan=plan, n_photons=40_000), automatic_plan


def returned_after(wave, time):
    """Return the apparent reflectance, by wavelength, of samples after a time, ns."""
    return np.asarray(wave.reflectance)[:, np.asarray(wave.time) > time].sum(axis=1)


@pytest.mark.slow
def test_neglected_is_what_returns_after_the_record():
    """A record of 200 ns neglects what one of 4000 ns finds after 200 ns, within a factor of two.

    Errors of the tail, which photons of weights of some 0.3 make, are 5 %.
    """
    short, long = shrub(200.0)[0], shrub(4000.0)[0]
    missing = returned_after(long, 200.0)
    assert np.all(missing > 0.01 * np.asarray(long.reflectance).sum(axis=1))

    def is_right(neglected):
        ratio = np.asarray(neglected) / missing
        return np.all((ratio > 0.5) & (ratio < 2.0))

    assert is_right(short.neglected)
    in_flight = np.asarray(short.energy_budget["after the window"])
    # Light that returns as much per energy as all light does, from dark leaves; all of it; and none of it.
    total = np.asarray(short.reflectance).sum(axis=1)
    for wrong in (in_flight * total, in_flight, np.zeros(2)):
        assert not is_right(wrong)


@pytest.mark.slow
def test_the_record_is_as_long_as_the_tolerance_asks():
    wave, plan = shrub(4000.0)
    total = np.asarray(wave.reflectance).sum(axis=1)
    assert plan.record_end < 2000.0
    assert np.all(returned_after(wave, plan.record_end) < plan.rtol * total)
    # A record of 300 ns does not do for bright leaves.
    assert (returned_after(wave, 300.0) > plan.rtol * total)[1]


def test_records_are_longer_where_light_grazes_the_ground():
    """The time falls with the inverse of the tolerance; without open sides, or ground, it is shorter."""
    leaf, voxels = jl.LeafOptics(0.4, 0.4), jl.VoxelMap.from_lad(np.full((4, 4, 10), 0.5), voxel_size=1.0)

    def end(rtol, ground=PALE, **changes):
        scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, **changes), ground=ground)
        return jl.plan(LIDAR, scene, rtol=rtol, describe=False).record_end

    assert end(0.01) > 1.5 * end(0.02) > 2.0 * end(0.04)
    assert end(0.01) > 2.0 * end(0.01, sides="periodic")
    assert end(0.01) > 2.0 * end(0.01, ground=jl.Ground(reflectance=0.01))
    assert end(0.01) > 2.0 * end(0.01, ground=None)
    # There is no ground beyond a terrain of 40 m.
    terrain = jl.Terrain(
        np.random.default_rng(0).uniform(0.0, 0.1, (21, 21)), 2.0, (-20.0, -20.0), reflectance=0.3
    )
    assert end(0.01) > 2.0 * end(0.01, ground=terrain)


@pytest.mark.slow
def test_little_light_after_the_record_does_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wave = jl.simulate(LIDAR, dense(0.3, 2.0, 0.1), key=KEY, n_photons=20_000)
    assert late(wave) < 0.01
    assert "still on its way" not in str(wave)


@pytest.mark.slow
def test_the_chosen_window_takes_in_bright_dense_stands():
    """Less than 1 % of the light from a stand of depth 6 and albedo 0.95 arrives after the record."""
    wave = jl.simulate(LIDAR, dense(0.95, 6.0, 0.3), key=KEY, n_photons=40_000)
    assert late(wave) < 0.01


def test_the_table_of_effects_has_a_row_for_light_after_the_record():
    dark_plan, bright_plan = (jl.plan(LIDAR, dense(a, 10.0)) for a in (0.3, 0.98))
    (dark_row,) = (effect for effect in dark_plan.effects if effect.name == "after the window")
    (bright_row,) = (effect for effect in bright_plan.effects if effect.name == "after the window")
    assert dark_row.bound < bright_row.bound
    # A window of the user may leave out all light.
    narrow_plan = jl.plan(LIDAR, dense(0.3, 10.0), window=(-90.0, -80.0))
    assert next(effect.bound for effect in narrow_plan.effects if effect.name == "after the window") == 1.0
    assert "window" in str(bright_plan)


def limit_orders(monkeypatch, count):
    """Let at most `count` orders be followed."""
    for module in (orders, simulation):
        monkeypatch.setattr(module, "MAX_ORDERS", count)


@pytest.mark.slow
def test_tolerance_is_met_only_if_the_neglected_orders_are_below_it(monkeypatch):
    limit_orders(monkeypatch, 40)
    scene = dense(1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LateLightWarning)
        wave = jl.simulate(LIDAR, scene, key=KEY, rtol=0.03)
    share = float(np.max(wave.neglected / wave.reflectance.sum(axis=1)))
    assert share > 0.03
    assert wave.info["stopped"].startswith("orders beyond ")
    assert "orders beyond the last may add" in str(wave)
    # The estimate of the plan is no smaller than that of the photons.
    assert jl.plan(LIDAR, scene, rtol=0.03, describe=False).likely_beyond >= float(
        wave.energy_budget["unfollowed"][0]
    ) - 3 * float(wave.energy_budget_stderr["unfollowed"][0])


@pytest.mark.slow
def test_more_orders_are_followed_where_too_few_were_planned(monkeypatch):
    """The plan is patched to expect little further scattering: two orders, of six that are admitted."""
    monkeypatch.setattr(orders, "scattered_again", lambda scene, optics: 1e-3)
    monkeypatch.setattr(orders, "MAX_HISTORIES", 60)
    limit_orders(monkeypatch, 6)
    calls = []
    settings = {
        "key": KEY,
        "rtol": 0.05,
        "window": (-90.0, 60.0),
        "progress": lambda _: calls.append(len(calls)),
    }
    wave = jl.simulate(LIDAR, dense(0.9, 3.0), **settings)
    assert jl.plan(LIDAR, dense(0.9, 3.0), window=(-90.0, 60.0), describe=False).orders == 2
    assert wave.info["stopped"].startswith("orders beyond 6 may add")

    # Limits of time and memory hold for both attempts together.
    def interrupt(_):
        raise KeyboardInterrupt

    early = jl.simulate(LIDAR, dense(0.9, 3.0), **settings | {"progress": interrupt})
    assert early.info["stopped"] == "interrupted"
    short = jl.simulate(LIDAR, dense(0.9, 3.0), **settings, max_seconds=1e-6)
    assert short.info["stopped"].startswith("orders beyond 2 may add")
    # Histories of six orders do not fit beside those of three; with optics applied there are none.
    planning = {"window": (-90.0, 60.0), "histories": True, "describe": False}
    three = jl.plan(LIDAR, dense(0.9, 3.0), max_orders=3, **planning)
    limit = 1.0001 * three.memory / 1e9
    with pytest.raises(ValueError, match="of memory"):
        jl.plan(LIDAR, dense(0.9, 3.0), max_orders=6, max_memory=limit, **planning)
    tight = jl.simulate(LIDAR, dense(0.9, 3.0), **settings, max_memory=limit)
    assert tight.info["stopped"].startswith("orders beyond 6 may add")


@pytest.mark.slow
def test_orders_of_the_user_are_not_extended():
    wave = jl.simulate(LIDAR, dense(0.8, 3.0), key=KEY, max_orders=2, rtol=0.05)
    assert wave.info["stopped"] == "tolerance met"
    assert float(wave.neglected[0]) > 0


@pytest.mark.slow
def test_the_energy_budget_has_standard_errors():
    """The scatter of forty simulations agrees with their errors; errors three times wrong are rejected."""
    scene, n = dense(0.8, 3.0, 0.3), 40
    plan = jl.plan(LIDAR, scene, describe=False)
    waves = [jl.simulate(LIDAR, scene, key=k, plan=plan, n_photons=4_000) for k in jax.random.split(KEY, n)]
    for name in ("escaped", "absorbed by leaf", "absorbed by ground", "after the window"):
        values = np.array([float(w.energy_budget[name][0]) for w in waves])
        errors = np.array([float(w.energy_budget_stderr[name][0]) for w in waves])
        # Errors are widened for eight batches.
        ratio = values.std(ddof=1) / errors.mean()
        assert 0.6 < ratio < 1.4, name
        assert not any(0.6 < wrong < 1.4 for wrong in (ratio / 3, 3 * ratio)), name
    flat = jl.simulate(LIDAR, jl.Scene(ground=jl.Ground()), key=KEY)
    assert all(float(e[0]) == 0 for e in flat.energy_budget_stderr.values())


@pytest.mark.slow
def test_light_is_accounted_for():
    wave = jl.simulate(LIDAR, dense(0.95, 4.0, 0.5), key=KEY, n_photons=20_000)
    np.testing.assert_allclose(sum(np.asarray(v) for v in wave.energy_budget.values()), 1.0, atol=2e-3)


@pytest.mark.slow
def test_time_for_planning_counts(monkeypatch):
    """Eight batches take less than `max_seconds`: if planning did not count, more would be traced."""
    make = simulation.make_plan

    def slow_plan(*arguments, **keywords):
        time.sleep(1.0)
        return make(*arguments, **keywords)

    settings = {"key": KEY, "rtol": 1e-6, "max_orders": 2, "window": (-90.0, 60.0)}
    # Compile everything before.
    jl.simulate(LIDAR, dense(0.3), **settings, max_seconds=1e-6)
    fast = jl.simulate(LIDAR, dense(0.3), **settings, max_seconds=1.0)
    assert fast.info["batches"] > 8
    monkeypatch.setattr(simulation, "make_plan", slow_plan)
    slow = jl.simulate(LIDAR, dense(0.3), **settings, max_seconds=1.0)
    assert (slow.info["batches"], slow.info["stopped"]) == (8, "time spent")
    assert slow.info["seconds"] > 1.0
