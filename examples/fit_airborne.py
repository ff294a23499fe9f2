"""Fit recorded returns of an airborne lidar, each with its own pulse.

    python examples/fit_airborne.py FILE [--shots 9] [--every 10] [--out figures]

FILE is what NEON publishes (.npz, `jaxlidar.io.read_neon`), PulseWaves (.pls, as RIEGL and LVIS data are
published in) or LAS with wave packets (.las). LAS has no outgoing pulses: give one as a table (`--pulse`), as
a Gaussian (`--pulse-width`), or those of the same shots in a PulseWaves file (`--pulses`). Every K-th shot,
or so many of the longest, are fitted in one batch for each kind of scene, which goes on where it was
interrupted. A CSV and a netCDF file get one row a shot, and a page the pictures of the best, median and worst
fits. A shot that cannot be fitted has a row with the reason.

A return of several echoes is fitted by ground and the canopy of `fit_gedi.py`. Found are the elevations of
ground and top, and every layer's plant area density; its gain, and the baseline of every digitiser. Where
footprints are wide, the slope is found too. A return of one echo is fitted by ground alone: its elevation,
and by how much its echo is broader than that of flat hard ground, or the slope. Nothing says that it is
ground and no crown; where it is much broader, or the fit poor, the row says so.

Counts become amplitudes by the file's tables. Saturated samples have no weight. A RIEGL receiver's response
is estimated from the narrowest single echoes of the file. No answers are known here: the ground stands beside
the last echo that copies of the pulse find. They differ where something returns light within a pulse's length
of the ground, and where the ground is hardly seen.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from _airborne import Flight, Instrument, Record, add_options, echoes_of, read_flight, records_of, response_of
from _recorded import (
    GROUND,
    LAYERS,
    QUALITIES,
    Layers,
    bad_row,
    draw_page,
    progress_bar,
    quality_of,
    write_tables,
)

import inversion
import jaxlidar as jl
from inversion import Recorder, Unknown, Verdict

# m of height for 1 ns.
WAY = 0.149896229
# Footprints from so wide on show slopes, m.
WIDE = 5.0
# Of slopes, degrees.
STEEPEST = 30.0
# A fitted ground so far from the last echo is doubtful, m; so is a single echo that is broadened by so much
# of its pulse's standard deviation.
APART, BROAD = 1.0, 0.5
# Samples of a pulse before and after its time zero, where records are judged.
LAGS = 80
# Bounds: of what broadens a single echo, ns, of offsets and of the gain, over the record's peak.
BROADENING, OFFSET, SCALE = (0.05, 10.0), (-0.2, 0.2), (0.0, 1e3)
UNITS = {
    **dict.fromkeys(("ground", "ground_stderr", "last_echo", "canopy_top", "canopy_top_stderr"), "m"),
    "clearance": "m",
    **dict.fromkeys(("easting", "northing"), "as in the file"),
    **dict.fromkeys(("longitude", "latitude", "slope", "slope_stderr"), "degrees"),
    **dict.fromkeys(("broadening", "broadening_stderr"), "ns"),
    **dict.fromkeys(("density", "density_stderr"), "m2 m-3"),
}


class Kind(NamedTuple):
    """A kind of scene: where fits start, its largest one, unknowns, and m fitted above the last echo."""

    name: str
    scene: jl.Scene
    largest: jl.Scene
    unknowns: list[Unknown]
    above: float
    canopy: Layers | None = None


def kinds_of(own: Instrument) -> tuple[Kind, Kind]:
    """Ground alone, and ground under a canopy."""
    canopy, wide = Layers(clearance=own.clearance), own.footprint > WIDE
    slope = [Unknown("ground.slope", bounds=(0.0, STEEPEST), name="slope", prior=(0.0, 15.0))] if wide else []
    sloping, steepest = (5.0, STEEPEST) if wide else (0.0, 0.0)
    height = {"name": "ground", "bounds": (-3.0, 3.0), "start": 0.0}
    bare, steep = (
        jl.Scene(ground=jl.Ground(reflectance=GROUND, slope=degrees)) for degrees in (sloping, steepest)
    )
    high = eqx.tree_at(lambda s: s.ground.height, steep, 3.0)
    unknowns = [
        Unknown(prior=(0.0, 1.0), apply=canopy.put_ground, **height),
        Unknown(
            name="canopy height",
            bounds=(own.clearance + 0.5, own.tallest),
            start=0.3 * own.tallest,
            apply=canopy.put_height,
        ),
        *slope,
        Unknown(
            name="log density",
            bounds=(np.log(1e-4), np.log(10.0)),
            prior=(np.log(0.1), 1.0),
            start=np.full(LAYERS, np.log(0.1)),
            apply=canopy.put_density,
        ),
    ]
    start = canopy.scene(0.3 * own.tallest, slope=sloping)
    tall = canopy.scene(own.tallest, ground=3.0, slope=steepest)
    return (
        Kind("ground", bare, high, [Unknown("ground.height", **height), *slope], own.below),
        Kind("ground and canopy", start, tall, unknowns, own.above, canopy),
    )


class Window(NamedTuple):
    """What is fitted of a record: signal and noise at common times, and the elevation of time zero, m."""

    signal: np.ndarray
    noise: np.ndarray
    elevation: np.ndarray
    reference: float


class Fitted(NamedTuple):
    """The retrievals of one kind of scene, what was fitted, and by which recorder, shot by shot."""

    fits: inversion.Retrievals
    windows: list[Window]
    recorders: list[Recorder]


def window(record: Record, last: float, time: np.ndarray) -> Window:
    """A record about the sample nearest to its last echo; without weight outside."""
    middle = int(np.argmin(np.abs(record.elevation - last)))
    number = middle + np.round(time / record.shot.sampling_interval).astype(int)
    inside = (number >= 0) & (number < record.signal.size)
    at = np.clip(number, 0, record.signal.size - 1)
    signal, noise = np.where(inside, record.signal[at], 0.0), np.where(inside, record.noise[at], np.inf)
    reference = float(record.elevation[middle])
    per_ns = record.shot.direction[2] * record.shot.metres[2]
    return Window(signal, noise, reference + per_ns * time, reference)


def fit(
    kind: Kind,
    records: Sequence[Record],
    echoes: Sequence[np.ndarray],
    own: Instrument,
    impulse: np.ndarray | None,
    path: Path | None = None,
    progress: Callable | None = None,
) -> Fitted:
    """Fit records in one batch, kept in `path`."""
    step = records[0].shot.sampling_interval
    above, below = (round(metres / (WAY * step)) for metres in (kind.above, own.below))
    time = step * np.arange(-above, below + 1)
    windows = [window(record, e[-1], time) for record, e in zip(records, echoes)]
    lidars = [record.lidar for record in records]
    broadening = BROADENING if kind.canopy is None and own.footprint <= WIDE else None
    recorders = [
        Recorder(
            width=broadening,
            impulse=impulse,
            offset=OFFSET,
            interleaved=own.interleaved,
            pulse_noise=record.pulse_noise,
            correlation=own.correlation,
        )
        for record in records
    ]
    height = [np.clip(e[0] - e[-1] + 1.0, own.clearance + 1.0, own.tallest - 2.0) for e in echoes]
    fits = inversion.retrieve_many(
        np.stack([w.signal for w in windows])[:, None],
        lidars,
        kind.scene,
        kind.unknowns,
        noise=np.stack([w.noise for w in windows])[:, None],
        time=time,
        key=jax.random.key(0),
        plan=jl.plan(
            lidars[0],
            kind.largest,
            max_orders=1,
            window=(time[0], time[-1]),
            bin_width=step,
            n_rays=64 if own.footprint > WIDE else 16,
            footprint="fixed",
        ),
        start={} if kind.canopy is None else {"canopy height": np.array(height)},
        max_steps=150,
        scale=SCALE,
        recorder=recorders,
        lanes=4,
        path=path,
        progress=progress,
    )
    return Fitted(fits, windows, recorders)


def known_of(shot, echoes=()):
    east, north, _ = shot.position[-1]
    names = ("longitude", "latitude") if shot.is_geographic else ("easting", "northing")
    time = {} if shot.gps_time is None else {"gps_time": shot.gps_time}
    return {"shot_number": int(shot.index), **time, names[0]: east, names[1]: north, "echoes": len(echoes)}


def verdict_of(
    record: Record, impulse: np.ndarray | None, verdict: Verdict, off: float, broadening: float
) -> Verdict:
    """A fit's verdict with that of the record, and what the ground and a single echo tell."""
    if record.saturated:
        verdict &= Verdict("doubtful", (f"saturated: {record.saturated} samples have no weight",))
    elif record.shot.recorded.all():
        own = {"noise": record.quiet, "pulse": record.pulse(LAGS, impulse)}
        verdict &= inversion.judge_record(record.signal, **own)
    if abs(off) > APART:
        verdict &= Verdict("doubtful", (f"ground {off:+.2f} m from the last echo",))
    if broadening > BROAD * float(record.lidar.pulse.std):
        reason = f"broader by {broadening:.1f} ns than an echo of flat hard ground"
        verdict &= Verdict("doubtful", (reason,))
    return verdict


def row_of(kind: Kind, record: Record, echoes: np.ndarray, found: Fitted, i: int, verdict: Verdict):
    """The row of a shot, and its picture."""
    values, error = found.fits.values, found.fits.robust_stderr
    place, own = found.windows[i], {name: value[i] for name, value in values.items()}
    ground, ground_stderr = place.reference + float(own["ground"]), float(error["ground"][i])
    off = ground - float(echoes[-1])
    row = {
        **known_of(record.shot, echoes),
        "scene": kind.name,
        "saturated": record.saturated,
        "ground": ground,
        "ground_stderr": ground_stderr,
        "last_echo": float(echoes[-1]),
    }
    for name, column in (("slope", "slope"), ("receiver width", "broadening")):
        if name in own:
            row |= {column: float(own[name]), f"{column}_stderr": float(error[name][i])}
    impulse = found.recorders[i].impulse
    verdict = verdict_of(record, impulse, verdict, off, row.get("broadening", 0.0))
    top = {}
    if kind.canopy is None:
        row |= quality_of(found.fits, i, verdict)
    else:
        row["canopy_top"] = ground + float(own["canopy height"])
        row["canopy_top_stderr"] = float(np.hypot(error["canopy height"][i], ground_stderr))
        row |= kind.canopy.columns(found.fits, i, verdict)
        top = {"canopy top": row["canopy_top"]}
    step = record.shot.sampling_interval
    fitted = found.recorders[i].recorded(found.fits.fitted[i, 0], own, step=step)
    picture = {
        "title": f"shot {record.shot.index}\n{row['quality']}, chi2 {row['reduced_chi2']:.2g}",
        "elevation": place.elevation,
        "signal": record.peak * np.where(np.isfinite(place.noise), place.signal, np.nan),
        "fitted": record.peak * fitted,
        "ground": ground,
        "reference": float(echoes[-1]),
        "chi2": row["reduced_chi2"],
        "unit": "amplitude",
        **top,
    }
    return row, picture


def fit_shots(shots: Sequence, flight: Flight, stem: Path | None = None, progress: Callable | None = None):
    """Fit shots. **Returns:** a row for each, and pictures of those that were fitted."""
    own, rows, pictures = flight.instrument, [], []
    tried = records_of(shots, flight)
    rows += [bad_row(why, **known_of(s)) for s, why in zip(shots, tried) if isinstance(why, ValueError)]
    records = [record for record in tried if isinstance(record, Record)]
    if not records:
        return rows, pictures
    impulse = response_of(flight)
    kinds = kinds_of(own)
    batches = {kind.name: [] for kind in kinds}
    for record, all_echoes in zip(records, echoes_of(records, impulse)):
        echoes = all_echoes[all_echoes - all_echoes[-1:] < own.above]
        if len(echoes) == 1 or len(echoes) >= own.fewest:
            said = Verdict("good", ())
            if more := all_echoes.size - echoes.size:
                reason = f"above what is fitted, {own.above:g} m over the last echo: {more} more"
                said = Verdict("doubtful", (reason,))
            batches[kinds[len(echoes) > 1].name].append((record, echoes, said))
        else:
            reason = "ground and canopy cannot be told apart" if len(echoes) else "nothing above the noise"
            rows.append(bad_row(f"{len(echoes)} echoes: {reason}", **known_of(record.shot, echoes)))
    for kind in kinds:
        if not batches[kind.name]:
            continue
        chosen, echoes, said = zip(*batches[kind.name])
        name = kind.name.replace(" ", "_")
        path = None if stem is None else stem.with_name(f"{stem.name}.{name}.sqlite")
        found = fit(kind, chosen, echoes, own, impulse, path, progress)
        for i, verdict in enumerate(inversion.judge_fits(found.fits, about=["ground"])):
            row, picture = row_of(kind, chosen[i], echoes[i], found, i, verdict & said[i])
            rows.append(row)
            pictures.append(picture)
    return sorted(rows, key=lambda row: row["shot_number"]), pictures


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="recorded returns (.npz, .pls, .las)")
    parser.add_argument("--every", type=int, default=1, help="take every K-th shot; default: all")
    parser.add_argument("--shots", type=int, help="how many of the longest returns to fit; default: all")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for tables and pictures")
    add_options(parser)
    options = parser.parse_args(argv)
    if options.every < 1 or (options.shots is not None and options.shots < 1):
        parser.error("--every and --shots: admissible are whole numbers from 1 on")
    stem = options.out / options.file.stem
    try:
        flight = read_flight(options.file, options)
        shots = sorted(flight.shots[:: options.every], key=lambda s: -s.recorded.size)[: options.shots]
        options.out.mkdir(parents=True, exist_ok=True)
        with progress_bar() as progress:
            rows, pictures = fit_shots(shots, flight, stem, progress)
    except (ImportError, OSError, ValueError) as error:
        sys.exit(str(error))
    written = list(write_tables(rows, stem, UNITS))
    if pictures:
        written.append(stem.with_name(f"{stem.name}.png"))
        draw_page(pictures, {}, written[-1])
        off = np.array([row["ground"] - row["last_echo"] for row in rows if "ground" in row])
        print(f"ground less last echo: median {np.median(off):.2f} m, spread {np.std(off):.2f} m")
    print(", ".join(f"{sum(r['quality'] == q for r in rows)} {q}" for q in QUALITIES))
    print("written:", *written)
    return rows


if __name__ == "__main__":
    main()
    sys.exit(0)
