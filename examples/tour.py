"""Simulate, differentiate, fit, fly a survey, draw and save: each once. Run it as `python examples/tour.py`.

A crown stands over a slope. pyright checks this script, as `.ci/run` runs it.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

import inversion
import jaxlidar as jl

LIDAR = jl.Lidar(wavelength=(532.0, 1064.0), pulse=jl.GaussianPulse(fwhm=6.0), divergence=0.3, zenith=5.0)
KEY = jax.random.key(0)


def scene_of(lad: np.ndarray | Array, Cab: float = 40.0, height: float = 0.0) -> jl.Scene:
    """Return a crown of a leaf area density, m2/m3, over sloping ground at a height, m."""
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=(1.0, 1.0, 1.0), origin=(-2.0, -2.0, 2.0))
    canopy = jl.Canopy(voxels, leaf=jl.Prospect(N=1.6, Cab=Cab, Cw=0.012))
    ground = jl.Ground(height=height, reflectance=jl.spectrum("soil-medium"), slope=4, law=jl.Lambertian())
    plate = jl.Plate(height=1.0, reflectance=[0.1, 0.4], transmittance=0.05, coverage=0.2)
    return jl.Scene(canopy=canopy, plates=[plate], ground=ground, atmosphere=jl.Atmosphere(visibility=23.0))


def gradient(scene_lad: np.ndarray, observed: jl.Waveform) -> Array:
    """Return the derivative of the squared misfit by the leaf area density of every voxel."""
    plan = jl.plan(LIDAR, scene_of(scene_lad), max_orders=1, n_rays=256)

    def misfit(lad: Array) -> Array:
        simulated = jl.simulate(LIDAR, scene_of(lad), key=KEY, plan=plan)
        return jnp.sum((simulated.reflectance - observed.reflectance) ** 2)

    return jax.grad(misfit)(jnp.asarray(scene_lad))


def main(folder: Path) -> None:
    """Write the results of the tour to a folder, which is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    lad = np.full((4, 4, 4), 0.5)
    scene = scene_of(lad)
    print(jl.plan(LIDAR, scene, rtol=0.1, max_orders=1))
    wave = jl.simulate(LIDAR, scene, key=KEY, rtol=0.1, max_orders=1)
    leaf: float = wave.components["leaf"].sum().item()
    ground = float(wave.components["ground"].sum())
    print(f"{wave.time.size} samples; leaves return {leaf:.3f}, the ground {ground:.3f}")
    print(f"largest derivative: {float(jnp.abs(gradient(0.9 * lad, wave)).max()):.2g}")

    unknowns = [
        inversion.Unknown(lambda s: s.canopy.leaf.Cab, bounds=(5.0, 100.0), name="Cab"),
        inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="ground height", prior=(0.0, 1.0)),
    ]
    start = scene_of(lad, Cab=30.0, height=0.3)
    problem = inversion.Problem(wave, LIDAR, start, unknowns, noise=1e-3, max_orders=1)
    fit = inversion.retrieve(problem, key=KEY)
    values: dict[str, float] = {name: float(value) for name, value in fit.values.items()}
    print(values, fit.stderr["Cab"], fit.status)

    survey = jl.Survey(LIDAR, position=np.array([(0.0, 0.0), (1.0, 1.0)]), zenith=[0.0, 5.0])
    many = jl.simulate_many(survey, scene, key=KEY, rtol=0.2, max_orders=1)
    first: jl.Waveform = many[0]
    print(len(many), many.reflectance.shape, first.height[:2])

    axes = Figure().subplots(1, 2)
    jl.plot.waveform(wave, axes[0])
    jl.plot.waveform(fit.waveform, axes[1])
    axes[0].get_figure().savefig(folder / "tour.png")
    for result, name in ((wave, "wave.nc"), (many, "many.zarr"), (fit, "fit.nc")):
        result.save(folder / name)
    print(jl.open(folder / "fit.nc"))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
