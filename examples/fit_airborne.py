"""Fit recorded returns of an airborne lidar, each with its own pulse.

    python examples/fit_airborne.py FILE [--shots 9] [--every 10] [--out figures]

FILE is a record of NEON (.npz, `jaxlidar.io.read_neon`), PulseWaves (.pls, as RIEGL and LVIS data are
published in) or LAS with wave packets (.las). LAS has no outgoing pulses: give one as a table (`--pulse`), as
a Gaussian (`--pulse-width`), or those of the same shots in a PulseWaves file (`--pulses`). Every K-th shot,
or a number of the longest, are fitted in one batch for each kind of scene, which resumes where it was
interrupted. The script writes one row a shot to a CSV and a netCDF file, and a page with pictures of the
best, median and worst fits. A shot that cannot be fitted has a row with the reason.

A return of several echoes is fitted by ground and the canopy of the GEDI fits. The unknowns are the
elevations of ground and top, every layer's plant area density, the gain, and the baseline of every
digitiser; with wide footprints the slope too. A return of one echo is fitted by ground alone: its elevation,
and by how much its echo is broader than that of flat hard ground, or the slope. The record does not show
that it is ground and not a crown; the row says so if it is much broader, or the fit poor.

Counts become amplitudes by the file's tables. Saturated samples have no weight. A RIEGL receiver's response
is estimated from the narrowest single echoes of the file. No true ground is known: rows give the fitted
ground beside the last echo of the decomposition into copies of the pulse. The two differ if a target returns
light within a pulse's length of the ground, or if the ground is faint.

The standard error of the canopy's top contains that upper layers may be empty, and that plants where the
record begins may be in no layer. Plants that no sample shows are not in it: of a canopy that thins out
upwards, the top is low.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from _airborne import (
    AirborneRecord,
    FlightLine,
    Instrument,
    add_options,
    echoes_of,
    read_flight,
    records_of,
    response_of,
)
from _recorded import (
    QUALITIES,
    bad_row,
    columns_of_canopy,
    draw_page,
    progress_bar,
    quality_of,
    write_tables,
)

import inversion
import jaxlidar as jl
from inversion import Recorder, Unknown, Verdict
from inversion.scene.layered_canopy import GROUND, LAYERS, LayeredCanopy

# m of height for 1 ns of two-way travel.
METRES_PER_NS = 0.149896229
# Slopes broaden the echoes of footprints wider than this, m.
WIDE_FOOTPRINT = 5.0
# Steepest slope, degrees.
STEEPEST = 30.0
# A fitted ground further than this from the last echo is doubtful, m; so is a single echo broadened by more
# than this fraction of its pulse's standard deviation.
DOUBTFUL_DISTANCE, DOUBTFUL_BROADENING = 1.0, 0.5
# The highest return exceeds this many standard deviations of the noise: GEDI's threshold of the front.
FRONT_THRESHOLD = 3.0
# Samples of a pulse before and after its time zero, in verdicts on records.
LAGS = 80
# Bounds of the broadening of a single echo, ns, and of offsets and gain, over the record's peak.
BROADENING, OFFSET, SCALE = (0.05, 10.0), (-0.2, 0.2), (0.0, 1e3)
UNITS = {
    **dict.fromkeys(("ground", "ground_stderr", "last_echo", "canopy_top", "canopy_top_stderr"), "m"),
    "clearance": "m",
    **dict.fromkeys(("easting", "northing"), "as in the file"),
    **dict.fromkeys(("longitude", "latitude", "slope", "slope_stderr"), "degrees"),
    **dict.fromkeys(("broadening", "broadening_stderr"), "ns"),
    **dict.fromkeys(("density", "density_stderr"), "m2 m-3"),
}


class SceneKind(NamedTuple):
    """A kind of scene: ground alone, or ground under a canopy.

    - `scene`: where fits start. `largest`: with all unknowns at their largest, for the common plan.
    - `above`: range of the fit above the last echo, m.
    """

    name: str
    scene: jl.Scene
    largest: jl.Scene
    unknowns: list[Unknown]
    above: float
    canopy: LayeredCanopy | None = None


def scene_kinds_of(instrument: Instrument) -> tuple[SceneKind, SceneKind]:
    """Ground alone, and ground under a canopy."""
    canopy, is_wide = LayeredCanopy(clearance=instrument.clearance), instrument.footprint > WIDE_FOOTPRINT
    slope = Unknown("ground.slope", bounds=(0.0, STEEPEST), name="slope", prior=(0.0, 15.0))
    slope_unknowns = [slope] if is_wide else []
    start_slope, largest_slope = (5.0, STEEPEST) if is_wide else (0.0, 0.0)
    ground = {"name": "ground", "bounds": (-3.0, 3.0), "start": 0.0}
    bare, steep = (
        jl.Scene(ground=jl.Ground(reflectance=GROUND, slope=degrees))
        for degrees in (start_slope, largest_slope)
    )
    largest_bare = eqx.tree_at(lambda s: s.ground.height, steep, 3.0)
    canopy_unknowns = [
        Unknown(prior=(0.0, 1.0), apply=canopy.put_ground, **ground),
        Unknown(
            name="canopy height",
            bounds=(instrument.clearance + 0.5, instrument.tallest),
            start=0.3 * instrument.tallest,
            apply=canopy.put_height,
        ),
        *slope_unknowns,
        Unknown(
            name="log density",
            bounds=(np.log(1e-4), np.log(10.0)),
            prior=(np.log(0.1), 1.0),
            start=np.full(LAYERS, np.log(0.1)),
            apply=canopy.put_density,
        ),
    ]
    start = canopy.scene(0.3 * instrument.tallest, slope=start_slope)
    largest = canopy.scene(instrument.tallest, ground=3.0, slope=largest_slope)
    bare_unknowns = [Unknown("ground.height", **ground), *slope_unknowns]
    return (
        SceneKind("ground", bare, largest_bare, bare_unknowns, instrument.below),
        SceneKind("ground and canopy", start, largest, canopy_unknowns, instrument.above, canopy),
    )


class FitWindow(NamedTuple):
    """Window of a record that is fitted: signal, noise and elevation at times common to all shots.

    `reference`: elevation of time zero, m.
    """

    signal: np.ndarray
    noise: np.ndarray
    elevation: np.ndarray
    reference: float


class FittedBatch(NamedTuple):
    """Retrievals of one kind of scene, with the window and the recorder of every shot.

    `highest_return`: (shots,) m over the reference of the window.
    """

    fits: inversion.Retrieval
    windows: list[FitWindow]
    recorders: list[Recorder]
    highest_return: np.ndarray


def window_of(record: AirborneRecord, last_echo: float, time: np.ndarray) -> FitWindow:
    """Window of a record about the sample nearest to its last echo; times outside it have no weight."""
    middle = int(np.argmin(np.abs(record.elevation - last_echo)))
    number = middle + np.round(time / record.shot.sampling_interval).astype(int)
    inside = (number >= 0) & (number < record.signal.size)
    number = np.clip(number, 0, record.signal.size - 1)
    signal = np.where(inside, record.signal[number], 0.0)
    noise = np.where(inside, record.noise[number], np.inf)
    reference = float(record.elevation[middle])
    metres_per_ns = record.shot.direction[2] * record.shot.metres[2]
    return FitWindow(signal, noise, reference + metres_per_ns * time, reference)


def highest_returns(
    records: Sequence[AirborneRecord], windows: Sequence[FitWindow], impulse: np.ndarray | None
) -> np.ndarray:
    """Heights of the highest returns over the references of their windows, m, (shots,); NaN without one.

    A return begins before its target by half of a pulse's length, which is taken off.
    """
    ends = inversion.signal_ends(
        np.stack([w.elevation - w.reference for w in windows]),
        np.stack([w.signal for w in windows]),
        noise=np.array([record.quiet for record in records]),
        pulse=np.stack([record.pulse(LAGS, impulse) for record in records]),
        threshold=FRONT_THRESHOLD,
    )
    half_pulse = 2.0 * METRES_PER_NS * np.array([float(record.lidar.pulse.std) for record in records])
    return np.asarray(ends.top, float) - half_pulse


def fit(
    kind: SceneKind,
    records: Sequence[AirborneRecord],
    echoes: Sequence[np.ndarray],
    instrument: Instrument,
    impulse: np.ndarray | None,
    path: Path | None = None,
    progress: Callable | None = None,
) -> FittedBatch:
    """Fit records to one kind of scene in one batch, whose fits are stored in `path`.

    `echoes`: elevations of the echoes of every record, m. `impulse`: the receiver's response.
    """
    step = records[0].shot.sampling_interval
    above, below = (round(metres / (METRES_PER_NS * step)) for metres in (kind.above, instrument.below))
    time = step * np.arange(-above, below + 1)
    windows = [window_of(record, e[-1], time) for record, e in zip(records, echoes)]
    lidars = [record.lidar for record in records]
    # Under a canopy the layers broaden the echo, in wide footprints the slope.
    is_wide = instrument.footprint > WIDE_FOOTPRINT
    broadening = BROADENING if kind.canopy is None and not is_wide else None
    recorders = [
        Recorder(
            width=broadening,
            impulse=impulse,
            offset=OFFSET,
            interleaved=instrument.interleaved,
            pulse_noise=record.pulse_noise,
            correlation=instrument.correlation,
        )
        for record in records
    ]
    lowest, highest = instrument.clearance + 1.0, instrument.tallest - 2.0
    # From the first echo, where plants are dense, fits end in minima several metres below thin tops.
    top = highest_returns(records, windows, impulse)
    height = np.clip(np.fmax(top, [e[0] - e[-1] for e in echoes]), lowest, highest)
    problem = inversion.Problem(
        np.stack([w.signal for w in windows])[:, None],
        lidars,
        kind.scene,
        kind.unknowns,
        noise=np.stack([w.noise for w in windows])[:, None],
        time=time,
        plan=jl.plan(
            lidars[0],
            kind.largest,
            max_orders=1,
            window=(time[0], time[-1]),
            bin_width=step,
            n_rays=64 if is_wide else 16,
            footprint="fixed",
        ),
        start={} if kind.canopy is None else {"canopy height": height},
        scale=SCALE,
        recorder=recorders,
    )
    fits = inversion.retrieve_many(
        problem, key=jax.random.key(0), max_steps=150, lanes=4, path=path, progress=progress
    )
    return FittedBatch(fits, windows, recorders, top)


def identity_of(shot, echoes=()):
    """Columns of a shot that do not come from a fit."""
    east, north, _ = shot.position[-1]
    names = ("longitude", "latitude") if shot.is_geographic else ("easting", "northing")
    time = {} if shot.gps_time is None else {"gps_time": shot.gps_time}
    return {"shot_number": int(shot.index), **time, names[0]: east, names[1]: north, "echoes": len(echoes)}


def verdict_of(
    record: AirborneRecord,
    impulse: np.ndarray | None,
    verdict: Verdict,
    ground_offset: float,
    broadening: float,
) -> Verdict:
    """Combine the verdict on a fit with those on the record, the ground and the width of a single echo.

    `ground_offset`: of the fitted ground from the last echo, m. `broadening`: of a single echo, ns.
    """
    if record.saturated:
        verdict &= Verdict("doubtful", (f"saturated: {record.saturated} samples have no weight",))
    elif record.shot.recorded.all():
        pulse = record.pulse(LAGS, impulse)
        verdict &= inversion.judge_record(record.signal, noise=record.quiet, pulse=pulse)
    if abs(ground_offset) > DOUBTFUL_DISTANCE:
        verdict &= Verdict("doubtful", (f"ground {ground_offset:+.2f} m from the last echo",))
    if broadening > DOUBTFUL_BROADENING * float(record.lidar.pulse.std):
        reason = f"broader by {broadening:.1f} ns than an echo of flat hard ground"
        verdict &= Verdict("doubtful", (reason,))
    return verdict


def row_of(
    kind: SceneKind,
    record: AirborneRecord,
    echoes: np.ndarray,
    batch: FittedBatch,
    i: int,
    verdict: Verdict,
):
    """Row of a shot, fit `i` of a batch, and its picture."""
    window, recorder = batch.windows[i], batch.recorders[i]
    values = {name: value[i] for name, value in batch.fits.values.items()}
    stderr = {name: value[i] for name, value in batch.fits.robust_stderr.items()}
    ground, ground_stderr = window.reference + float(values["ground"]), float(stderr["ground"])
    last_echo = float(echoes[-1])
    row = {
        **identity_of(record.shot, echoes),
        "scene": kind.name,
        "saturated": record.saturated,
        "ground": ground,
        "ground_stderr": ground_stderr,
        "last_echo": last_echo,
    }
    for name, column in (("slope", "slope"), ("receiver width", "broadening")):
        if name in values:
            row |= {column: float(values[name]), f"{column}_stderr": float(stderr[name])}
    broadening = row.get("broadening", 0.0)
    verdict = verdict_of(record, recorder.impulse, verdict, ground - last_echo, broadening)
    top = {}
    if kind.canopy is None:
        row |= quality_of(batch.fits, i, verdict)
    else:
        canopy = kind.canopy.estimates(batch.fits, i)
        row["canopy_top"] = window.reference + canopy.top
        # Ten layers of equal thickness may leave thin plants at the top out: two standard errors reach up to
        # where the record begins.
        above = np.fmax(batch.highest_return[i] - canopy.top, 0.0)
        row["canopy_top_stderr"] = float(np.hypot(canopy.top_stderr, 0.5 * above))
        row |= columns_of_canopy(kind.canopy, batch.fits, i, verdict)
        top = {"canopy top": row["canopy_top"]}
    fitted = recorder.recorded(batch.fits.fitted[i, 0], values, step=record.shot.sampling_interval)
    picture = {
        "title": f"shot {record.shot.index}\n{row['quality']}, chi2 {row['reduced_chi2']:.2g}",
        "elevation": window.elevation,
        "signal": record.peak * np.where(np.isfinite(window.noise), window.signal, np.nan),
        "fitted": record.peak * fitted,
        "ground": ground,
        "reference": last_echo,
        "chi2": row["reduced_chi2"],
        "unit": "amplitude",
        **top,
    }
    return row, picture


def fit_shots(
    shots: Sequence, flight: FlightLine, stem: Path | None = None, progress: Callable | None = None
):
    """Fit shots, in one batch for each kind of scene.

    1. Records of the shots; those that cannot be fitted become rows with the reason.
    2. Receiver's response, and echoes of every record. Their number chooses the kind of scene.
    3. Fit, verdicts, rows and pictures.

    **Returns:** a row for each shot, and pictures of those that were fitted.
    """
    instrument, rows, pictures = flight.instrument, [], []
    results = records_of(shots, flight)
    for shot, result in zip(shots, results):
        if isinstance(result, ValueError):
            rows.append(bad_row(result, **identity_of(shot)))
    records = [result for result in results if isinstance(result, AirborneRecord)]
    if not records:
        return rows, pictures
    impulse = response_of(flight)
    kinds = scene_kinds_of(instrument)
    batches = {kind.name: [] for kind in kinds}
    for record, all_echoes in zip(records, echoes_of(records, impulse)):
        echoes = all_echoes[all_echoes - all_echoes[-1:] < instrument.above]
        if len(echoes) == 1 or len(echoes) >= instrument.fewest:
            verdict = Verdict("good", ())
            if n_above := all_echoes.size - echoes.size:
                reason = f"above what is fitted, {instrument.above:g} m over the last echo: {n_above} more"
                verdict = Verdict("doubtful", (reason,))
            batches[kinds[len(echoes) > 1].name].append((record, echoes, verdict))
        else:
            reason = "ground and canopy cannot be separated" if len(echoes) else "nothing above the noise"
            rows.append(bad_row(f"{len(echoes)} echoes: {reason}", **identity_of(record.shot, echoes)))
    for kind in kinds:
        if not batches[kind.name]:
            continue
        kind_records, echoes, record_verdicts = zip(*batches[kind.name])
        name = kind.name.replace(" ", "_")
        path = None if stem is None else stem.with_name(f"{stem.name}.{name}.zarr")
        batch = fit(kind, kind_records, echoes, instrument, impulse, path, progress)
        for i, verdict in enumerate(inversion.judge_fits(batch.fits, about=["ground"])):
            verdict &= record_verdicts[i]
            row, picture = row_of(kind, kind_records[i], echoes[i], batch, i, verdict)
            rows.append(row)
            pictures.append(picture)
    return sorted(rows, key=lambda row: row["shot_number"]), pictures


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="recorded returns (.npz, .pls, .las)")
    parser.add_argument("--every", type=int, default=1, help="take every K-th shot; default: all")
    parser.add_argument("--shots", type=int, help="number of the longest returns to fit; default: all")
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
        offset = np.array([row["ground"] - row["last_echo"] for row in rows if "ground" in row])
        print(f"ground less last echo: median {np.median(offset):.2f} m, spread {np.std(offset):.2f} m")
    print(", ".join(f"{sum(r['quality'] == q for r in rows)} {q}" for q in QUALITIES))
    print("written:", *written)
    return rows


if __name__ == "__main__":
    main()
    sys.exit(0)
