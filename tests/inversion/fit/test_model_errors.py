"""Standard errors of the ground for a wrong model: robust ones cover the truth, plain ones do not."""

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from tests.helpers import ask

CASES, LAYERS = 200, 4
ANGLES = ("planophile", "erectophile")
TIME = np.arange(-120.0, 50.0)
LAG = np.arange(-30.0, 31.0)


def lidar(power):
    pulse = jl.SampledPulse(time=LAG, power=power)
    return jl.Lidar(altitude=4e5, divergence=0.0625, aperture=0.8, pulse=pulse, sampling_interval=1.0)


def scene(density, angles="spherical", slope=4.0):
    """Four layers of plants from 3 m to 15 m above sloping ground at 0 m."""
    voxels = jl.VoxelMap.from_lad(
        np.asarray(density, float).reshape(1, 1, LAYERS),
        voxel_size=(60.0, 60.0, 3.0),
        origin=(-30.0, -30.0, 3.0),
        leaf_angles=angles,
    )
    leaf = jl.LeafOptics(reflectance=0.45, transmittance=0.40)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=True),
        ground=jl.Ground(height=0.0, reflectance=0.2, slope=slope),
    )


def transmitted_pulse(random=None):
    """Return a Gaussian pulse; with a generator, one with errors of 5 %, correlated over 4 ns."""
    pulse = np.exp(-0.5 * (LAG / 6.0) ** 2)
    if random is None:
        return pulse
    kernel = np.exp(-0.5 * (np.arange(-20, 21) / 4.0) ** 2)
    smooth = np.convolve(random.normal(size=LAG.size + 40), kernel, "valid")
    # 2.66 is the standard deviation of the smoothed noise, the norm of the kernel.
    return pulse * np.maximum(1.0 + 0.05 * smooth / 2.66, 0.0)


@pytest.mark.slow
def test_robust_errors_cover_the_ground_of_a_wrong_model():
    """Two robust standard errors cover the ground in 92 to 98 % of 200 records, two plain ones in less.

    The records are simulated with another pulse, other leaf angles and another slope than the model's.
    """
    random = np.random.default_rng(0)
    options = {"max_orders": 1, "window": (TIME[0], TIME[-1]), "bin_width": 1.0}
    model = scene(np.full(LAYERS, 0.1))
    # Plans for pulses with finer features than the model's, steeper ground, and either kind of leaf angles.
    narrow, steep = lidar(np.exp(-0.5 * (LAG / 4.0) ** 2)), {"slope": 8.0}
    plans = {
        angles: jl.plan(
            narrow, scene(np.full(LAYERS, 0.2), angles, **steep), n_rays=64, footprint="fixed", **options
        )
        for angles in ("spherical", *ANGLES)
    }
    records = []
    for _ in range(CASES):
        angles = str(random.choice(ANGLES))
        truth = scene(random.uniform(0.02, 0.2, LAYERS), angles, random.uniform(1.0, 7.0))
        wave = jl.simulate(lidar(transmitted_pulse(random)), truth, key=jax.random.key(1), plan=plans[angles])
        record = np.asarray(wave.reflectance)
        records.append(record + 0.01 * record.max() * random.normal(size=record.shape))
    records = np.stack(records)
    fits = ask(
        inversion.retrieve_many,
        records,
        lidar(transmitted_pulse()),
        model,
        [
            inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="ground"),
            inversion.Unknown("ground.reflectance", bounds=(0.01, 0.9), name="brightness"),
            inversion.Unknown("canopy.voxels.leaf", bounds=(1e-3, 0.5), name="extinction"),
        ],
        noise=0.01 * records.max(axis=(1, 2), keepdims=True),
        time=TIME,
        key=jax.random.key(2),
        plan=plans["spherical"],
    )
    error = np.abs(fits.values["ground"])
    robust, plain = (np.mean(error <= 2.0 * s["ground"]) for s in (fits.robust_stderr, fits.stderr))
    assert np.mean(fits.converged) > 0.95
    assert 0.92 <= robust <= 0.98, f"fraction within 2 standard errors {robust:.3f}, plain ones {plain:.3f}"
    assert plain < 0.92
