"""Footprints over airborne clouds, from files to metrics, beside those of the GEDI simulator.

    python examples/validation/recorded_footprints.py NPZ LAZ... [--out figures]

NPZ has waveforms and metrics that the GEDI simulator (Hancock et al. 2019) made of the clouds LAZ, by the
name of each, as `recorded_clouds.py` describes, and `true_ground`, `rh_real`, `rh_gauss` and `als_cover`.
Metrics that it does not have are those that `inversion.metrics.gedi_simulator` makes of its waveforms.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from _validation import COLOURS, comparison, finish, number, options, with_progress
from recorded_clouds import ALTITUDE, FOOTPRINT, PULSE, lidar, middles_of_samples

import jaxlidar as jl
from inversion.footprints import simulate_footprints
from inversion.metrics.gedi_simulator import simulator_table
from jaxlidar.io import GediShot, read_gedi_l1b

# Percentiles of relative heights, by metric; metrics that are one number, with their unit.
PERCENTS = (25, 50, 75, 90, 95, 98)
HEIGHTS = ("rhReal", "rhMax", "rhInfl", "rhGauss")
NUMBERS = {"ALS cover": "1", "maxHalfCov": "1", "cover": "1", "FHD": "1", "signal top": "m"}
STORED = {"rhReal": "rh_real", "rhGauss": "rh_gauss", "ALS cover": "als_cover"}
# Bounds on the medians of differences, m and 1, and on one less the correlation.
MAX_HEIGHT, MAX_NUMBER, MAX_DECORRELATION = 0.3, 0.05, 0.01


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


def metrics_of(table, expected, stored):
    """Return (ours, theirs) over the footprints whose ground both have, by metric, as "rhReal 50"."""
    has_ground = np.isfinite(table["true ground"]) & (stored["true_ground"] > -1e3)
    pairs = {}
    for name in (*HEIGHTS, *NUMBERS):
        theirs = stored[STORED[name]] if name in STORED else expected[name]
        for percent in PERCENTS if name in HEIGHTS else (None,):
            columns = [a if percent is None else a[:, percent] for a in (table[name], theirs)]
            rows = np.isfinite(columns[0]) & np.isfinite(columns[1]) & has_ground
            pairs[name if percent is None else f"{name} {percent}"] = [column[rows] for column in columns]
    return pairs


def main(argv=None):
    arguments = options(__doc__, argv, "npz", "laz...")
    rows, cells, examples = [], {}, []
    for path in with_progress(arguments, arguments.laz):
        height, stored = reference_of(arguments.npz, path.stem)
        records = stored["count"].astype(float)
        table, shots = footprints_of(path, stored)
        expected = simulator_table(
            [shot_of(z, record, i) for i, (z, record) in enumerate(zip(height, records))], FOOTPRINT
        )
        case, against = f"{path.stem}, {len(records)} footprints", "GEDI simulator"
        correlated = float(np.median(correlations(shots, height, records)))
        what = "correlation of waveforms"
        rows.append(comparison(what, against, case, correlated, 1.0, bound=MAX_DECORRELATION))
        cells.setdefault("waveforms", []).append(number(correlated, 3))
        pairs = metrics_of(table, expected, stored)
        for metric, (ours, theirs) in pairs.items():
            difference = float(np.median(ours - theirs))
            correlated = float(np.corrcoef(ours, theirs)[0, 1])
            name = metric.split(" ")[0] if metric.startswith("rh") else metric
            unit = NUMBERS.get(name, "m")
            bound = {"m": MAX_HEIGHT, "1": MAX_NUMBER}[unit]
            place = f"{metric}, {case}"
            rows += [
                comparison(f"median {name}", against, place, difference, 0.0, bound=bound, unit=unit),
                comparison(
                    f"correlation of {name}", against, place, correlated, 1.0, bound=MAX_DECORRELATION
                ),
            ]
            cells.setdefault(metric, []).append(f"{difference:.2f}, {correlated:.3f}")
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

    text = """Medians of the differences (m; of covers and `FHD` 1), and the correlation over the footprints.
    `rhReal`, `ALS cover` are without noise. In the gap between crowns and ground, where little energy is,
    percentiles are ill-defined; a fit of several Gaussians to a sloping ground has several minima."""
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
