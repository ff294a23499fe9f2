"""Plans that do not fit into memory are refused with numbers; long records need no matrix."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.fit.model import ForwardModel, tangents_per_pass
from inversion.fit.planning import plan_for_bounds, size_arguments
from inversion.fit.unknowns import bind_unknowns
from jaxlidar.planning import memory
from jaxlidar.planning.memory import check_memory, format_bytes, memory_limit
from jaxlidar.planning.record_times import pulse_band
from jaxlidar.sampling.batch_programs import make_batch_tracer
from jaxlidar.spectral.pulse_convolution import PulseConvolution, pulse_convolution
from jaxlidar.spectral.waveform import waveform_of_model
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.photons.higher_orders import trace_higher_orders
from tests.helpers import slab, slow_unless, with_applied_optics

ROOT = Path(__file__).resolve().parents[2]
KEY = jax.random.key(2)
GROUND = jl.Ground(reflectance=0.3)


def plates(count):
    return tuple(jl.Plate(1.0 + i, 0.3, 0.3) for i in range(count))


def test_many_plates_are_refused_before_anything_is_allocated():
    canopy = jl.Canopy(slab(1.0), leaf=jl.LeafOptics(0.4, 0.4), hotspot=False)
    scene = jl.Scene(canopy=canopy, plates=plates(4), ground=GROUND)
    lidar = jl.Lidar(wavelength=np.linspace(500.0, 1600.0, memory.MAX_APPLIED_WAVELENGTHS + 1))
    with pytest.raises(ValueError, match=r"would take about .* GB of memory; .* at most 8 wavelengths"):
        jl.plan(lidar, scene, max_orders=12, describe=False)
    # Nothing but fewer plates helps there.
    scene = jl.Scene(plates=plates(19), ground=GROUND)
    with pytest.raises(ValueError, match=r"or have fewer plates .*; order one alone .* of one canopy$"):
        jl.plan(jl.Lidar(), scene, max_orders=1, describe=False)


@pytest.mark.slow
def test_the_sum_of_photons_is_the_result():
    """Beside the result there is one tally, that of a group of photons, with margins."""
    canopy = jl.Canopy(slab(1.0), leaf=jl.LeafOptics(0.4, 0.4), hotspot=False)
    scene, lidar = jl.Scene(canopy=canopy, plates=plates(1), ground=GROUND), jl.Lidar()
    plan = jl.plan(lidar, scene, n_photons=131072, max_orders=8, histories=True, describe=False)
    device_scene = build_device_scene(jl.make_setup(lidar, scene, plan), derivatives="none")
    compiled = jax.jit(lambda key: trace_higher_orders(device_scene, key)).lower(KEY).compile()
    sizes = compiled.memory_analysis()
    assert sizes is not None
    assert sizes.output_size_in_bytes > 4e6
    assert sizes.temp_size_in_bytes < 1.5 * sizes.output_size_in_bytes


@pytest.mark.slow
def test_the_waveform_of_a_sum_needs_no_second_response():
    """The mean over batches is taken after the sum over histories: a mean response would be as large."""
    canopy = jl.Canopy(slab(1.0), leaf=jl.LeafOptics(0.4, 0.4), bark=0.4, hotspot=False)
    scene, lidar = jl.Scene(canopy=canopy, plates=plates(1), ground=GROUND), jl.Lidar()
    plan = jl.plan(lidar, scene, n_photons=131072, max_orders=8, histories=True, describe=False)
    tracer = make_batch_tracer(jl.make_setup(lidar, scene, plan), KEY)
    response, _ = tracer.batch_function(KEY)(0)
    size = sum(array.nbytes for array in jax.tree.leaves(response))
    assert size > 4e6

    def temporaries(make_waveform):
        program = jax.jit(lambda total: make_waveform(total, tracer.model)).lower(response).compile()
        sizes = program.memory_analysis()
        assert sizes is not None
        return sizes.temp_size_in_bytes

    def of_mean(total, model):
        return waveform_of_model(jax.tree.map(lambda a: a / 8.0, total), model)

    def of_sum(total, model):
        return waveform_of_model(total, model.for_sum_of(jnp.asarray(8.0)))

    assert temporaries(of_sum) < temporaries(of_mean) - 0.9 * size
    np.testing.assert_allclose(
        of_sum(response, tracer.model).reflectance, of_mean(response, tracer.model).reflectance, rtol=1e-5
    )


TWO_WAVELENGTHS = jl.Lidar(wavelength=(532.0, 1064.0))
LEAF = jl.LeafOptics(0.3, 0.2)
SCENES = {
    "leaf and bark over ground": {"ground": GROUND, "canopy": {"bark": 0.4}},
    "straight": {"ground": GROUND, "canopy": {"transmission": "straight"}},
    "plates over ground": {
        "ground": GROUND,
        "plates": (jl.Plate(6.0, 0.3, 0.2, coverage=0.6),),
        "canopy": {},
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(["leaf and bark over ground"], SCENES))
def test_optics_applied_while_light_is_traced_give_the_same(name):
    """The photons are the same, and so are waveform, errors and energy budget, to rounding."""
    scene_fields = dict(SCENES[name])
    bark = [0.1] if "bark" in scene_fields["canopy"] else []
    leaf = jl.Prospect(Cab=40.0) if "straight" not in name else LEAF
    canopy = jl.Canopy(slab(0.5, *bark), leaf=leaf, **{"hotspot": False, **scene_fields.pop("canopy")})
    scene = jl.Scene(canopy=canopy, **scene_fields)
    plan = jl.plan(TWO_WAVELENGTHS, scene, max_orders=4, histories=True, describe=False)
    assert plan.config.keeps_histories
    a, b = (
        jl.simulate(TWO_WAVELENGTHS, scene, key=KEY, plan=p, n_photons=2048)
        for p in (plan, with_applied_optics(plan))
    )
    for quantity in ("reflectance", "stderr", "neglected"):
        np.testing.assert_allclose(getattr(b, quantity), getattr(a, quantity), rtol=2e-4, atol=1e-7)
    assert a.energy_budget.keys() == b.energy_budget.keys()
    for name, fraction in a.energy_budget.items():
        np.testing.assert_allclose(b.energy_budget[name], fraction, rtol=2e-4, atol=1e-6)
    for name, component in a.components.items():
        np.testing.assert_allclose(b.components[name], component, rtol=2e-4, atol=1e-7)


@pytest.mark.slow
def test_derivatives_where_optics_are_applied_while_light_is_traced():
    """With respect to an optical and a geometric value."""

    def total(plan, x):
        canopy = jl.Canopy(slab(0.5), leaf=jl.LeafOptics(x[0], 0.2), hotspot=False)
        scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3, height=x[1]))
        setup = jl.make_setup(TWO_WAVELENGTHS, scene, plan)
        return jl.total_reflectance(jl.trace_scene(setup, KEY), setup)

    scene = jl.Scene(canopy=jl.Canopy(slab(0.5), leaf=LEAF, hotspot=False), ground=GROUND)
    plan = jl.plan(
        TWO_WAVELENGTHS, scene, max_orders=4, n_photons=16384, window=(-100.0, 60.0), describe=False
    )
    x = jax.numpy.array([0.3, 0.1])
    a, b = (jax.jit(jax.jacfwd(lambda x, p=p: total(p, x)))(x) for p in (plan, with_applied_optics(plan)))
    assert np.max(np.abs(a)) > 1e-3
    np.testing.assert_allclose(b, a, rtol=2e-3, atol=1e-5 * np.max(np.abs(a)))


def test_when_optics_are_applied_while_light_is_traced():
    """They are if histories take much more memory and wavelengths are few; fits then trace for new optics."""
    scene = jl.Scene(
        canopy=jl.Canopy(slab(1.0), leaf=jl.LeafOptics(0.5, 0.5), hotspot=False), ground=jl.Ground(0.0, 1.0)
    )
    long = {"max_orders": 300, "window": (-81.0, 3000.0), "describe": False}
    plan = jl.plan(jl.Lidar(), scene, **long)
    assert not plan.config.keeps_histories
    assert plan.memory < 1e9
    assert "optics applied while light is traced" in str(plan)
    assert jl.plan(jl.Lidar(), scene, describe=False, max_orders=10).config.keeps_histories
    unknown = inversion.Unknown("ground.reflectance", bounds=(0.1, 1.0))
    bound_unknowns = bind_unknowns([unknown], scene)
    for case_plan, traces in (
        (plan, True),
        (jl.plan(jl.Lidar(), scene, describe=False, max_orders=3), False),
    ):
        assert ForwardModel(jl.Lidar(), scene, case_plan, bound_unknowns, KEY).retraces == traces


def test_the_user_sets_the_limit():
    scene = jl.Scene(canopy=jl.Canopy(slab(1.0), leaf=jl.LeafOptics(0.4, 0.4), hotspot=False), ground=GROUND)
    plan = jl.plan(jl.Lidar(), scene, describe=False)
    assert 1e5 < plan.memory < 1e9
    memory_of_one, memory_of_two = (plan.jacobian_memory(n) for n in (1, 2))
    additional = memory_of_two - memory_of_one
    jacobian_text = (
        f"a Jacobian in one geometric unknown {format_bytes(memory_of_one)}, "
        f"in each more {format_bytes(additional)}"
    )
    assert str(plan).splitlines()[-1] == f"about {format_bytes(plan.memory)} of memory; {jacobian_text}"
    with pytest.raises(ValueError, match=r"admissible is max_memory = 0\.001 GB"):
        jl.simulate(jl.Lidar(), scene, key=KEY, max_memory=0.001)
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="max_memory"):
            jl.plan(jl.Lidar(), scene, max_memory=bad)


def test_sizes_in_words():
    assert [format_bytes(x) for x in (20.0, 2.34e4, 5.6e6, 1.234e10)] == [
        "20 bytes",
        "23 kB",
        "5.6 MB",
        "12 GB",
    ]
    check_memory(0.9e9, memory_limit(1.0))
    assert memory.machine_memory() > 1e8


@pytest.mark.slow
def test_a_grazing_beam_over_a_slope_takes_no_matrix():
    """At 85 degrees the footprint is long: 19 GB as a matrix."""
    lidar = jl.Lidar(zenith=85.0, divergence=3.0)
    scene = jl.Scene(ground=jl.Ground(reflectance=0.4), plates=(jl.Plate(20.0, 0.2, 0.1),))
    plan = jl.plan(lidar, scene, max_orders=1, describe=False)
    assert plan.bins.count * plan.n_samples > memory.MAX_DENSE_PULSE
    # The record of a plan that is an argument of a program has a band, too.
    assert not jax.eval_shape(lambda plan: pulse_convolution(lidar, plan), plan).is_dense
    assert plan.memory < 1e9
    wave = jl.simulate(lidar, scene, key=KEY, plan=plan)
    total = float(wave.reflectance.sum())
    assert np.isfinite(np.asarray(wave.reflectance)).all()
    # The plate returns 0.2, the ground 0.4 through the plate twice (0.1^2), both times the cosine of 85
    # degrees.
    cosine = np.cos(np.deg2rad(85.0))
    assert total == pytest.approx((0.2 + 0.4 * 0.1**2) * cosine, rel=2e-3)


def band_of(plan):
    """Return the band of the pulse of a plan whose record is too short to have one."""
    assert plan.pulse_band is None
    return pulse_band(plan.pulse_support, plan.sample_interval, plan.first_sample, plan.bins.width)


@pytest.mark.parametrize(
    ("pulse", "window"),
    [
        (jl.GaussianPulse(6.0), (-60.0, 60.0)),
        (jl.RectangularPulse(3.0), (-100.0, 3.0)),
        (jl.SampledPulse([-2.0, 0.0, 9.0], [0.0, 1.0, 0.0]), (7.0, 60.0)),
    ],
)
def test_the_band_is_the_matrix(pulse, window):
    lidar = jl.Lidar(pulse=pulse)
    plan = jl.plan(lidar, jl.Scene(plates=plates(1), ground=GROUND), window=window, describe=False)
    fine = jax.random.uniform(KEY, (2, plan.bins.count))
    dense = jax.jit(lambda: pulse_convolution(lidar, plan))()
    assert dense.is_dense
    expected = dense(fine)
    band = jax.jit(lambda: pulse_convolution(lidar, plan, band=band_of(plan)))()
    assert not band.is_dense
    assert band.fractions.size <= dense.fractions.size
    np.testing.assert_allclose(band(fine), expected, atol=1e-6 * float(np.max(expected)))
    # The same test rejects a band that is a bin off.
    wrong = dataclasses.replace(band, first_offset=band.first_offset + 1)
    assert not np.allclose(wrong(fine), expected, atol=1e-6 * float(np.max(expected)))


@pytest.mark.parametrize(
    ("n_bins", "n_samples", "bins_per_sample", "first_offset", "width"),
    [
        (1, 1, 1, 0, 1),
        (7, 5, 3, -4, 1),
        (40, 20, 2, -17, 9),
        (40, 6, 7, 3, 50),
        (12, 30, 4, -60, 33),
        (33, 2, 5, -100, 12),
        (25, 9, 3, 20, 6),
    ],
)
def test_bands_of_all_sizes_are_their_matrix(n_bins, n_samples, bins_per_sample, first_offset, width):
    """Bins before and behind what samples take, tiles longer than the record, bands wider than the bins."""
    fractions = jax.random.uniform(KEY, (width,))
    sizes = {"n_bins": n_bins, "n_samples": n_samples, "bins_per_sample": bins_per_sample}
    band = PulseConvolution(fractions, first_offset, **sizes, is_dense=False)
    offset = np.arange(n_samples)[None, :] * bins_per_sample - np.arange(n_bins)[:, None] - first_offset
    matrix = np.where((offset >= 0) & (offset < width), np.asarray(fractions)[offset.clip(0, width - 1)], 0.0)
    fine = np.asarray(jax.random.normal(jax.random.key(1), (2, 3, n_bins)))
    np.testing.assert_allclose(band(jnp.asarray(fine)), fine @ matrix, atol=1e-5)


def test_the_smaller_of_matrix_and_band_is_applied():
    scene = jl.Scene(ground=GROUND)
    short, long = (jl.Lidar(pulse=jl.GaussianPulse(fwhm)) for fwhm in (4.0, 200.0))
    window = (-200.0, 200.0)
    plans = [jl.plan(lidar, scene, window=window, describe=False) for lidar in (short, long)]
    chosen = [pulse_convolution(lidar, plan, band=band_of(plan)) for lidar, plan in zip((short, long), plans)]
    assert [convolution.is_dense for convolution in chosen] == [False, True]
    # A record beside all returns takes nothing.
    beside = jl.plan(short, scene, window=(-520.0, -500.0), describe=False)
    convolution = pulse_convolution(short, beside, band=band_of(beside))
    assert float(jnp.abs(convolution(jnp.ones(beside.bins.count))).max()) < 1e-6


def layers_scaled(scene, factor):
    """Scale the extinction of layers; it sets the voxel size too, which makes the unknown geometric."""
    voxels = scene.canopy.voxels
    return eqx.tree_at(
        lambda s: (s.canopy.voxels.leaf, s.canopy.voxels.voxel_size),
        scene,
        (voxels.leaf * factor[None, None], 1.0 * voxels.voxel_size),
    )


def layered(orders, layers=4, end=100.0, max_memory=None, **settings):
    """Return a model with leaf by layer and height and reflectance of the ground unknown, and its start."""
    voxels = slab(0.4, 0.05, shape=(1, 1, layers))
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=LEAF, bark=0.3, hotspot=False), ground=GROUND)
    settings = {"n_photons": 2048, "n_rays": 64, **settings}
    plan = jl.plan(TWO_WAVELENGTHS, scene, max_orders=orders, window=(-81.0, end), describe=False, **settings)
    plan = dataclasses.replace(plan, scope=dataclasses.replace(plan.scope, max_memory=max_memory))
    layer_factors = {"bounds": (0.5, 2.0), "start": np.ones(layers), "apply": layers_scaled, "name": "layers"}
    bound_unknowns = bind_unknowns(
        [
            inversion.Unknown(**layer_factors),
            inversion.Unknown("ground.height", bounds=(-1.0, 1.0)),
            inversion.Unknown("ground.reflectance", bounds=(0.1, 1.0)),
        ],
        scene,
    )
    return ForwardModel(TWO_WAVELENGTHS, scene, plan, bound_unknowns, KEY), np.concatenate(
        [np.ravel(s.start) for s in bound_unknowns]
    )


def room_for(model, columns):
    """Return the memory of `columns` columns at once, GB."""
    return 1.0001e-9 * model.inputs.plan.jacobian_memory(columns)


@pytest.mark.slow
def test_columns_of_a_jacobian_are_computed_in_groups_if_memory_is_short():
    """The columns are the same, with the last group padded; a limit below one column is refused."""
    unlimited, start = layered(1)
    expected = unlimited(start)
    limits = [room_for(unlimited, n) for n in (2, 1)]
    model, _ = layered(1, max_memory=limits[0])
    assert (
        unlimited.inputs.tangents_per_pass,
        model.inputs.tangents_per_pass,
        expected.jacobian.shape[-1],
    ) == (5, 2, 6)
    grouped = model(start)
    np.testing.assert_allclose(grouped.jacobian, expected.jacobian, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(grouped.reflectance, expected.reflectance, rtol=1e-5, atol=1e-8)
    assert np.abs(grouped.jacobian).max(axis=(0, 1)).min() > 1e-5
    assert layered(1, max_memory=limits[1])[0].inputs.tangents_per_pass == 1
    with pytest.raises(ValueError, match=r"one at a time; admissible is max_memory = .* GB of the plan"):
        layered(1, max_memory=0.5 * limits[1])


def test_derivatives_have_no_histories_beyond_the_last_order():
    """Programs without derivatives have room for more histories, to be shared by plans."""
    scene = jl.Scene(canopy=jl.Canopy(slab(0.4), leaf=LEAF, hotspot=False), ground=GROUND)
    settings = {"n_photons": 128, "window": (-81.0, 50.0), "describe": False}
    plan = jl.plan(TWO_WAVELENGTHS, scene, max_orders=9, **settings)
    n_channels = len(plan.config.channels)
    assert 9 == plan.degree < plan.config.degree
    setup = jl.make_setup(TWO_WAVELENGTHS, scene, plan)
    shapes = jax.eval_shape(lambda key: jl.trace_scene(setup, key, reverse=False), KEY)
    assert shapes.higher.shape[2] == math.comb(9 + n_channels, n_channels)
    # Every flight and the return path may pass the plate.
    assert (
        jl.plan(TWO_WAVELENGTHS, jl.Scene(ground=GROUND, plates=plates(1)), max_orders=2, **settings).degree
        == 5
    )


def test_groups_have_about_equal_sizes():
    model = layered(4)[0]
    plan = model.inputs.plan
    for columns, room, expected in ((0, 1, 0), (7, 7, 7), (7, 6, 4), (7, 3, 3), (20, 9, 7)):
        scope = dataclasses.replace(plan.scope, max_memory=room_for(model, room))
        limited = dataclasses.replace(plan, scope=scope)
        assert tangents_per_pass(limited, columns) == expected


MEASURE_MEMORY = """
import sys, threading, time
import jax, numpy as np
import jaxlidar as jl

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

def watched(run):
    "Bytes that a call takes at its peak, more than before."
    base, peak, done = resident(), 0, False

    def watch():
        nonlocal peak
        while not done:
            peak = max(peak, resident())
            time.sleep(0.005)

    watcher = threading.Thread(target=watch)
    watcher.start()
    run()
    done = True
    watcher.join()
    return peak - base
"""

SIMULATE = """
orders, end, bark = int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
voxels = jl.VoxelMap.from_extinction(
    leaf=np.full((2, 2, 4), 0.2), bark=np.full((2, 2, 4), bark), voxel_size=2.0, origin=(-2.0, -2.0, 0.0)
)
canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.3), bark=0.3)
scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
lidar = jl.Lidar(wavelength=np.linspace(500.0, 1600.0, 9))
settings = {"window": (-81.0, end), "max_memory": 15.0}
jl.simulate(lidar, scene, key=jax.random.key(0), max_orders=2, n_photons=8192, **settings)
plan = jl.plan(lidar, scene, max_orders=orders, **settings)
settings = {"key": jax.random.key(0), "plan": plan, "n_photons": 65536}
print(plan.memory, watched(lambda: jl.simulate(lidar, scene, **settings)))
"""

EVALUATE_MODEL = """
from tests.planning.test_memory import layered, room_for

orders, layers, end = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
model, start = layered(orders, layers, end, max_memory=15.0, n_photons=16384, histories=True)
model(start)
assert model.inputs.tangents_per_pass == layers + 1
print(1e9 * room_for(model, layers + 1), watched(lambda: model(start)))
"""


def predicted_and_measured(program, *arguments):
    command = [sys.executable, "-c", MEASURE_MEMORY + program, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    process = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, env=environment)
    return tuple(map(float, process.stdout.split()))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read as on Linux")
@pytest.mark.parametrize(("orders", "end", "bark"), [(9, 500.0, 0.05), (13, 800.0, 0.05)])
def test_memory_is_as_predicted(orders, end, bark):
    """To 30 %."""
    predicted, measured = predicted_and_measured(SIMULATE, orders, end, bark)
    assert measured == pytest.approx(predicted, rel=0.3)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read as on Linux")
@pytest.mark.parametrize(("orders", "layers", "end"), [(9, 3, 800.0), (9, 12, 300.0)])
def test_memory_of_a_jacobian_is_as_predicted(orders, layers, end):
    """To 30 %."""
    predicted, measured = predicted_and_measured(EVALUATE_MODEL, orders, layers, end)
    assert measured == pytest.approx(predicted, rel=0.3)


@pytest.mark.parametrize(("orders", "keeps"), [(12, True), (24, False)])
def test_large_histories_are_left_to_fits(orders, keeps):
    """Simulations apply optics to many orders; derivatives with respect to optics are worth the memory."""
    leaf = jl.LeafOptics(reflectance=0.4, transmittance=0.4)
    canopy = jl.Canopy(slab(2.0), leaf=leaf, sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
    plan = jl.plan(jl.Lidar(), scene, max_orders=orders, describe=False)
    assert plan.config.keeps_histories is keeps
    unknown = inversion.Unknown("ground.reflectance", bounds=(0.1, 0.9))
    time = np.arange(-80.0, 40.0)
    sizes = size_arguments(None, None, orders, None)
    fitted = plan_for_bounds(jl.Lidar(), scene, bind_unknowns([unknown], scene), time, **sizes)
    assert fitted.config.keeps_histories
