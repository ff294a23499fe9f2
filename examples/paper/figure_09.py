"""Figure 9: a tree's waveform at several sampling frequencies, with a fixed window and the paper's.

The paper opens its sampling bins when the first energy returns. How the ground's echo falls into them then
depends on its distance from the top of the tree, the same for every pulse, and its peak may come out too
high: an artefact. Where the digitiser samples at instants of its own, the mean over its phases has none of
it. Here the ground is moved by less than a sample to show both, under a footprint wide enough to see it.

    python examples/paper/figure_09.py [--out figures] [--small]
"""

import dataclasses
import itertools

import jax
import numpy as np
from _common import COLOURS, new_figure, options, save, table, tree_scene

import jaxlidar as jl

FREQUENCIES = (10.0, 1.0, 0.5, 0.2)  # GHz
FINE = 0.1


def at_phases(power: np.ndarray, interval: float) -> list[np.ndarray]:
    """Reflectance per ns in samples of `interval` ns, for every phase of the digitiser's clock."""
    per = round(interval / FINE)
    shifted = [np.pad(power, (phase, -(power.size + phase) % per)) for phase in range(per)]
    return [s.reshape(-1, per).sum(axis=1) / interval for s in shifted]


def main(argv=None) -> dict[str, float]:
    given = options(__doc__, argv)
    lidar = jl.Lidar(divergence=6.0, sampling_interval=FINE, pulse=jl.GaussianPulse(fwhm=2.0))
    scene = tree_scene(1.0 if given.small else 0.25)
    plan = jl.plan(lidar, scene, max_orders=1 if given.small else 6, window=(-115.0, 25.0))

    def simulated(height: float) -> tuple[np.ndarray, np.ndarray]:
        here = dataclasses.replace(scene, ground=dataclasses.replace(scene.ground, height=height))
        wave = jl.simulate(lidar, here, key=jax.random.key(0), plan=plan, n_photons=8 * 2048)
        return np.asarray(wave.time, float), np.asarray(wave.reflectance, float)[0]

    # Over the 0.75 m that the coarsest sample takes in.
    heights = -np.linspace(0, 0.75, 4 if given.small else 11)[:-1]
    waves = [simulated(h) for h in heights]
    found, rows, chosen = {}, [], 0
    for frequency in FREQUENCIES:
        interval = 1 / frequency
        fixed, opened = [], []
        for time, power in waves:
            # The digitiser's mean over phases of its clock, of the highest sample of the ground's echo.
            late = np.where(time > -12.0, power, 0.0)
            fixed.append(np.mean([p.max() for p in at_phases(late, interval)]))
            # What the detector does not tell from nothing is no first return.
            at, echo = jl.first_return_window(time, power, interval, 1e-3 * power.max())
            opened.append(np.asarray(echo)[np.asarray(at) > -12.0].max() / interval)
        ratio = np.array(opened) / np.array(fixed)
        rows.append((frequency, np.mean(fixed), np.ptp(fixed) / np.mean(fixed), ratio.min(), ratio.max()))
        found |= {
            f"fixed {frequency:g} GHz": float(np.mean(fixed)),
            f"raised {frequency:g} GHz": float(ratio.max()),
        }
        chosen = int(np.argmax(ratio))
    table(("GHz", "ground's peak, fixed", "spread", "opened / fixed, least", "most"), rows)
    # More samples keep more of the detail.
    peaks = [found[f"fixed {f:g} GHz"] for f in FREQUENCIES]
    assert all(a > b for a, b in itertools.pairwise(peaks))
    # Where the ground is, the fixed window does not care; the paper's does, the more the coarser the samples.
    assert rows[-1][2] < 0.05
    assert found["raised 0.2 GHz"] > 1.1
    assert found["raised 10 GHz"] < 1.02

    time, power = waves[chosen]
    figure, axes = new_figure(2, height=2.8, width=5.0, sharey=True)
    for frequency, colour in zip(FREQUENCIES, COLOURS):
        interval = 1 / frequency
        phases = at_phases(power, interval)
        # The phase of which the ground's peak is nearest to the mean.
        tops = np.array([p[p.size // 2 :].max() for p in phases])
        phase = int(np.argmin(np.abs(tops - tops.mean())))
        at = time[0] - 0.5 * FINE - FINE * phase + interval * (np.arange(phases[phase].size) + 0.5)
        axes[0].step(at, phases[phase], where="mid", color=colour, label=f"{frequency:g} GHz")
        at, echo = jl.first_return_window(time, power, interval, 1e-3 * power.max())
        axes[1].step(at, np.asarray(echo) / interval, where="mid", color=colour)
    for ax, title in zip(axes, ("fixed window", "opened at the first return")):
        ax.set(xlabel="time (ns)", title=title, ylim=(0, None), xlim=(-105, 15))
    axes[0].set_ylabel("apparent reflectance per ns")
    axes[0].legend()
    save(figure, given.out / "paper_figure_09.png")
    return found


if __name__ == "__main__":
    main()
