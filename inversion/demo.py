"""The command `jaxlidar demo`: simulate a tree's waveform, add noise, and retrieve leaf, crown and ground.

The shape of the crown and the positions of its clumps are taken as known; `targets` lists the unknowns.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

import jaxlidar as jl
import jaxlidar.plot
from inversion.fit.problem import Problem
from inversion.fit.result import Retrieval
from inversion.fit.retrieval import retrieve
from inversion.fit.unknowns import Unknown, bind_unknowns, set_values
from jaxlidar.io import atomic_write
from jaxlidar.plants.demo import HEIGHT, LEAF_AREA, WAVELENGTHS, demo_lidar, demo_scene

# Standard deviation of the added noise: a fraction of each sample, and a floor relative to the peak.
NOISE_FRACTION, NOISE_FLOOR = 0.03, 0.01
# Recording window in ns: from 17 m above the ground to 9 m below, for multiple scattering in the crown.
WINDOW = (-115.0, 60.0)
# Photons and rays of each simulation of the retrieval.
FIT_PHOTONS, FIT_RAYS = 16384, 256
# Dots per inch of the figures.
RESOLUTION = 130


@dataclasses.dataclass(frozen=True)
class Target:
    """A quantity to retrieve, its unit and its true value."""

    unknown: Unknown
    unit: str
    truth: float


def _with_leaf_area(scene: jl.Scene, area: Array) -> jl.Scene:
    """Scale the leaves to a leaf area, m2."""
    factor = area / LEAF_AREA
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda leaf: leaf * factor)


def _with_height(scene: jl.Scene, height: Array) -> jl.Scene:
    """Stretch the tree upward from z = 0 to a height, m, with the same leaf and bark area."""
    stretch = height / HEIGHT
    fields = lambda s: [s.canopy.voxels.leaf, s.canopy.voxels.bark, s.canopy.voxels.voxel_size]  # noqa: E731
    # Extinction times height is constant.
    leaf, bark, size = fields(scene)
    return eqx.tree_at(fields, scene, [leaf / stretch, bark / stretch, size.at[2].multiply(stretch)])


def targets(scene: Any) -> list[Target]:
    """Return the unknowns of the demo in the scene `demo_scene()`, with starts that differ from the truth."""
    leaf, ground = scene.canopy.leaf, scene.ground
    return [
        Target(
            Unknown(lambda s: s.canopy.leaf.Cab, bounds=(5.0, 100.0), start=25.0, name="chlorophyll"),
            "ug/cm2",
            float(leaf.Cab),
        ),
        Target(
            Unknown(lambda s: s.canopy.leaf.Cw, bounds=(0.001, 0.05), start=0.025, name="leaf water"),
            "cm",
            float(leaf.Cw),
        ),
        Target(
            Unknown(lambda s: s.canopy.leaf.N, bounds=(1.0, 3.0), start=2.0, name="leaf structure N"),
            "",
            float(leaf.N),
        ),
        Target(
            Unknown(
                lambda s: s.ground.reflectance.scale, bounds=(0.2, 2.0), start=0.6, name="ground brightness"
            ),
            "of soil-medium",
            float(ground.reflectance.scale),
        ),
        Target(
            Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), start=0.5, name="ground height"),
            "m",
            float(ground.height),
        ),
        Target(
            Unknown(name="leaf area", bounds=(50.0, 800.0), start=160.0, apply=_with_leaf_area),
            "m2",
            LEAF_AREA,
        ),
        Target(Unknown(name="tree height", bounds=(12.0, 18.0), start=14.2, apply=_with_height), "m", HEIGHT),
    ]


def run(out: Path, *, seed: int, rtol: float, voxel_size: float, log: Callable[[str], None]) -> Retrieval:
    """Simulate, retrieve, write `waveform.png` and `retrieval.png` into `out`, and print the results.

    **Arguments:** those of the command; `log` is called with lines of progress.

    **Returns:** the `Retrieval`.

    **Raises:** KeyboardInterrupt if the simulation is interrupted.
    """
    key = jax.random.key(seed)
    lidar, scene = demo_lidar(WAVELENGTHS), demo_scene(voxel_size)
    log("simulating the tree (compiles first)")
    plan = jl.plan(lidar, scene, rtol=rtol, window=WINDOW)
    wave = jl.simulate(
        lidar, scene, key=jax.random.fold_in(key, 0), plan=plan, rtol=rtol, progress=lambda p: log(f"  {p}")
    )
    # An interrupted simulation returns what it has; the demo ends instead.
    if wave.info["stopped"] == "interrupted":
        raise KeyboardInterrupt
    path = out / "waveform.png"
    save(waveform_figure(wave, lidar, scene), path)
    _print_waveform(wave)
    print(f"\nfigure: {path}\n")
    noise = _noise(wave)
    observed = noisy(wave, noise, seed)
    sought = targets(scene)
    unknowns = [target.unknown for target in sought]
    # The waveform of the starting values, for the figure only: the fit simulates with fewer photons.
    bound = bind_unknowns(unknowns, scene)
    start_scene = set_values(scene, tuple(u.setter for u in bound), tuple(u.start for u in bound))
    start = jl.simulate(
        lidar, start_scene, key=jax.random.fold_in(key, 1), plan=plan, rtol=min(2 * rtol, 0.99)
    )
    log("retrieving (compiles first)")
    problem = Problem(observed, lidar, scene, unknowns, noise=noise, n_photons=FIT_PHOTONS, n_rays=FIT_RAYS)
    fit = retrieve(
        problem, key=jax.random.fold_in(key, 2), progress=lambda step: log(f"  {_first_clause(step)}")
    )
    path = out / "retrieval.png"
    save(retrieval_figure(observed, noise, start, fit), path)
    _print_retrieval(fit, sought)
    print(f"\nfigure: {path}")
    return fit


def _noise(wave: jl.Waveform) -> Float[np.ndarray, "wavelengths bins"]:
    """Return the standard deviation of a noisy waveform: added noise and the simulation's own error."""
    value = np.asarray(wave.reflectance)
    floor = NOISE_FLOOR * value.max(axis=1, keepdims=True)
    return np.sqrt((NOISE_FRACTION * value) ** 2 + floor**2 + np.asarray(wave.stderr) ** 2)


def noisy(wave: jl.Waveform, noise: Float[np.ndarray, "wavelengths bins"], seed: int) -> jl.Waveform:
    """Return the waveform with normal noise of the standard deviation `noise`."""
    value = np.asarray(wave.reflectance)
    random = np.random.default_rng(seed).normal(size=value.shape)
    # The waveform has its own simulation error already, which is part of `noise`.
    sigma = np.sqrt(np.maximum(noise**2 - np.asarray(wave.stderr) ** 2, 0.0))
    return dataclasses.replace(wave, reflectance=jax.numpy.asarray(value + sigma * random, value.dtype))


def waveform_figure(wave: jl.Waveform, lidar: jl.Lidar, scene: jl.Scene) -> Figure:
    """Draw the scene from the side, and its waveform at 1064 nm with components."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    scene_axes, wave_axes = figure.subplots(1, 2, sharey=True, width_ratios=(1, 1.9))
    jaxlidar.plot.scene(scene, lidar, scene_axes)
    jaxlidar.plot.waveform(wave, wave_axes, wavelength=1064.0)
    scene_axes.set_ylim(-4.0, HEIGHT + 1.0)
    # Both share the axis of heights.
    wave_axes.set_ylabel("")
    return figure


def retrieval_figure(
    observed: jl.Waveform, noise: Float[np.ndarray, "wavelengths bins"], start: jl.Waveform, fit: Retrieval
) -> Figure:
    """Draw data, start, fit and residuals of the fit, for each wavelength."""
    # A pair of axes for each wavelength: waveforms, and residuals.
    figure = Figure(figsize=(7.4, 4.6), layout="constrained")
    ratios = (1.5, 1.0) * len(WAVELENGTHS)
    axes = figure.subplots(1, 2 * len(WAVELENGTHS), sharey=True, width_ratios=ratios)
    draw = jaxlidar.plot.waveform
    for i, wavelength in enumerate(WAVELENGTHS):
        ax, residual_axes = axes[2 * i], axes[2 * i + 1]
        common: dict[str, Any] = {"wavelength": wavelength, "components": False, "sigma": 0.0}
        look: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 2.2, "color": "#56B4E9"}
        draw(observed, ax, label="data", **common, **look)
        draw(start, ax, label="start", color="#D55E00", linestyle=(0, (4, 2)), linewidth=1.0, **common)
        draw(fit.waveform, ax, label="fit", **common)
        jaxlidar.plot.residuals(
            fit.waveform, np.asarray(observed.reflectance), noise, residual_axes, wavelength=wavelength
        )
        # One legend for the figure, in place of one for each pair of axes.
        legend = ax.get_legend()
        if legend is not None:
            legend.remove()
        for a in (ax, residual_axes):
            a.set_ylim(-6.0, HEIGHT + 2.0)
            a.set_ylabel("height (m)" if a is axes[0] else "")
            a.set_xlabel("")
        ax.locator_params(axis="x", nbins=3)
        # The padding keeps the label clear of the axis's power of ten.
        ax.set_xlabel("apparent\nreflectance", labelpad=14)
        residual_axes.set_xlabel("residual\n(std. dev.)", labelpad=14)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG file atomically."""
    with atomic_write(path) as draft:
        figure.savefig(draft, format="png", dpi=RESOLUTION)


def _print_waveform(wave: jl.Waveform) -> None:
    print("apparent reflectance, summed over the waveform")
    component_names = ["leaf", "bark", "ground", "first", "higher"]
    headings = ["leaf", "bark", "ground", "first order", "higher orders", "total", "std. error"]
    print(f"{'':8}" + "".join(f"{heading:>14}" for heading in headings))
    for i, wavelength in enumerate(np.asarray(wave.wavelength)):
        sums = [float(np.sum(np.asarray(wave.components[name][i]))) for name in component_names]
        sums.append(float(np.sum(np.asarray(wave.reflectance[i]))))
        sums.append(float(np.sqrt(np.sum(np.asarray(wave.stderr[i]) ** 2))))
        print(f"{wavelength:5.0f} nm" + "".join(f"{x:14.4f}" for x in sums))


def _print_retrieval(fit: Retrieval, sought: Sequence[Target]) -> None:
    width = max(len(str(target.unknown.name)) for target in sought)
    print(f"{'retrieved':{width}}  {'true':>8}  {'start':>8}  {'estimate':>8}  {'std. error':>10}  unit")
    for target in sought:
        name = str(target.unknown.name)
        values = (target.truth, float(np.asarray(target.unknown.start)), float(fit.values[name]))
        row = "  ".join(f"{v:8.4g}" for v in values)
        print(f"{name:{width}}  {row}  {float(fit.stderr[name]):10.2g}  {target.unit}".rstrip())
    print(f"reduced chi-squared {float(fit.reduced_chi2):.2f}; {fit.status}")


def _first_clause(step: Any) -> str:
    """Return a step's number and chi-squared, without its values."""
    return str(step).split(";")[0]


class ProgressLog:
    """Lines of progress to a stream, or to nowhere without one."""

    def __init__(self, stream: Any):
        self.stream = stream

    def __call__(self, line: str) -> None:
        if self.stream is not None:
            print(line, file=self.stream, flush=True)
