"""What can be chosen in place of defaults estimates the same; and what one plate sends to another."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning.alternatives import with_alternatives
from jaxlidar.planning.trace_plan import Bins
from jaxlidar.trace.deposit import instant_row
from tests.helpers import SINGLE_SAMPLE, agrees, batch_mean, single_sample_lidar, slab, slow_unless

LIDAR = jl.Lidar(divergence=2.0, sampling_interval=5.0)
SCENE = jl.Scene(
    canopy=jl.Canopy(slab(0.8, 0.1), leaf=jl.LeafOptics(reflectance=0.4, transmittance=0.3), bark=0.3),
    ground=jl.Ground(reflectance=0.3, slope=5.0),
)
PLATES = jl.Scene(
    plates=(jl.Plate(height=6.0, reflectance=0.4, transmittance=0.3, coverage=0.5, transmission="straight"),),
    ground=jl.Ground(reflectance=0.3),
)
BETWEEN = dataclasses.replace(SCENE, plates=PLATES.plates)
SIZES = {"n_photons": 2048, "n_rays": 512, "window": (-80.0, 40.0)}


def samples(wave):
    # Without the tails, which are too skew for a z-test.
    return wave.reflectance[0, 2:20]


def mean_of(scene, orders, seed, **choice):
    plan = with_alternatives(jl.plan(LIDAR, scene, max_orders=orders, **SIZES), **choice)
    return batch_mean(LIDAR, scene, plan, seed=seed, count=24, quantity=samples)


CHOICES = {
    "drawn": ({"first_order": "drawn"}, SCENE, 3),
    "drawn, one order": ({"first_order": "drawn"}, SCENE, 1),
    "drawn, plates": ({"first_order": "drawn"}, PLATES, 2),
    "one end": ({"ends": 1}, SCENE, 3),
    "seven ends, drawn": ({"ends": 7, "first_order": "drawn"}, SCENE, 3),
    "ends between plates": ({"ends": 1}, BETWEEN, 3),
    "independent": ({"points": "independent"}, SCENE, 3),
}


@pytest.mark.parametrize("case", slow_unless([], CHOICES))
def test_the_same_is_estimated(case):
    choice, scene, orders = CHOICES[case]
    a, one = mean_of(scene, orders, 1)
    b, other = mean_of(scene, orders, 2, **choice)
    tell = a > 0.01 * a.max()
    z = 4.0
    assert agrees(b[tell], np.hypot(one, other)[tell], a[tell], sigmas=z)
    assert not agrees(b[tell], np.hypot(one, other)[tell], 1.05 * a[tell], sigmas=z)


def second(wave):
    return wave.components["higher"].sum(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("transmission", slow_unless(["straight"], ["diffuse", "straight"]))
def test_what_one_plate_scatters_down_returns_from_the_next(transmission):
    """Two paths, there and back: scattered by the upper plate, reflected by the lower, through a gap."""
    upper = jl.Plate(height=6.0, reflectance=0.0, transmittance=0.5, coverage=0.5, transmission="diffuse")
    lower = jl.Plate(height=2.0, reflectance=0.4, transmittance=0.3, coverage=0.7, transmission=transmission)
    scene = jl.Scene(plates=(upper, lower))
    # All lie far below a lidar 400 km up, whose light is vertical.
    lidar = single_sample_lidar()
    plan = jl.plan(lidar, scene, max_orders=2, n_photons=4096, **SINGLE_SAMPLE)
    mean, stderr = batch_mean(lidar, scene, plan, seed=0, count=32, quantity=second)
    one_way = 0.5 * 0.5 * 0.7 * 0.4 * 0.5
    assert agrees(mean, stderr, 2 * one_way)
    # Without the probability of reflection in the weight of one path.
    assert not agrees(mean, stderr, one_way * (1 + plan.trace.lobe))


@pytest.mark.slow
def test_what_is_expected_varies_less_than_what_is_drawn():
    _, expected = mean_of(SCENE, 1, 1)
    _, drawn = mean_of(SCENE, 1, 1, first_order="drawn")
    assert np.median(drawn) > 10 * np.median(expected)


@pytest.mark.slow
def test_four_ends_vary_less_than_one():
    _, four = mean_of(SCENE, 3, 1)
    _, one = mean_of(SCENE, 3, 1, ends=1)
    assert np.median(one) > 1.3 * np.median(four)


@pytest.mark.parametrize(("kernel", "kept"), [(1, 0), (2, 1), (3, 2)])
def test_moments_of_kernels(kernel, kept):
    """Weights sum to one, the mean time is kept from two bins on, the second moment with three."""
    bins = Bins(start=2.0, width=0.5, count=40, row=4, kernel=kernel)
    time = jnp.linspace(3.0, 20.0, 1001)[:-1]
    first, row = (np.asarray(v, float) for v in instant_row(bins, time, jnp.ones_like(time)))
    place = first[:, None] - bins.row + np.arange(kernel)
    off = place - (np.asarray(time, float)[:, None] - bins.start) / bins.width
    moments = [np.sum(row * off**n, axis=1) for n in range(3)]
    exact = (1.0, 0.0, bins.kernel_variance)
    for n, (moment, value) in enumerate(zip(moments, exact)):
        assert np.mean(moment) == pytest.approx(value, abs=2e-3)
        assert (np.ptp(moment) < 1e-4) == (n <= kept)


@pytest.mark.parametrize("kernel", slow_unless([2], [1, 2]))
def test_plain_kernels_sum_to_the_same(kernel):
    plan = jl.plan(LIDAR, SCENE, max_orders=1, footprint="fixed", n_rays=256)
    plans = [with_alternatives(plan, kernel=k) for k in (3, kernel)]
    sums = [batch_mean(LIDAR, SCENE, plan, seed=0, count=2, quantity=samples)[0].sum() for plan in plans]
    assert sums[1] == pytest.approx(sums[0], rel=1e-3)


BAD = {
    "first order": ({"first_order": "odd"}, "'odd' is none of 'expected', 'drawn'"),
    "points": ({"points": "odd"}, "'odd' is none of 'lattice', 'independent'"),
    "kernel": ({"kernel": 4}, "kernel = 4 is none of 1, 2, 3"),
    "ends": ({"ends": 0}, r"ends = 0 is outside the admissible range \[1, inf\) of integers"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_choices_are_refused(case):
    choice, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        with_alternatives(jl.plan(LIDAR, SCENE), **choice)


def test_mirrors_and_hot_spots_cannot_be_drawn():
    mirror = jl.Scene(ground=jl.Ground(law=jl.Specular(roughness=0.2)))
    hot = jl.Scene(canopy=jl.Canopy(slab(0.8), leaf=jl.Isotropic(albedo=0.5), hotspot=True))
    for scene in (mirror, hot):
        with pytest.raises(ValueError, match="admissible with a mirror or a hot spot is 'expected'"):
            with_alternatives(jl.plan(LIDAR, scene), first_order="drawn")
