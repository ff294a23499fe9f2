"""Fit recorded returns of NEON's airborne lidar, each with its own pulse.

    python examples/fit_neon.py neon.npz [--shots 9] [--out figures]

The file is what `jaxlidar.io.read_neon` reads. Its returns, or so many of the longest, are fitted in one
batch, which goes on where it was interrupted. A CSV and a netCDF file get one row a shot, and a page the
pictures of the best, median and worst fits. A return that cannot be fitted has a row with the reason.

Canopies are as in `fit_gedi.py`, from 3 m above the ground. Found are the elevations of ground and top, every
layer's plant area density, and the receiver's gain. The pulse is 15 ns (2.3 m) long and a layer 1 to 2 m
thick: two crowns within one layer's reach make one echo of the fit.

Fitted are returns of three echoes or more: one or two echoes cannot tell ground from canopy, and most returns
of a closed forest end within it. The ground stands beside the last echo of the Gaussian decomposition. They
differ where something returns light within a pulse's length of the ground, which the model has no plants for,
and where the ground is hardly seen. No answers are known here.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np
from _recorded import GROUND, LAYERS, QUALITIES, Layers, bad_row, draw_page, progress_bar, write_tables

import inversion
import jaxlidar as jl
from inversion import Unknown, Verdict
from jaxlidar.io import read_neon, stack_shots

CANOPY = Layers(clearance=3.0)
ALTITUDE, DIVERGENCE = 1000.0, 0.8
# What a hard target's echo is blurred by beside its outgoing pulse, ns.
JITTER = 1.9
# Standard deviation of the pulse so blurred, ns.
PULSE_WIDTH = 6.7
# Samples above and below the last echo.
ABOVE, BELOW = 170, 50
# Noise is correlated over so many neighbouring samples, which then tell as much as one.
CORRELATED = 5
# Relative error of the model, of the largest sample: the pulse is itself a record, and no canopy is uniform.
MODEL_ERROR = 0.01
TIME = np.arange(-ABOVE, BELOW + 1)
# Echoes that tell ground from canopy.
FEWEST = 3
# A fitted ground so far from the last echo is doubtful, m.
APART = 1.0
UNITS = {
    **dict.fromkeys(("easting", "northing", "ground", "ground_stderr", "last_echo"), "m"),
    **dict.fromkeys(("canopy_top", "canopy_top_stderr", "clearance"), "m"),
    **dict.fromkeys(("density", "density_stderr"), "m2 m-3"),
}


def noise_of(shot):
    """Standard deviation of the shot's samples, as of independent ones; infinite in gaps."""
    noise = np.sqrt(CORRELATED) * np.hypot(shot.noise_std, MODEL_ERROR * shot.signal.max())
    return np.where(shot.recorded, noise, np.inf)


def echoes_of(shots):
    """Elevations of every shot's Gaussian echoes, from above."""
    stack = stack_shots(shots)
    noise = np.full(stack.signal.shape, np.inf)
    for row, shot in zip(noise, shots):
        row[: shot.recorded.size] = noise_of(shot)
    echoes = inversion.gaussian_decomposition(stack.time, stack.signal, noise=noise, width=PULSE_WIDTH)
    points = inversion.echo_points(shots, echoes)
    return np.split(points.position[:, 2], np.cumsum(echoes.count)[:-1])


def lidar_of(shot):
    """NEON's lidar with the shot's pulse and direction. Its footprint is 0.8 m wide."""
    return jl.Lidar(
        altitude=ALTITUDE,
        divergence=DIVERGENCE,
        zenith=shot.zenith,
        azimuth=shot.azimuth,
        pulse=jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power),
        jitter=JITTER,
    )


def window(shot, reference):
    """Signal and noise at times `TIME` from the reference elevation, without weight outside the record."""
    number = np.arange(shot.waveform.size)
    sample = np.round(np.interp(0.0, shot.time_from(reference), number)).astype(int) + TIME
    inside = (sample >= 0) & (sample < number.size)
    sample = np.clip(sample, 0, number.size - 1)
    return np.where(inside, shot.signal[sample], 0.0), np.where(inside, noise_of(shot)[sample], np.inf)


def fit(shots, echoes, path=None, progress=None):
    """Fit all shots at once. Returns the retrievals and the elevation of each one's reference plane."""
    # The sample nearest to the last echo, so that samples lie at whole ns.
    reference = np.array([s.elevation[np.argmin(np.abs(s.elevation - e[-1]))] for s, e in zip(shots, echoes)])
    windows = [window(*pair) for pair in zip(shots, reference)]
    signal, noise = (np.stack(a)[:, None, :] for a in zip(*windows))
    unknowns = [
        Unknown(name="ground", bounds=(-3.0, 3.0), prior=(0.0, 1.0), start=0.0, apply=CANOPY.put_ground),
        Unknown(
            name="canopy height", bounds=(CANOPY.clearance + 0.5, 30.0), start=10.0, apply=CANOPY.put_height
        ),
        Unknown(
            name="log density",
            bounds=(np.log(1e-4), np.log(10.0)),
            prior=(np.log(0.1), 1.0),
            start=np.full(LAYERS, np.log(0.1)),
            apply=CANOPY.put_density,
        ),
    ]
    lidars = [lidar_of(shot) for shot in shots]
    found = inversion.retrieve_many(
        signal,
        lidars,
        CANOPY.scene(10.0, slope=0.0),
        unknowns,
        noise=noise,
        time=TIME,
        key=jax.random.key(0),
        plan=jl.plan(
            lidars[0],
            CANOPY.scene(30.0, slope=0.0),
            max_orders=1,
            window=(-ABOVE, BELOW),
            bin_width=1.0,
            n_rays=16,
            footprint="fixed",
        ),
        start={"canopy height": np.clip([e[0] - e[-1] + 1.0 for e in echoes], 4.0, 28.0)},
        scale=(0.0, 4.0 * float(signal.sum(axis=-1).max()) / GROUND),
        max_steps=150,
        lanes=4,
        path=path,
        progress=progress,
    )
    return found, reference


def known_of(shot):
    easting, northing, _ = shot.position[-1]
    return {"shot_number": int(shot.index), "easting": easting, "northing": northing}


def row_of(shot, last, found, reference, i, verdict):
    """The row of a shot, and its picture."""
    values, error = found.values, found.robust_stderr
    height = float(values["canopy height"][i])
    ground, ground_stderr = float(reference + values["ground"][i]), float(error["ground"][i])
    if abs(ground - last) > APART:
        verdict &= Verdict("doubtful", (f"ground {ground - last:+.2f} m from the last echo",))
    row = {
        **known_of(shot),
        "ground": ground,
        "ground_stderr": ground_stderr,
        "last_echo": last,
        "canopy_top": ground + height,
        "canopy_top_stderr": float(np.hypot(error["canopy height"][i], ground_stderr)),
        **CANOPY.columns(found, i, verdict),
    }
    signal, noise = window(shot, reference)
    picture = {
        "title": f"shot {shot.index}\n{row['quality']}, chi2 {row['reduced_chi2']:.2g}",
        "elevation": np.interp(TIME, shot.time_from(reference), shot.elevation, np.nan, np.nan),
        "signal": np.where(np.isfinite(noise), signal, np.nan),
        "fitted": float(values["scale"][i]) * found.fitted[i, 0],
        "ground": ground,
        "canopy top": row["canopy_top"],
        "reference": last,
        "chi2": row["reduced_chi2"],
    }
    return row, picture


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="recorded returns (.npz)")
    parser.add_argument("--shots", type=int, help="how many of the longest returns to fit; default: all")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for tables and pictures")
    options = parser.parse_args(argv)
    try:
        shots = sorted(read_neon(options.file).shots, key=lambda s: -s.waveform.size)[: options.shots]
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / options.file.stem
    echoes = echoes_of(shots)
    rows, pictures = [], []
    pairs = [(s, e) for s, e in zip(shots, echoes) if len(e) >= FEWEST]
    for shot, few in zip(shots, echoes):
        if len(few) < FEWEST:
            reason = f"{len(few)} echoes: ground and canopy cannot be told apart"
            rows.append(bad_row(reason, **known_of(shot)))
    if pairs:
        with progress_bar() as progress:
            found, reference = fit(*zip(*pairs), stem.with_name(f"{stem.name}.sqlite"), progress)
        verdicts = inversion.judge_fits(found, about=["ground"])
        for i, (shot, own) in enumerate(pairs):
            verdict = verdicts[i]
            if shot.recorded.all():
                own_record = {"noise": shot.noise_std, "pulse": shot.pulse_power}
                verdict &= inversion.judge_record(shot.signal, **own_record)
            row, picture = row_of(shot, float(own[-1]), found, float(reference[i]), i, verdict)
            rows.append(row)
            pictures.append(picture)
    rows.sort(key=lambda row: row["shot_number"])
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
