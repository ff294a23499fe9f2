"""Standard errors of every kind of estimate against the scatter of estimates from many random keys.

    python examples/validation/standard_errors.py [--out figures] [--keys 40]

An estimate v with the standard error s is drawn with many keys. With the mean m of all n of them,
z = (v - m) / s sqrt(n / (n - 1)) has the root mean square 1 if errors are what they say. Samples below 1 % of
the largest one of their waveform do not count, nor do errors below 1.2e-7 of it, which are those of rounding
in single precision. Fitted profiles have one simulated target each, with noise of
its own; their z is from the truth.

Where s itself varies much from key to key, z is large for those by which s is small. The table also has the
root mean square of the deviations over that of the errors. It is 0.84 for eight batches of normal
distribution, as their errors are widened by Student's t.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import scipy
import trimesh
from _validation import COLOURS, comparison, finish, options, with_progress
from jaxtyping import PRNGKeyArray as Key
from surveys import forest

import inversion
import jaxlidar as jl

# Admissible deviation of the root mean square of z from 1.
BOUND = 0.1
# Errors below this share of the typical one of an estimate count as that share.
LEAST_SHARE = 0.1
SIDE, SHOTS = 60, 200
LIDAR = jl.Lidar(altitude=1000.0, divergence=0.3, pulse=jl.GaussianPulse(fwhm=4.0))
WIDE = jl.Lidar(altitude=4e5, divergence=0.0625, pulse=jl.GaussianPulse(fwhm=8.0))

Estimates = tuple[np.ndarray, np.ndarray]


def samples_of(wave: jl.Waveform) -> Estimates:
    """Return the reflectance of all samples and its standard errors."""
    return np.asarray(wave.reflectance), np.asarray(wave.stderr)


def random_shots(zenith: float, **changes) -> jl.Survey:
    """Return narrow shots in random directions up to a zenith angle, at random places."""
    random = np.random.default_rng(1)
    position = random.uniform(12.0, SIDE - 12.0, (SHOTS, 2))
    angles = random.uniform(0.0, zenith, SHOTS), random.uniform(0.0, 360.0, SHOTS)
    return jl.Survey(replace(LIDAR, **changes), position, *angles)


def narrow_shots(zenith: float, voxel: float = 1.0, **changes) -> Callable:
    """Shots of 0.3 m at first order over a forest on terrain, to 1 %; `changes`: of the lidar."""
    scene = forest(SIDE)
    if voxel < 1.0:
        leaf, n = np.asarray(scene.canopy.voxels.leaf), round(1.0 / voxel)
        for axis in range(3):
            leaf = np.repeat(leaf, n, axis=axis)
        leaf = leaf * np.random.default_rng(0).uniform(0.0, 2.0, leaf.shape)
        voxels = jl.VoxelMap.from_extinction(leaf=leaf, voxel_size=voxel, origin=scene.canopy.voxels.origin)
        scene = replace(scene, canopy=replace(scene.canopy, voxels=voxels))
    survey = random_shots(zenith, **changes)
    return lambda key: samples_of(jl.simulate_many(survey, scene, key=key, max_orders=1, rtol=0.01))


def shared_footprints() -> Callable:
    """Footprints of 25 m with light that they share, all orders."""
    x = np.linspace(25.0, SIDE - 25.0, 4)
    survey = jl.Survey(WIDE, np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2), 0.0)
    scene = forest(SIDE)
    return lambda key: samples_of(jl.simulate_many(survey, scene, key=key, rtol=0.03, shared=True))


def crown(**changes) -> jl.Scene:
    """Return a crown with gaps over ground."""
    density = np.where(np.random.default_rng(2).random((12, 12, 8)) < 0.5, 0.8, 0.0)
    voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0, origin=(-6.0, -6.0, 2.0))
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.Prospect()), ground=jl.Ground(reflectance=0.3), **changes
    )


def meshes(orders: int) -> Callable:
    """A box beside a crown."""
    box = trimesh.creation.box(bounds=[(-0.5, -1.0, 0.0), (2.5, 2.0, 3.0)])
    scene, lidar = crown(meshes=(jl.MeshSurface(box, reflectance=0.5),)), replace(WIDE, divergence=0.02)
    return lambda key: samples_of(jl.simulate(lidar, scene, key=key, max_orders=orders))


def many_wavelengths() -> Callable:
    """A crown at 40 wavelengths, four orders."""
    scene, lidar = crown(), replace(WIDE, divergence=0.02, wavelength=np.linspace(450.0, 2400.0, 40))
    return lambda key: samples_of(jl.simulate(lidar, scene, key=key, max_orders=4))


def tail() -> Callable:
    """Light that arrives more than 20 m of path after the ground's echo of a dense, bright canopy."""
    voxels = jl.VoxelMap.from_lad(np.full((2, 2, 10), 1.5), voxel_size=(5.0, 5.0, 1.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.48, 0.47), sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.5))

    def estimate(key: Key) -> Estimates:
        wave = jl.simulate(WIDE, scene, key=key, rtol=0.05)
        late = np.asarray(wave.height) < -20.0
        return tuple(a[:, late] for a in samples_of(wave))

    return estimate


def energy_budget() -> Callable:
    """All fractions of the energy budget of a crown."""
    scene, lidar = crown(), replace(WIDE, divergence=0.02)

    def estimate(key: Key) -> Estimates:
        budget = jl.energy_budget(lidar, scene, key=key)
        values = {**budget.absorbed, "returned": budget.returned, "transmitted": budget.transmitted}
        return (
            np.concatenate([np.ravel(a) for a in values.values()]),
            np.concatenate([np.ravel(budget.stderr[name]) for name in values]),
        )

    return estimate


def budget_of_waveform() -> Callable:
    """The energy budget that comes with a waveform."""
    scene, lidar = crown(), replace(WIDE, divergence=0.02)

    def estimate(key: Key) -> Estimates:
        wave = jl.simulate(lidar, scene, key=key, max_orders=4)
        names = [n for n, s in wave.energy_budget_stderr.items() if float(np.max(np.asarray(s))) > 0]
        values, errors = wave.energy_budget, wave.energy_budget_stderr
        return tuple(np.concatenate([np.ravel(a[n]) for n in names]) for a in (values, errors))

    return estimate


def reflectance_factor() -> Callable:
    """The reflectance factor of a canopy with periodic sides, at 4 wavelengths, from the side."""
    scene = replace(crown(), canopy=replace(crown().canopy, sides="periodic"))
    wavelengths = [550.0, 670.0, 850.0, 1650.0]

    def estimate(key: Key) -> Estimates:
        options = {"sun": (30.0, 90.0), "view": (50.0, 200.0), "wavelengths": wavelengths}
        factor = jl.reflectance_factor(scene, **options, key=key, n_photons=20_000)
        return np.asarray(factor), np.asarray(factor.stderr)

    return estimate


def counted_photons() -> Callable:
    """Photons of a counter without dead time, by samples of 1 ns; their errors are those of Poisson."""
    lidar = replace(WIDE, divergence=0.02, energy=1e-4, wavelength=532.0)
    wave = jl.simulate(lidar, crown(), key=jax.random.key(0), max_orders=1)
    edges = np.arange(float(wave.time[0]), float(wave.time[-1]))
    counter = jl.PhotonCounter(dead_time=0.0)

    def estimate(key: Key) -> Estimates:
        counts = np.histogram(counter.count(wave, key=key, pulses=3000).time, edges)[0].astype(float)
        return counts, np.sqrt(np.maximum(counts, 1.0))

    return estimate


def fitted_profiles(keys: int) -> np.ndarray:
    """Return z of the leaf area density of six layers, and of the ground's height, from the truth."""
    density = np.array([0.1, 0.2, 0.3, 0.25, 0.15, 0.1])

    # Layers below zero for the lowest ground within the bounds.
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 8), 0.1), voxel_size=(40.0, 40.0, 3.0), origin=(-20.0, -20.0, -3.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4), sides="periodic")

    def scene_of(profile: np.ndarray, height: float) -> jl.Scene:
        scene = jl.Scene(canopy=canopy, ground=jl.Ground(height=height, reflectance=0.3))
        return inversion.put_profile(scene, jnp.asarray(profile))

    start = scene_of(np.full(6, 0.15), 0.3)
    target = jl.simulate(WIDE, scene_of(density, 0.0), key=jax.random.key(0), max_orders=1, n_rays=4096)
    clean = np.asarray(target.reflectance)
    noise = 0.02 * clean.max()
    observed = clean + noise * np.random.default_rng(4).normal(size=(keys, *clean.shape))
    # The ground first: layers are put above it.
    unknowns = [
        inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height"),
        inversion.Unknown(
            apply=inversion.put_profile, name="density", bounds=(0.0, 2.0), start=np.full(6, 0.15)
        ),
    ]
    problem = inversion.Problem(observed, WIDE, start, unknowns, noise=noise, time=target.time, max_orders=1)
    fits = inversion.retrieve_many(problem, key=jax.random.key(1))
    truth = {"density": density, "height": 0.0}
    return np.concatenate(
        [((fits.values[n] - v) / fits.stderr[n]).reshape(keys, -1) for n, v in truth.items()], axis=1
    )


CASES = {
    "narrow shots, nadir": lambda: narrow_shots(0.0),
    "narrow shots, nadir, top-hat": lambda: narrow_shots(0.0, profile="top-hat"),
    "shots of 1 m, nadir": lambda: narrow_shots(0.0, divergence=1.0),
    "narrow shots, zenith angles to 30 degrees": lambda: narrow_shots(30.0),
    "narrow shots, voxels of 0.25 m, to 30 degrees": lambda: narrow_shots(30.0, 0.25),
    "footprints that share light": shared_footprints,
    "meshes, first order": lambda: meshes(1),
    "meshes, three orders": lambda: meshes(3),
    "40 wavelengths, four orders": many_wavelengths,
    "tail of a bright canopy": tail,
    "energy budget": energy_budget,
    "energy budget of a waveform": budget_of_waveform,
    "reflectance factor": reflectance_factor,
    "photon counter": counted_photons,
}


def z_of(values: np.ndarray, stderr: np.ndarray) -> tuple[np.ndarray, float]:
    """Return z of all estimates that count, and the root mean square of deviations over that of errors.

    Axis 0 of the arrays is that of keys.
    """
    n, mean = len(values), values.mean(axis=0)
    typical = np.sqrt(np.mean(stderr**2, axis=0))
    largest = mean.max(axis=-1, keepdims=True)
    counts = (mean > 0.01 * largest) & (typical > np.finfo(np.float32).eps * largest)
    deviation = (values - mean)[:, counts] * np.sqrt(n / (n - 1))
    z = deviation / np.maximum(stderr[:, counts], LEAST_SHARE * typical[counts])
    return z, float(np.sqrt(np.sum(deviation**2) / np.sum(stderr[:, counts] ** 2)))


def main(argv: Sequence[str] | None = None) -> dict:
    arguments = options(__doc__, argv, keys=40)
    warnings.simplefilter("ignore", jl.OffMapWarning)
    rows, z_by_case, ratio_of_sums = [], {}, {}
    for name, make in with_progress(arguments, list(CASES.items())):
        estimate = make()
        draws = [estimate(key) for key in jax.random.split(jax.random.key(7), arguments.keys)]
        z_by_case[name], ratio_of_sums[name] = z_of(*(np.stack(a) for a in zip(*draws)))
    z_by_case["fitted profiles"] = fitted_profiles(arguments.keys)
    lines = []
    for name, z in z_by_case.items():
        rms, within = float(np.sqrt(np.mean(z**2))), float(np.mean(np.abs(z) < 2.0))
        rows.append(comparison("root mean square of z", "scatter", name, rms, 1.0, bound=BOUND))
        in_sum = f"{ratio_of_sums[name]:.2f}" if name in ratio_of_sums else ""
        lines.append([name, f"{z.size:,}", f"{rms:.2f}", f"{100 * within:.1f} %", in_sum])

    def draw(figure):
        ax = figure.subplots()
        grid = np.linspace(0.0, 3.0, 200)
        for i, (name, z) in enumerate(z_by_case.items()):
            style = {"color": COLOURS[i % len(COLOURS)], "linestyle": "--" if i >= len(COLOURS) else "-"}
            ax.plot(grid, [np.mean(np.abs(z) < x) for x in grid], label=name, linewidth=1.0, **style)
        ax.plot(
            grid, scipy.special.erf(grid / np.sqrt(2.0)), color="0.2", linewidth=2.5, zorder=0, label="normal"
        )
        ax.set(xlabel="|z|", ylabel="share below", xlim=(0.0, 3.0), ylim=(0.0, 1.0))
        ax.legend(fontsize="small")

    return finish(
        arguments,
        "standard_errors",
        rows,
        title="Standard errors against the scatter of estimates",
        caption="""Share of estimates within a number of standard errors, by kind, beside that of the normal
        distribution. Shots straight down are spread over the columns of voxels that they graze: else, by some
        keys no ray would meet a column, and the error stated would be near zero.""",
        unchecked="""An error that all keys share, as one of a wrong model, is not seen by their scatter; the
        other comparisons look for it. Rays of top-hats straight down are not spread over columns: by some
        keys no ray meets one that is grazed. Errors below a thousandth of the largest sample may be stated
        far too small, where two columns return the same and rays that cross from one to the other do not:
        shots of 1 m have many such samples.""",
        draw=draw,
        tables=[
            {
                "text": f"Scatter over stated errors, from {arguments.keys} keys.",
                "headings": [
                    "estimate",
                    "values",
                    "root mean square of z",
                    "within two",
                    "deviations over errors",
                ],
                "lines": lines,
            }
        ],
        keys=arguments.keys,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
