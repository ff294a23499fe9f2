"""Programs are compiled for size buckets: everyday changes of a scene do not compile anything.

The program that builds the device scene is not counted: it is short, and compiled for the sizes as they are.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._jax.programs import Program
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.sampling import batch_programs

KEY = jax.random.key(0)
SHAPE = (8, 8, 18)


def simulate(**changes):
    """Simulate a crown over ground, with changes."""
    values = {"rtol": 0.05, "window": (-120.0, 60.0), "shape": SHAPE, "angles": "planophile"} | changes
    lidar = {"wavelength": (532.0, 1064.0, 1550.0), "divergence": 2.0, "zenith": 5.0}
    lidar |= {
        name: values[name] for name in ("wavelength", "divergence", "zenith", "pulse") if name in values
    }
    ground = {"reflectance": 0.3, "slope": 5.0}
    ground |= {name: values[name] for name in ("slope", "height") if name in values}
    voxels = jl.VoxelMap.from_lad(
        np.full(values["shape"], 0.5),
        voxel_size=0.5,
        origin=(-2, -2, 5),
        leaf_angles=jl.LeafAngles.named(values["angles"]),
    )
    leaf = jl.Prospect(N=1.5, Cab=values.get("Cab", 40.0), Car=8.0, Cw=0.01, Cm=0.009)
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, hotspot=False), ground=jl.Ground(**ground))
    return jl.simulate(jl.Lidar(**lidar), scene, key=KEY, rtol=values["rtol"], window=values["window"])


CHANGES = {
    "tolerance": {"rtol": 0.02},
    "slope": {"slope": 6.0},
    "height of the ground": {"height": 0.3},
    "pulse": {"pulse": jl.GaussianPulse(fwhm=5.0)},
    "fewer wavelengths": {"wavelength": 1064.0},
    "zenith": {"zenith": 6.0},
    "window": {"window": (-125.0, 70.0)},
    "one more layer": {"shape": (8, 8, 19)},
    "one more tree": {"shape": (9, 8, 18)},
    "divergence": {"divergence": 1.5},
    "leaf angles": {"angles": "erectophile"},
    "chlorophyll": {"Cab": 50.0},
}


@pytest.fixture(scope="module")
def compiled():
    """Return a function that counts the versions of the programs, after a first simulation."""
    programs = {name: p for name, p in vars(batch_programs).items() if isinstance(p, Program)}
    del programs["compiled_geometry"]
    for program in programs.values():
        program.clear()

    def count():
        return {name: len(program.versions) for name, program in programs.items()}

    simulate()
    used = {f"_compiled_{name}" for name in ("first", "higher", "estimate", "sum", "waveform")}
    unused = {"_compiled_trace", "_compiled_batch"}
    assert count() == dict.fromkeys(used, 1) | dict.fromkeys(unused, 0)
    return count


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "tolerance" else ()) for name in CHANGES]
)
def test_everyday_changes_compile_nothing(compiled, name):
    before = compiled()
    wave = simulate(**CHANGES[name])
    assert compiled() == before
    assert np.all(np.isfinite(wave.reflectance))


@pytest.mark.slow
def test_a_new_effect_does_compile(compiled):
    """Negative control of the counting: the trace of a beam at nadir is another program."""
    before = compiled()
    simulate(zenith=0.0)
    assert compiled()["_compiled_higher"] == before["_compiled_higher"] + 1


@pytest.mark.slow
def test_rounding_up_of_sizes_changes_no_value():
    """A plan with exact sizes gives the same waveform, to rounding."""
    scene = jl.Scene(
        canopy=jl.Canopy(
            jl.VoxelMap.from_lad(np.full((3, 2, 5), 0.8), voxel_size=1.0, origin=(-1.5, -1.0, 2.0)),
            leaf=jl.LeafOptics(reflectance=0.4, transmittance=0.3),
            hotspot=False,
        ),
        ground=jl.Ground(reflectance=0.4),
    )
    lidar = jl.Lidar(divergence=2.0, wavelength=(1000.0, 1064.0, 1100.0))
    settings = {"key": KEY, "n_photons": 20_000, "max_orders": 5, "window": (-60.0, 30.0)}
    wave = jl.simulate(lidar, scene, **settings)
    # Within a transformation sizes are those of the plan.
    setup = jl.make_setup(
        lidar, scene, jl.plan(lidar, scene, max_orders=5, window=(-60.0, 30.0), n_photons=20000)
    )
    assert setup.plan.config.order_steps == 6
    total = jax.jit(lambda key: jl.total_reflectance(jl.trace_scene(setup, key), setup))
    totals = [np.asarray(total(jax.random.fold_in(KEY, n))) for n in range(8)]
    np.testing.assert_allclose(wave.reflectance, np.mean(totals, axis=0), rtol=1e-4, atol=1e-7)
    assert wave.reflectance.shape == (3, setup.plan.n_samples)
    assert float(jnp.max(wave.components["higher"])) > 0


@pytest.mark.parametrize("steps", [1, 2, 4, 8, 16])
def test_size_buckets(steps):
    sizes = np.arange(1, 3000)
    buckets = np.array([size_bucket(int(n), steps) for n in sizes])
    assert np.all(buckets >= sizes)
    assert np.all(buckets <= np.maximum(np.ceil(sizes * (1 + 1.0 / steps)), 2))
    assert np.all(np.diff(buckets) >= 0)
    assert np.all([size_bucket(int(n), steps) == n for n in buckets])
    assert len(np.unique(buckets)) <= 12 * steps + 2


@pytest.mark.slow
def test_keys_can_be_mapped_over():
    """Under a transformation the sizes are those of the plan, also with a concrete scene."""
    scene = jl.Scene(plates=(jl.Plate(5.0, 0.3, 0.3),), ground=jl.Ground())
    plan = jl.plan(jl.Lidar(), scene, max_orders=2)
    keys = jax.random.split(KEY, 2)

    def wave(key):
        return jl.simulate(jl.Lidar(), scene, key=key, plan=plan, n_photons=800)

    waves = jax.eval_shape(jax.vmap(wave), keys)
    assert waves.reflectance.shape == (2, 1, plan.n_samples)
    assert waves.time.shape == (2, plan.n_samples)
