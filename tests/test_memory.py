"""What does not fit into memory is refused with numbers; long records need no matrix."""

import dataclasses

import jax
import numpy as np
import pytest
from helpers import slab

import jaxlidar as jl
from jaxlidar.planning import memory, sampling
from jaxlidar.planning.memory import check_memory, in_words, memory_limit
from jaxlidar.planning.sampling import sampling_of

KEY = jax.random.key(2)
GROUND = jl.Ground(reflectance=0.3)


def plates(count):
    return tuple(jl.Plate(1.0 + i, 0.3, 0.3) for i in range(count))


def test_many_plates_are_refused_before_anything_is_allocated():
    canopy = jl.Canopy(slab(1.0), leaf=jl.LeafOptics(0.4, 0.4))
    scene = jl.Scene(canopy=canopy, plates=plates(4), ground=GROUND)
    with pytest.raises(ValueError, match=r"would take about .* GB of memory; admissible is max_memory"):
        jl.plan(jl.Lidar(), scene, max_orders=12, describe=False)


def test_the_limit_is_the_users():
    scene = jl.Scene(canopy=jl.Canopy(slab(1.0), leaf=jl.LeafOptics(0.4, 0.4)), ground=GROUND)
    plan = jl.plan(jl.Lidar(), scene, describe=False)
    assert 1e5 < plan.memory < 1e9
    assert str(plan).splitlines()[-1] == f"about {in_words(plan.memory)} of memory"
    with pytest.raises(ValueError, match=r"admissible is max_memory = 0\.001 GB"):
        jl.simulate(jl.Lidar(), scene, key=KEY, max_memory=0.001)
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="max_memory"):
            jl.plan(jl.Lidar(), scene, max_memory=bad)


def test_sizes_in_words():
    assert [in_words(x) for x in (20.0, 2.34e4, 5.6e6, 1.234e10)] == ["20 bytes", "23 kB", "5.6 MB", "12 GB"]
    check_memory(0.9e9, memory_limit(1.0))
    assert memory.machine_memory() > 1e8


def test_a_grazing_beam_over_a_slope_takes_no_matrix():
    """At 85 degrees the footprint is long: 19 GB as a matrix."""
    lidar = jl.Lidar(zenith=85.0, divergence=3.0)
    scene = jl.Scene(ground=jl.Ground(reflectance=0.4), plates=(jl.Plate(20.0, 0.2, 0.1),))
    plan = jl.plan(lidar, scene, max_orders=1, describe=False)
    assert plan.bins.count * plan.n_samples > sampling.DENSE
    assert plan.memory < 1e9
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan)
    whole = float(wave.reflectance.sum())
    assert np.isfinite(np.asarray(wave.reflectance)).all()
    # Plate 0.2 and, through it and back, the ground: 0.1^2 of 0.4; both are seen at 85 degrees.
    cosine = np.cos(np.deg2rad(85.0))
    assert whole == pytest.approx((0.2 + 0.4 * 0.1**2) * cosine, rel=2e-3)


@pytest.mark.parametrize(
    ("pulse", "window"),
    [
        (jl.GaussianPulse(6.0), None),
        (jl.RectangularPulse(3.0), (-100.0, 3.0)),
        (jl.SampledPulse([-2.0, 0.0, 9.0], [0.0, 1.0, 0.0]), (7.0, 60.0)),
    ],
)
def test_the_band_is_the_matrix(pulse, window, monkeypatch):
    lidar = jl.Lidar(pulse=pulse)
    plan = jl.plan(lidar, jl.Scene(plates=plates(1), ground=GROUND), window=window, describe=False)
    fine = jax.random.uniform(KEY, (2, plan.bins.count))
    dense = jax.jit(lambda: sampling_of(lidar, plan))()
    assert dense.dense
    expected = dense(fine)
    monkeypatch.setattr(sampling, "DENSE", 1)
    band = jax.jit(lambda: sampling_of(lidar, plan))()
    assert not band.dense
    assert band.share.size <= dense.share.size
    np.testing.assert_allclose(band(fine), expected, atol=1e-6 * float(np.max(expected)))
    # The same test rejects a band that is a bin off.
    wrong = dataclasses.replace(band, first=band.first + 1)
    assert not np.allclose(wrong(fine), expected, atol=1e-6 * float(np.max(expected)))
