"""The comparisons that the paper's introduction names, each as one panel.

Sloped and flat ground; the tree with leaves and without; laser wavelength; shape and length of the pulse;
pointing angle; atmosphere; size of the footprint; and single shots with their expectation.

    python examples/paper/introduction.py [--out figures] [--small]
"""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
from _common import COLOURS, new_figure, options, save, table, tree_scene

import jaxlidar as jl

WINDOW = (-125.0, 45.0)
TREE = "tree, 1064 nm, nadir"


class CaseRunner:
    """Simulates each case once, and stores the waveforms and the rows of the table."""

    def __init__(self, small: bool):
        self.small = small
        self.rows: list[tuple] = []
        self.waves: dict[str, jl.Waveform] = {}

    def ground(self, name: str) -> float:
        """Return the apparent reflectance of the ground."""
        return float(np.asarray(self.waves[name].components["ground"][0]).sum())

    def total(self, name: str) -> float:
        """Return the apparent reflectance."""
        return float(np.asarray(self.waves[name].reflectance[0]).sum())

    def __call__(self, name: str, lidar: jl.Lidar, scene: jl.Scene) -> jl.Waveform:
        if name in self.waves:
            return self.waves[name]
        wave = jl.simulate(
            lidar,
            scene,
            key=jax.random.key(0),
            max_orders=1 if self.small else 6,
            n_photons=8 * 4096,
            n_rays=512 if self.small else 4096,
            window=WINDOW,
            bin_width=0.5,
        )
        self.waves[name] = wave
        peak = float(np.max(wave.reflectance))
        self.rows.append((name, self.total(name), self.ground(name), peak))
        return wave


def lidar_of(wavelength: float = 1064.0, **changes) -> jl.Lidar:
    """Return a lidar with a footprint of 6 m, which holds crown, trunk and ground."""
    return jl.Lidar(**({"wavelength": wavelength, "divergence": 6.0, "field_of_view": 12.0} | changes))


def slopes(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    for slope, colour in zip((0.0, 15.0, 30.0), COLOURS):
        ground = jl.Ground(reflectance=jl.spectrum("soil-medium"), slope=slope)
        wave = run(f"slope {slope:g} deg", lidar_of(), jl.Scene(ground=ground))
        ax.plot(1e3 * wave.reflectance[0], wave.height, color=colour, label=f"{slope:g}°")
    ax.set(title="slope of bare ground", ylim=(-6, 6))


def leaves(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    for on, colour in ((True, COLOURS[2]), (False, COLOURS[4])):
        name = "leaf-on" if on else "leaf-off"
        wave = run(TREE if on else name, lidar_of(), tree(leaves=on))
        ax.plot(1e3 * wave.reflectance[0], wave.height, color=colour, label=name)
    # Without leaves more light reaches the ground.
    assert run.ground("leaf-off") > 1.1 * run.ground(TREE)
    ax.set(title="leaf-on, leaf-off")


def wavelengths(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    for wavelength, colour in zip((532.0, 1064.0, 1550.0), COLOURS):
        wave = run(TREE if wavelength == 1064 else f"{wavelength:g} nm", lidar_of(wavelength), tree())
        ax.plot(1e3 * wave.reflectance[0], wave.height, color=colour, label=f"{wavelength:g} nm")
    assert run.total("532 nm") < run.total(TREE)
    ax.set(title="wavelength")


def pulses(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    shapes = {
        "Gaussian, 2 ns": jl.GaussianPulse(fwhm=2.0),
        "Gaussian, 12 ns": jl.GaussianPulse(fwhm=12.0),
        "rectangular, 6 ns": jl.RectangularPulse(length=6.0),
    }
    for (name, pulse), colour in zip(shapes.items(), COLOURS):
        wave = run(name, lidar_of(pulse=pulse), tree())
        ax.plot(1e3 * wave.reflectance[0], wave.height, color=colour, label=name)
    total = [run.total(name) for name in shapes]
    # The pulse spreads the light in time and does not change its sum.
    assert np.ptp(total) < 0.03 * np.mean(total)
    ax.set(title="pulse shape and length")


def angles(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    for zenith, colour in zip((0.0, 15.0, 30.0), COLOURS):
        # Aimed so that the beam's axis meets the middle of the crown.
        east = 8.0 * np.tan(np.radians(zenith))
        lidar = lidar_of(zenith=zenith, azimuth=90.0, position=(east, 0.0))
        wave = run(f"zenith {zenith:g} deg" if zenith else TREE, lidar, tree())
        ax.plot(1e3 * wave.reflectance[0], wave.height, color=colour, label=f"{zenith:g}°")
    ax.set(title="pointing angle from nadir")


def atmospheres(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    airs = {"none": None} | {f"{v:g} km": jl.Atmosphere(visibility=v) for v in (23.0, 5.0)}
    for (name, air), colour in zip(airs.items(), COLOURS):
        wave = run("532 nm" if air is None else f"visibility {name}", lidar_of(532.0), tree(atmosphere=air))
        ax.plot(1e3 * wave.reflectance[0], wave.height, color=colour, label=name)
    assert run.total("532 nm") > run.total("visibility 23 km") > run.total("visibility 5 km")
    ax.set(title="visibility, at 532 nm")


def footprints(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    for divergence, colour in zip((0.3, 6.0, 20.0), COLOURS):
        lidar = lidar_of(divergence=divergence, field_of_view=30.0, position=(1.0, 0.5))
        wave = run(f"footprint {divergence:g} m", lidar, tree())
        ax.plot(1e3 * wave.reflectance[0], wave.height, color=colour, label=f"{divergence:g} m")
    # A footprint wider than the crown sees more of the ground.
    assert run.ground("footprint 20 m") > run.ground("footprint 6 m")
    ax.set(title="footprint")


def shots(run: CaseRunner, ax, tree: Callable[..., jl.Scene]) -> None:
    lidar = lidar_of(energy=2e-6)
    wave = run("energy 2 uJ", lidar, tree())
    full = float(np.max(wave.energy))
    receiver = jl.Receiver(
        background=0.02 * full, electronic_noise=0.02 * full, saturation=1.5 * full, bits=8
    )
    expected = np.asarray(jl.record(wave.energy, lidar.wavelength, receiver)[0])
    keys = jax.random.split(jax.random.key(1), 200)
    recorded = np.stack(
        [np.asarray(jl.record(wave.energy, lidar.wavelength, receiver, key=k)[0]) for k in keys]
    )
    error = recorded.std(axis=0, ddof=1) / np.sqrt(len(keys))
    step = 1.5 * full / 255
    # Shots scatter about their expectation, apart from the step of the digitiser and samples cut off at zero.
    bright = expected > 0.1 * full
    assert np.all(np.abs(recorded.mean(axis=0) - expected)[bright] < 4.5 * error[bright] + 0.6 * step)
    for shot, colour in zip(recorded, ("0.75", "0.45")):
        ax.plot(1e18 * shot, wave.height, color=colour, linewidth=0.7, label="one shot")
    ax.plot(1e18 * expected, wave.height, color=COLOURS[1], linewidth=0.9, label="expected")
    ax.set(title="shots of 2 µJ, 8 bits", xlabel="energy per ns (aJ)")


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    run = CaseRunner(arguments.small)
    voxel = 1.0 if arguments.small else 0.25
    scenes: dict[tuple, jl.Scene] = {}

    def tree(*, leaves: bool = True, atmosphere: jl.Atmosphere | None = None) -> jl.Scene:
        if leaves not in scenes:
            scenes[leaves] = tree_scene(voxel, leaves=leaves)
        return dataclasses.replace(scenes[leaves], atmosphere=atmosphere)

    panels = (slopes, leaves, wavelengths, pulses, angles, atmospheres, footprints, shots)
    figure, axes = new_figure(4, 2, height=5.2, width=7.2)
    for panel, ax in zip(panels, axes.flat):
        ax.set(xlabel="app. reflectance per ns (10⁻³)", ylim=(-5, 17))
        panel(run, ax, tree)
        ax.set_xlim(left=0.0)
        ax.locator_params(axis="x", nbins=4)
        # Place the legend between crown and ground.
        place = 0.8 if panel is slopes else 0.42
        ax.legend(loc="center right", bbox_to_anchor=(1.0, place))
    for ax in axes[:, 0]:
        ax.set_ylabel("height (m)")
    table(("case", "sum", "of it ground", "peak"), run.rows)
    save(figure, arguments.out / "paper_introduction.png")
    return {name: run.total(name) for name in run.waves}


if __name__ == "__main__":
    main()
