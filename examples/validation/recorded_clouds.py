"""Airborne point clouds: simulations over their canopies, and sums of points, beside the GEDI simulator.

    python examples/validation/recorded_clouds.py NPZ LAZ... [--out figures]

NPZ has waveforms that the GEDI simulator (Hancock et al. 2019) made of the clouds LAZ, by the name of each:
`x, y`, heights of the upper end of the first sample and the lower end of the last one, `count`, and
`ground_count` where ground is classified. Each cloud becomes a canopy and a terrain
(`jaxlidar.canopy_from_points`), over which the same footprints are simulated, with leaves as bright as the
ground. Beside them stands the plain sum of points: every return has the weight of a Gaussian footprint over
the density of last returns, without any scene.
"""

import sys

import jax
import numpy as np
from _validation import COLOURS, comparison, finish, options, with_progress

import jaxlidar as jl
from jaxlidar.io import read_las

# Standard deviations of footprint and pulse, m, and the edge of the cells in which last returns are counted.
FOOTPRINT, PULSE, CELL = 5.5, 0.95485, 1.5
# How far from its centre the simulator follows such a footprint, m. Its cells begin one edge within that.
REACH = 17.4
ALTITUDE = 4e5
# Reflectance and transmittance of leaves: 2/3 of 0.45 is the reflectance of the ground, 0.3.
LEAF = (0.45, 0.45)
HEIGHTS = {"RH50": 0.5, "RH75": 0.75, "RH98": 0.98}
# Bounds on medians over the footprints of a cloud: m, one less the correlation, and cover.
MAX_HEIGHT, MAX_DECORRELATION, MAX_COVER = 0.3, 0.01, 0.03


def lidar():
    """Return a lidar with the simulator's footprint and pulse."""
    fwhm = PULSE * np.sqrt(8.0 * np.log(2.0)) / (0.5 * jl.SPEED_OF_LIGHT)
    pulse = jl.GaussianPulse(fwhm=fwhm)
    return jl.Lidar(altitude=ALTITUDE, divergence=4e3 * FOOTPRINT / ALTITUDE, pulse=pulse)


def middles_of_samples(reference):
    """Return heights of the middles of samples, (footprints, samples); the simulator names their tops."""
    samples = reference["count"].shape[1]
    first, last = (reference[end].astype(float)[:, None] for end in ("z_first", "z_last"))
    return first + (last - first) * (np.arange(samples) + 0.5) / samples


def sums_of_points(points, place, height, moved=0.0):
    """Return the sum of points under each footprint, (footprints, samples), and its fraction of plants.

    `moved`: how far the cells in which last returns are counted are from those of the simulator, m.
    """
    position, is_last = points.position, points.return_number == points.number_of_returns
    waveforms, cover = [], []
    for centre, z in zip(place, height):
        offset = position[:, :2] - centre
        near = np.flatnonzero(np.hypot(*offset.T) < REACH)
        cell = np.floor((offset[near] + REACH - CELL - moved) / CELL).astype(int) + 2
        index = cell[:, 0] * 40 + cell[:, 1]
        last_returns = np.bincount(index, is_last[near], 1600)[index]
        weight = np.exp(-0.5 * np.sum(offset[near] ** 2, axis=1) / FOOTPRINT**2)
        weight = np.where(last_returns > 0, weight / np.maximum(last_returns, 1.0), 0.0)
        rows = np.exp(-0.5 * ((z[:, None] - position[near, 2]) / PULSE) ** 2)
        waveforms.append(rows @ weight)
        cover.append(weight[points.classification[near] != 2].sum() / weight.sum())
    return np.array(waveforms), np.array(cover)


def simulations(points, place, height, key):
    """Return the simulated waveforms at the samples' heights, and the fraction that plants return."""
    cloud = jl.canopy_from_points(points)
    canopy = jl.Canopy(cloud.voxels, leaf=jl.LeafOptics(*LEAF))
    scene = jl.Scene(canopy=canopy, ground=cloud.terrain)
    many = jl.simulate_many(jl.Survey(lidar(), place), scene, key=key, max_orders=1, rtol=0.01)
    sample_height = -0.5 * jl.SPEED_OF_LIGHT * many.time
    power = many.reflectance[:, 0]
    # Heights of samples decrease, and np.interp wants them to increase.
    waveforms = [np.interp(z, sample_height[::-1], w[::-1], 0.0, 0.0) for z, w in zip(height, power)]
    return np.array(waveforms), many.components["leaf"][:, 0].sum(axis=1) / power.sum(axis=1)


def energy_heights(height, power):
    """Return the heights below which HEIGHTS' fractions of the energy lie, (footprints, heights)."""
    fractions = []
    for z, w in zip(height, power):
        order = np.argsort(z)
        cumulative = np.cumsum(np.maximum(w[order], 0.0))
        fractions.append(np.interp(list(HEIGHTS.values()), cumulative / cumulative[-1], z[order]))
    return np.array(fractions)


def correlations(first, second):
    """Return the correlation of each waveform with its counterpart."""
    return np.array([np.corrcoef(a, b)[0, 1] for a, b in zip(first, second)])


def compared(name, method, waveforms, cover, reference, height):
    """Return the rows of one cloud and method: medians over its footprints."""
    truth = reference["count"]
    case, against = f"{name}, {len(truth)} footprints", "GEDI simulator"
    rows = [
        comparison(
            f"correlation of waveforms, {method}",
            against,
            case,
            float(np.median(correlations(waveforms, truth))),
            1.0,
            bound=MAX_DECORRELATION,
        )
    ]
    difference = np.median(energy_heights(height, waveforms) - energy_heights(height, truth), axis=0)
    for label, value in zip(HEIGHTS, difference):
        rows.append(comparison(f"{label}, {method}", against, case, value, 0.0, bound=MAX_HEIGHT, unit="m"))
    if "ground_count" in reference:
        expected = 1.0 - reference["ground_count"].sum(axis=1) / truth.sum(axis=1)
        value = float(np.median(cover - expected) + np.median(expected))
        what = f"fraction of plants, {method}"
        rows.append(comparison(what, against, case, value, float(np.median(expected)), bound=MAX_COVER))
    return rows


def main(argv=None):
    arguments = options(__doc__, argv, "npz", "laz...")
    stored = np.load(arguments.npz)
    rows, examples = [], []
    for number, path in enumerate(with_progress(arguments, arguments.laz)):
        name, points = path.stem, read_las(path)
        prefix = f"{name}/"
        reference = {k.removeprefix(prefix): stored[k] for k in stored.files if k.startswith(prefix)}
        place = np.column_stack([reference["x"], reference["y"]])
        height = middles_of_samples(reference)
        results = {
            "simulated": simulations(points, place, height, jax.random.key(number)),
            "sum of points": sums_of_points(points, place, height),
        }
        for method, (waveforms, cover) in results.items():
            rows += compared(name, method, waveforms, cover, reference, height)
        # The footprint of median correlation.
        order = np.argsort(correlations(results["simulated"][0], reference["count"]))
        shot = order[len(order) // 2]
        shown = {"GEDI simulator": reference["count"][shot]}
        shown |= {method: waveforms[shot] for method, (waveforms, _) in results.items()}
        examples.append((name, height[shot], shown))

    def draw(figure):
        for axes, (name, z, shown) in zip(np.atleast_1d(figure.subplots(1, len(examples))), examples):
            for colour, (label, power) in zip(("0.6", COLOURS[0], COLOURS[1]), shown.items()):
                style = {"lw": 3.0} if label == "GEDI simulator" else {"lw": 1.0}
                axes.plot(power / power.sum(), z, color=colour, label=label, **style)
            lit = z[shown["GEDI simulator"] > 1e-3 * shown["GEDI simulator"].max()]
            axes.set(title=name, xlabel="fraction of energy", ylim=(lit.min() - 2.0, lit.max() + 2.0))
        figure.axes[0].set(ylabel="height (m)")
        figure.axes[0].legend(fontsize=7)

    return finish(
        arguments,
        "recorded_clouds",
        rows,
        title="Airborne clouds beside the GEDI simulator",
        caption="""Of each cloud the footprint of median correlation. Sums of points are the simulator's own
        method; canopies from points do the same through a scene, so that other orders, pulses, angles and
        optics can be simulated over it.""",
        unchecked="""The simulator counts each return once, whatever its energy. Whether plant area is right
        is another question, as no plant area was measured.""",
        draw=draw,
        of_others=True,
        size=(12.0, 4.0),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
