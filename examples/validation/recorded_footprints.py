"""Footprints over airborne clouds, from files to metrics, beside those of the GEDI simulator.

    python examples/validation/recorded_footprints.py NPZ LAZ... [--out figures]

NPZ has waveforms and metrics that the GEDI simulator (Hancock et al. 2019) made of the clouds LAZ, by the
name of each, as `recorded_clouds.py` describes, and `true_ground`, `rh_real`, `rh_gauss` and `als_cover`.
Metrics that it does not have are those that `inversion.metrics.gedi_simulator` makes of its waveforms.

How well any simulation can agree is told by the simulator's own method, the sum of points: last returns are
counted in cells of 1.5 m, whose place is arbitrary, and metrics are compared with those of cells elsewhere.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from _validation import COLOURS, comparison, finish, number, options, with_progress
from recorded_clouds import ALTITUDE, CELL, FOOTPRINT, PULSE, lidar, middles_of_samples, sums_of_points

import jaxlidar as jl
from inversion.footprints import simulate_footprints
from inversion.metrics.gedi_simulator import energy_heights, simulator_table
from jaxlidar.io import GediShot, read_gedi_l1b, read_las

# Percentiles of relative heights, by metric; metrics that are one number, with their unit.
PERCENTS = (25, 50, 75, 90, 95, 98)
HEIGHTS = ("rhReal", "rhMax", "rhInfl", "rhGauss")
NUMBERS = {"ALS cover": "1", "maxHalfCov": "1", "cover": "1", "FHD": "1", "signal top": "m"}
# Reflectance of plants over that of ground, of covers in the simulator.
REFLECTANCE_RATIO = 0.57 / 0.4
STORED = {"rhReal": "rh_real", "rhGauss": "rh_gauss", "ALS cover": "als_cover"}
# Bounds on the medians of differences, m and 1, and on one less the correlation.
MAX_HEIGHT, MAX_NUMBER, MAX_DECORRELATION = 0.3, 0.05, 0.01
# Metrics by the true ground. Class of returns of water, which is ground here and plants in the simulator:
# footprints with more of it than this fraction are left out of these metrics, and of all metrics those of
# which less than a fraction is over returns.
OF_TRUE_GROUND = ("rhReal", "ALS cover")
WATER, MAX_WATER, LEAST_COVERED = 9, 0.01, 0.95


def reference_of(npz, name):
    """Return the heights of samples, and the stored values of a cloud by name."""
    stored = np.load(npz)
    values = {key.removeprefix(f"{name}/"): stored[key] for key in stored.files if key.startswith(f"{name}/")}
    return middles_of_samples(values), values


def shot_of(height, record, number):
    """Return a shot of a record without noise, with the reference's pulse."""
    lag = np.arange(-40.0, 41.0)
    power = np.exp(-0.5 * (0.5 * jl.SPEED_OF_LIGHT * lag / PULSE) ** 2)
    place = {"latitude": 0.0, "longitude": 0.0, "altitude": ALTITUDE, "zenith": 0.0, "azimuth": 0.0}
    received = {"waveform": record, "noise_mean": 0.0, "noise_std": 3.0}
    pulse = {"pulse_time": lag, "pulse_power": power}
    return GediShot("BEAM0101", number, np.arange(float(height.size)), height, **received, **pulse, **place)


def footprints_of(path, stored):
    """Return the table of the footprints over a cloud, and their shots in its order."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        places = "\n".join(f"{x},{y}" for x, y in zip(stored["x"], stored["y"]))
        (folder / "places.csv").write_text(f"x,y\n{places}\n")
        table = simulate_footprints(
            [path], folder / "places.csv", folder / "l1b.h5", folder / "tiles", lidar=lidar()
        )
        shots = {shot.shot_number: shot for shot in read_gedi_l1b(folder / "l1b.h5")}
    return table, [shots[i + 1] for i in range(len(table))]


def correlations(shots, height, records):
    """Return the correlation of each waveform with its counterpart."""
    return np.array(
        [
            np.corrcoef(np.interp(-z, -shot.elevation, shot.signal), record)[0, 1]
            for shot, z, record in zip(shots, height, records)
        ]
    )


def is_dry(points, place):
    """Return True for footprints without returns of water."""
    fractions = []
    for centre in place:
        distance = np.hypot(*(points.position[:, :2] - centre).T)
        weight = np.exp(-0.5 * (distance / FOOTPRINT) ** 2)
        fractions.append(weight[points.classification == WATER].sum() / weight.sum())
    return np.array(fractions) <= MAX_WATER


def metrics_of_records(height, records):
    """Return the metrics of records without noise, by the names of the simulator."""
    return simulator_table([shot_of(z, r, i) for i, (z, r) in enumerate(zip(height, records))], FOOTPRINT)


def metrics_of_sums(points, place, height, true_ground, moved):
    """Return the metrics of sums of points, with cells moved by that much; grounds are the true ones."""
    records, plants = sums_of_points(points, place, height, moved)
    table = metrics_of_records(height, records)
    levels = np.array([energy_heights(z, record) for z, record in zip(height, records)])
    cover = plants / (plants + REFLECTANCE_RATIO * (1.0 - plants))
    names = [name for name in (*HEIGHTS, *NUMBERS) if name in table.columns]
    return {name: table[name] for name in names} | {
        "rhReal": levels - true_ground[:, None],
        "ALS cover": cover,
    }


def pairs_of(first, second, selected, dry):
    """Return the values of two simulations over the selected footprints, by metric, as "rhReal 50"."""
    pairs = {}
    for name in (*HEIGHTS, *NUMBERS):
        for percent in PERCENTS if name in HEIGHTS else (None,):
            columns = [a[name] if percent is None else a[name][:, percent] for a in (first, second)]
            rows = np.isfinite(columns[0]) & np.isfinite(columns[1]) & selected
            rows &= dry | (name not in OF_TRUE_GROUND)
            pairs[name if percent is None else f"{name} {percent}"] = [column[rows] for column in columns]
    return pairs


def difference_and_correlation(pair):
    """Return the median of the differences of two columns, and their correlation."""
    return float(np.median(pair[0] - pair[1])), float(np.corrcoef(*pair)[0, 1])


def main(argv=None):
    arguments = options(__doc__, argv, "npz", "laz...")
    rows, cells, examples, lowest = [], {}, [], 1.0
    for path in with_progress(arguments, arguments.laz):
        height, stored = reference_of(arguments.npz, path.stem)
        records, points = stored["count"].astype(float), read_las(path)
        place = np.column_stack([stored["x"], stored["y"]])
        table, shots = footprints_of(path, stored)
        dry, selected = is_dry(points, place), table["covered"] >= LEAST_COVERED
        selected &= np.isfinite(table["true ground"]) & (stored["true_ground"] > -1e3)
        expected = metrics_of_records(height, records)
        theirs = {name: expected[name] for name in (*HEIGHTS, *NUMBERS) if name not in STORED}
        theirs |= {name: stored[key] for name, key in STORED.items()}
        fits = pairs_of(theirs | {"rhGauss": expected["rhGauss"]}, theirs, selected, dry)
        lowest = min(lowest, *(np.corrcoef(*fits[f"rhGauss {percent}"])[0, 1] for percent in PERCENTS))
        case, against = f"{path.stem}, {len(records)} footprints", "GEDI simulator"
        correlated = float(np.median(correlations(shots, height, records)[selected]))
        what = "correlation of waveforms"
        rows.append(comparison(what, against, case, correlated, 1.0, bound=MAX_DECORRELATION))
        ground = stored["true_ground"]
        cells_here, cells_moved = (
            metrics_of_sums(points, place, height, ground, moved) for moved in (0.0, 0.5 * CELL)
        )
        cells.setdefault("waveforms", []).append(number(correlated, 3))
        pairs, pairs_of_cells = (
            pairs_of(table, theirs, selected, dry),
            pairs_of(cells_moved, cells_here, selected, dry),
        )
        for metric, pair in pairs.items():
            difference, correlated = difference_and_correlation(pair)
            name = metric.split(" ")[0] if metric.startswith("rh") else metric
            unit = NUMBERS.get(name, "m")
            bound = {"m": MAX_HEIGHT, "1": MAX_NUMBER}[unit]
            place_of_row = f"{metric}, {case}"
            rows += [
                comparison(f"median {name}", against, place_of_row, difference, 0.0, bound=bound, unit=unit),
                comparison(
                    f"correlation of {name}", against, place_of_row, correlated, 1.0, bound=MAX_DECORRELATION
                ),
            ]
            moved = difference_and_correlation(pairs_of_cells[metric])
            text = f"{difference:.2f}, {correlated:.3f} ({moved[0]:.2f}, {moved[1]:.3f})"
            cells.setdefault(metric, []).append(text)
        examples.append((path.stem, pairs))

    def draw(figure):
        for axes, (name, pairs) in zip(np.atleast_1d(figure.subplots(1, len(examples))), examples):
            for colour, metric in zip(COLOURS, ("rhReal", "rhMax", "rhInfl", "rhGauss")):
                ours, theirs = pairs[f"{metric} 95"]
                axes.plot(theirs, ours, "o", ms=3, color=colour, label=f"{metric} 95")
            axes.axline((0.0, 0.0), slope=1.0, color="0.6", lw=0.8)
            axes.set(title=name, xlabel="GEDI simulator (m)", aspect="equal")
        figure.axes[0].set(ylabel="jaxlidar (m)")
        figure.axes[0].legend(fontsize=7)

    text = f"""Medians of the differences (m; of covers and `FHD` 1), and the correlation over the
    footprints; in brackets the same of the simulator's own method, sums of points, when the cells of 1.5
    m in which it counts last returns are moved by half a cell: beyond that, no other simulation can
    agree. On the same waveforms, `rhReal` and `ALS cover` are those of the simulator, as tests check.
    Where a difference is above 0.3 m or a correlation below 0.99, the reason is one of these. **Jumps:**
    in topography the ground slopes under plants, and the lowest maximum, inflection points and Gaussian
    are of one echo or another by small changes of a waveform; so are `rhMax`, `rhInfl`, `rhGauss`,
    `cover`, which is of the lowest Gaussian, and `maxHalfCov`. Gaussians fitted to the very waveforms of
    the simulator give correlations of `rhGauss` down to {lowest:.2f}, as sums of Gaussians have several
    minima. **Gap:** the lowest 25 % of mixedconifer end between crowns and ground, where there is little
    energy. **First returns:** that file has no others, so that weights by last returns depend on the
    cells; its 8 footprints differ little in cover. **Smoothing:** a column of the canopy takes some
    twenty returns: `rhReal 25` and `rhReal 50` of topography, with low plants on slopes, and `ALS cover`
    are less sharp. **Threshold:** `signal top` is where 0.001 of the energy per m is reached, which
    distant trees do in one footprint of megaplot; the simulator ends footprints at 17.4 m. **Water** is
    ground here, and plants in the simulator: footprints with it have no part in `rhReal` and `ALS cover`,
    and those of which less than 95 % is over returns none in any."""
    lines = [[metric, *values] for metric, values in cells.items()]
    return finish(
        arguments,
        "recorded_footprints",
        rows,
        title="Footprints over airborne clouds beside the GEDI simulator",
        caption="""The 95th relative height of each footprint, by the four grounds of the GEDI simulator: the
        true one, the lowest maximum, the lowest inflection points, and the lowest Gaussian.""",
        unchecked="""Records are without noise here: noise by link margin has tests of its own. Bounds are
        what was aimed at; the table says where they do not hold.""",
        draw=draw,
        tables=[{"text": text, "headings": ["", *(name for name, _ in examples)], "lines": lines}],
        of_others=True,
        size=(12.0, 4.5),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
