"""Random scenes with default settings: the waveform is right to its error, or the user is warned.

Every scene is simulated again with finer settings: a third of the error, fine bins of half the width, four
times the rays, and twice the orders where memory admits them.
"""

import warnings

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxlidar as jl

KEY = jax.random.key(17)
RTOL = 0.05
# Error of the fine bins, of the peak; see examples/benchmarks/accuracy_cost.py.
BIN_ERROR = 0.004

fractions = st.floats(0.02, 0.98)
STRUCTURES = {
    "crown over ground": ("open", 0, True),
    "stand over ground": ("periodic", 0, True),
    "two plates": (None, 2, True),
    "crown and plate, no ground": ("open", 1, False),
}
PULSES = {
    "6 ns": jl.GaussianPulse(fwhm=6.0),
    "1.5 ns": jl.GaussianPulse(fwhm=1.5),
    "rectangle": jl.RectangularPulse(length=3.0),
}


@st.composite
def cases(draw):
    """Numbers of a lidar and a scene of one of the structures."""

    def layer(number):
        return {
            "height": 20.0 * number + draw(st.floats(3.0, 20.0)),
            "albedo": draw(fractions),
            "reflected": draw(fractions),
            "coverage": draw(st.floats(0.1, 1.0)),
        }

    structure = draw(st.sampled_from(list(STRUCTURES)))
    return {
        "structure": structure,
        "layers": [layer(i) for i in range(STRUCTURES[structure][1])],
        "albedo": draw(fractions),
        "reflected": draw(fractions),
        "shape": tuple(draw(st.integers(2, 8)) for _ in range(3)),
        "seed": draw(st.integers(0, 1000)),
        "depth": draw(st.floats(0.05, 8.0)),
        "empty": draw(st.floats(0.0, 0.6)),
        "height": draw(st.floats(0.5, 30.0)),
        "sides": (draw(st.floats(0.3, 3.0)), draw(st.floats(0.3, 3.0))),
        "origin": (draw(st.floats(-4.0, 0.0)), draw(st.floats(-4.0, 0.0)), draw(st.floats(1.0, 6.0))),
        "slope": draw(st.floats(0.0, 35.0)),
        "aspect": draw(st.floats(0.0, 360.0)),
        "rho": draw(fractions),
        "divergence": draw(st.floats(0.1, 20.0)),
        "zenith": draw(st.sampled_from([0.0, 15.0, 40.0])),
        "azimuth": draw(st.floats(0.0, 360.0)),
        "pulse": draw(st.sampled_from(list(PULSES))),
        "field_of_view": draw(st.sampled_from([None, 30.0])),
    }


def build(p):
    """Return the lidar and the scene."""
    sides, _, with_ground = STRUCTURES[p["structure"]]
    canopy = ground = None
    if sides is not None:
        random, shape = np.random.default_rng(p["seed"]), p["shape"]
        depth = random.uniform(0, 2, shape) * (p["depth"] / shape[2])
        depth[random.uniform(0, 1, shape) < p["empty"]] = 0.0
        depth[0, 0, 0] = p["depth"] / shape[2]
        step = p["height"] / shape[2]
        voxels = jl.VoxelMap.from_extinction(
            leaf=depth / step, voxel_size=(*p["sides"], step), origin=p["origin"]
        )
        canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(*split(p)), sides=sides, hotspot=False)
    if with_ground:
        slope = 0.0 if sides == "periodic" else p["slope"]
        ground = jl.Ground(reflectance=p["rho"], slope=slope, aspect=p["aspect"])
    plates = tuple(jl.Plate(v["height"], *split(v), coverage=v["coverage"]) for v in p["layers"])
    names = ("divergence", "zenith", "azimuth", "field_of_view")
    lidar = jl.Lidar(pulse=PULSES[p["pulse"]], **{name: p[name] for name in names})
    return lidar, jl.Scene(canopy=canopy, plates=plates, ground=ground)


def split(p):
    """Return reflectance and transmittance."""
    return p["albedo"] * p["reflected"], p["albedo"] * (1 - p["reflected"])


def simulated(lidar, scene, **settings):
    """Return the waveform, and whether the user was warned (`info["stopped"]` counts)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        wave = jl.simulate(lidar, scene, key=KEY, **settings)
    return wave, bool(caught) or wave.info["stopped"] not in ("tolerance met", "nothing is random")


def disagreement(wave, better):
    """Return the largest difference over the tolerance by the errors of both waveforms; 1 is the bound."""
    estimate, reference = (np.asarray(w.reflectance, float)[0] for w in (wave, better))
    error = np.hypot(np.asarray(wave.stderr, float)[0], np.asarray(better.stderr, float)[0])
    # Only bright samples: with few batches the distribution of the others is too skew for a z-test.
    seen = reference > 0.01 * np.max(reference)
    tolerance = 5.0 * error + BIN_ERROR * np.max(reference) + 0.25 * RTOL * reference
    return float(np.max(np.abs(estimate - reference)[seen] / tolerance[seen], initial=0.0))


def finer_settings(lidar, scene, plan):
    interval = plan.sample_interval
    settings = {
        "rtol": RTOL / 3,
        "n_rays": 4 * plan.n_rays,
        "bin_width": plan.bins.width / 2,
        "window": (plan.sample_start, plan.sample_start + interval * (plan.n_samples - 1)),
    }
    max_orders = jl.plan(lidar, scene, describe=False, **settings).scope.affordable_orders
    return {**settings, "max_orders": min(2 * plan.orders, max_orders), "max_seconds": 30.0}


@pytest.mark.slow
def test_waveforms_are_right_to_their_error_or_the_user_is_warned():
    compared = []

    @settings(
        max_examples=16,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow],
    )
    @given(case=cases())
    def check(case):
        lidar, scene = build(case)
        wave, is_warned = simulated(lidar, scene, rtol=RTOL)
        for name, component in {**wave.components, "all": wave.reflectance}.items():
            assert float(np.min(component)) >= -1e-6 * float(np.max(wave.reflectance)), name
        total = np.sum([np.asarray(v) for v in wave.energy_budget.values()], axis=0)
        slack = 5 * float(np.sqrt(sum(float(e[0]) ** 2 for e in wave.energy_budget_stderr.values()))) + 1e-4
        np.testing.assert_allclose(total, 1.0, atol=slack)
        if not is_warned:
            plan = jl.plan(lidar, scene, rtol=RTOL, describe=False)
            better, _ = simulated(lidar, scene, **finer_settings(lidar, scene, plan))
            compared.append(disagreement(wave, better))
            assert compared[-1] < 1.0

    check()
    # A library that always warned would pass without a single comparison.
    assert len(compared) >= 4


@pytest.mark.slow
def test_a_wrong_waveform_is_noticed():
    """Ground that is brighter by a tenth."""
    ground = jl.Ground(reflectance=0.3)
    plates = (jl.Plate(8.0, 0.3, 0.3),)
    lidar, scene = jl.Lidar(), jl.Scene(plates=plates, ground=ground)
    plan = jl.plan(lidar, scene, rtol=RTOL)
    better, _ = simulated(lidar, scene, **finer_settings(lidar, scene, plan))
    same, _ = simulated(lidar, scene, rtol=RTOL)
    assert disagreement(same, better) < 1.0
    wrong, _ = simulated(lidar, jl.Scene(plates=plates, ground=jl.Ground(reflectance=0.33)), rtol=RTOL)
    assert wrong.reflectance.shape == better.reflectance.shape
    assert disagreement(wrong, better) > 1.0
