"""Fit recorded GEDI waveforms: a layered canopy over sloping ground, with each shot's own transmit pulse.

    python examples/fit_gedi.py GEDI01_B_....h5 [--shot N] [--answers answers.npz] [--out figures]

All shots of a file are fitted in one batch, which resumes where it was interrupted. The script writes one row
a shot to a CSV and a netCDF file, and a page with pictures of the best, median and worst fits, beside the
product's values if they are given. A shot that cannot be fitted has a row with the reason.

The canopy is horizontally uniform: ten layers of equal thickness from 1 m above the ground to the top. The
unknowns are the elevations of ground and top, the slope (which stands for all that widens the ground's echo),
the plant area density of every layer, and one factor for the receiver's unknown gain. Reflectances are fixed,
in the ratio of the level-2B algorithm, rho_v / rho_g = 0.6 / 0.4. First order only, with the hot spot.

Plants within a pulse's length of the ground merge with its echo, and waveforms alone do not separate the two.
So the ground starts at the mode of `inversion.find_ground`, with a prior of 0.1 m about it, and its
standard error includes the difference between the two. If GEDI's own rule gives another ground, the fit
starts from both. `prior_share_...` is the fraction of the information that the priors give. For the same
reason `pai` and `cover` are not those of the layers but of the energy split at the matched mode
(`inversion.ground_and_canopy`), which are nearer to the product's; the layers' sum is `pai_layers`. Relative
heights are the fitted waveform's, read by the product's rules (`inversion.gedi_metrics`).

**The closed forms of `inversion.gedi_table` are the first choice.** Of 60 shots of a savanna, 44 are rated
good and none bad. The ground is low, by 0.09 m from the product's in the median and by 0.32 m or more in a
tenth of the good shots; the matched mode is within 0.02 m in the median and 0.08 m in all. The likely cause
is relief: it gives the ground's echo shoulders, which a plane under plants explains by low plants, with the
ground below them. Waveforms alone do not tell the two apart. Two standard errors of the ground cover the
product's in all good shots, but only as they include the difference from the matched mode; those of the fit
alone cover 84 %. Rank correlations with the product are 0.98 for RH98, 0.91 for `pai` (0.90 above 0.1, in the
median 0.86 of the product's), 0.39 for `pai_layers`, and 0.75 for the canopy's fitted top, which the layers'
prior blurs.
"""

import argparse
import sys
import types
from pathlib import Path

import jax
import numpy as np
from _recorded import (
    LAYERS,
    QUALITIES,
    LayeredCanopy,
    bad_row,
    columns_of,
    draw_page,
    progress_bar,
    write_tables,
)
from scipy import stats

import inversion
import jaxlidar as jl
from inversion import Unknown, Verdict
from jaxlidar.io import read_gedi_l1b

CANOPY = LayeredCanopy(clearance=1.0)
ALTITUDE, FOOTPRINT = 400e3, 25.0
# Samples above and below the reference: of 1 ns, or 0.15 m.
ABOVE, BELOW = 280, 80
# Records are smoothed as by a Gaussian of this standard deviation, ns; the transmitted pulse is not.
SMOOTHING = 1.7
# Noise is correlated over five neighbouring samples: together they have the information of one.
CORRELATED = 5
# The receiver has a tail that the transmitted pulse does not show: samples further than this below the
# ground's mode are not fitted.
TAIL = 14
# Relative error of the model: the pulse is itself a record, and no canopy is uniform.
MODEL_ERROR = 0.01
# Two estimates of the ground further apart than this are both tried, m. If the reduced chi-squared of the two
# fits differ by less than a factor, the ground is ambiguous.
AMBIGUOUS, CHI2_FACTOR = 0.5, 2.0
# A fitted ground further than this from the matched mode is doubtful, m.
DOUBTFUL = 0.5
RH = (25, 50, 75, 95, 98, 100)
UNITS = {
    **dict.fromkeys(("latitude", "longitude"), "degrees"),
    **dict.fromkeys(("ground", "ground_stderr", "ground_matched", "canopy_top", "canopy_top_stderr"), "m"),
    **dict.fromkeys(("highest_return", "clearance", *(f"rh{level}" for level in RH)), "m"),
    **dict.fromkeys(("density", "density_stderr"), "m2 m-3"),
    **dict.fromkeys(("slope", "slope_stderr"), "degrees"),
}


def lidar_of(pulse):
    """GEDI with the transmitted pulse of a shot. The footprint is 25 m wide at 1/e^2."""
    divergence = FOOTPRINT / ALTITUDE * 1e3
    return jl.Lidar(altitude=ALTITUDE, divergence=divergence, aperture=0.8, pulse=pulse, jitter=SMOOTHING)


def common_plan():
    """Plan of all shots, so that they compile once: for the longest pulse and the largest scene."""
    return jl.plan(
        lidar_of(jl.GaussianPulse(fwhm=40.0)),
        CANOPY.scene(50.0, -6.0, 25.0),
        max_orders=1,
        window=(-ABOVE, BELOW),
        bin_width=1.0,
        n_rays=256,
        footprint="fixed",
    )


UNKNOWNS = [
    Unknown(name="ground", bounds=(-1.0, 1.0), prior=(0.0, 0.1), start=0.0, apply=CANOPY.put_ground),
    Unknown(name="canopy height", bounds=(1.5, 45.0), start=8.0, apply=CANOPY.put_height),
    Unknown("ground.slope", bounds=(0.0, 30.0), name="slope", prior=(0.0, 15.0)),
    Unknown(
        name="log density",
        bounds=(np.log(1e-5), np.log(3.0)),
        prior=(np.log(0.01), 1.5),
        start=np.full(LAYERS, np.log(0.02)),
        apply=CANOPY.put_density,
    ),
]


class PreparedShot:
    """A shot about an estimate of the ground: fraction of the signal in each sample, and its noise.

    - `reference`: elevation of the sample nearest to the ground, m, which is height zero of the fit.
    - `elevation`, `signal`, `noise`: of the samples, from the top down; noise is infinite for samples that
      are not fitted.
    - `total`: sum of the signal in counts, by which signal and noise are divided.
    - `height`: of the canopy over the ground, m, to start from.
    """

    def __init__(self, shot, ground):
        self.shot, self.middle = shot, int(np.argmin(np.abs(shot.elevation - ground)))
        number = self.middle + np.arange(-ABOVE, BELOW + 1)
        inside = (number >= 0) & (number < shot.waveform.size)
        step = (shot.elevation[0] - shot.elevation[-1]) / (shot.waveform.size - 1)
        self.reference = float(shot.elevation[self.middle])
        self.elevation = self.reference - step * np.arange(-ABOVE, BELOW + 1)
        # Samples above the canopy are noise alone; a record that begins lower has the product's values.
        quiet = shot.waveform[: max(self.middle - ABOVE, 0)]
        mean, std = (np.mean(quiet), np.std(quiet)) if quiet.size >= 50 else (shot.noise_mean, shot.noise_std)
        signal = np.where(inside, shot.waveform[np.clip(number, 0, shot.waveform.size - 1)] - mean, 0.0)
        noise = np.sqrt(CORRELATED) * np.hypot(std, MODEL_ERROR * signal)
        self.total = float(signal.sum())
        if not self.total > 0:
            raise ValueError("no signal about the ground")
        self.signal = signal / self.total
        self.noise = np.where(inside & (number <= self.middle + TAIL), noise / self.total, np.inf)
        # The echo of the top begins about 2 m above it.
        bright = np.flatnonzero(signal > 3.0 * shot.noise_std)
        top = self.elevation[bright[0]] - self.reference - 2.0 if bright.size else 0.0
        self.height = float(np.clip(top, 2.0, 38.0))


def pulse_of(shot):
    """Transmitted pulse at whole ns from its time zero."""
    return np.interp(np.arange(-64.0, 65.0), shot.pulse_time, shot.pulse_power, left=0.0, right=0.0)


def judge_and_find_ground(shot):
    """Verdict on the record, and the grounds to start from.

    **Raises:** ValueError for a record without ground, with the reasons.
    """
    pulse = pulse_of(shot)
    verdict = inversion.judge_record(
        shot.signal, noise=shot.noise_std, pulse=pulse, degrade=shot.degrade, stale_return=shot.stale_return
    )
    ground = float(inversion.find_ground(shot.elevation, shot.signal, pulse=pulse, noise=shot.noise_std))
    if not np.isfinite(ground):
        raise ValueError("; ".join(("no ground above the noise", *verdict.reasons)))
    mode = float(inversion.gedi_metrics([shot]).elev_lowestmode[0])
    return verdict, [ground, mode] if abs(mode - ground) > AMBIGUOUS else [ground]


def fit(prepared, path=None, progress=None):
    """Fit prepared shots in one batch, with its checkpoint in `path`.

    **Returns:** an `inversion.Retrievals`.
    """
    pulses = [jl.SampledPulse(time=p.shot.pulse_time, power=p.shot.pulse_power) for p in prepared]
    return inversion.retrieve_many(
        np.stack([p.signal for p in prepared])[:, None],
        [lidar_of(pulse) for pulse in pulses],
        CANOPY.scene(10.0),
        UNKNOWNS,
        noise=np.stack([p.noise for p in prepared])[:, None],
        time=np.arange(-ABOVE, BELOW + 1),
        key=jax.random.key(0),
        plan=common_plan(),
        start={"canopy height": np.array([p.height for p in prepared])},
        max_steps=100,
        # A fraction of the signal over an apparent reflectance.
        scale=(0.0, 20.0),
        path=path,
        progress=progress,
    )


def row_of(prepared, fits, i, matched, verdict):
    """Row of a shot, and its fitted waveform in counts.

    `i`: number of the fit. `matched`: elevation of the matched mode, m.
    """
    shot, values, error = prepared.shot, fits.values, fits.robust_stderr
    height = float(values["canopy height"][i])
    offset = float(values["ground"][i])
    ground = prepared.reference + offset
    ground_stderr = float(np.hypot(error["ground"][i], ground - matched))
    if abs(ground - matched) > DOUBTFUL:
        verdict &= Verdict("doubtful", (f"ground {ground - matched:+.2f} m from the matched mode",))
    fitted = float(values["scale"][i]) * fits.fitted[i, 0] * prepared.total
    fitted_shot = types.SimpleNamespace(
        elevation=prepared.elevation, waveform=fitted, noise_mean=0.0, noise_std=shot.noise_std
    )
    metrics = inversion.gedi_metrics([fitted_shot])
    # Errors of the split: half the difference between grounds one standard error lower and higher.
    grounds = matched + ground_stderr * np.array([0.0, -1.0, 1.0])
    split = inversion.ground_and_canopy(
        shot.elevation, shot.signal, pulse=pulse_of(shot), noise=shot.noise_std, ground=grounds
    )
    gap = np.clip(np.asarray(split.gap, float), 1e-3, 1.0)
    area = np.asarray(inversion.plant_area_index(gap), float)
    row = {
        "ground": ground,
        "ground_stderr": ground_stderr,
        "ground_matched": matched,
        "canopy_top": ground + height,
        "canopy_top_stderr": float(np.hypot(error["canopy height"][i], ground_stderr)),
        "highest_return": float(metrics.elev_highestreturn[0]),
        **{f"rh{level}": float(metrics.rh[0, level]) for level in RH},
        "pai": area[0],
        "pai_stderr": float(np.ptp(area[1:]) / 2),
        "cover": 1.0 - gap[0],
        "cover_stderr": float(np.ptp(gap[1:]) / 2),
        "slope": float(values["slope"][i]),
        "slope_stderr": float(error["slope"][i]),
        **CANOPY.columns(fits, i, verdict),
    }
    return row, fitted


def fit_shots(shots, path=None, progress=None):
    """Fit shots, some from two grounds, all in one batch.

    **Arguments:** `shots`: of a file; a shot that could not be read is its row.

    **Returns:** a row for each shot, and pictures of those that were fitted.
    """
    # Of each shot: the verdict on its record, its grounds and their numbers in the batch; or the error.
    preparations, prepared, rows, pictures = [], [], [], []
    for shot in shots:
        try:
            if isinstance(shot, dict):
                raise ValueError(shot["reasons"])
            verdict, grounds = judge_and_find_ground(shot)
            candidates = [PreparedShot(shot, ground) for ground in grounds]
            numbers = range(len(prepared), len(prepared) + len(candidates))
            preparations.append((verdict, grounds, numbers))
            prepared += candidates
        except ValueError as error:
            preparations.append(error)
    fits = fit(prepared, path, progress) if prepared else None
    verdicts = inversion.judge_fits(fits, about=["ground"]) if fits else ()
    for shot, preparation in zip(shots, preparations):
        if isinstance(preparation, ValueError):
            columns = shot if isinstance(shot, dict) else identity_of(shot)
            rows.append({**columns, **bad_row(preparation)})
            continue
        record_verdict, grounds, numbers = preparation
        # The better fit counts; one that did not converge only if none did.
        best, *alternatives = sorted(numbers, key=lambda i: (not fits.converged[i], fits.reduced_chi2[i]))
        verdict = record_verdict & verdicts[best]
        for i in alternatives:
            if fits.reduced_chi2[i] < CHI2_FACTOR * fits.reduced_chi2[best]:
                reason = f"ground at {grounds[i - numbers[0]]:.1f} m fits nearly as well"
                verdict &= Verdict("doubtful", (f"second minimum: {reason}",))
        row, fitted = row_of(prepared[best], fits, best, grounds[best - numbers[0]], verdict)
        rows.append({**identity_of(shot), **row})
        pictures.append(
            {
                "title": f"shot {shot.shot_number}\n{row['quality']}, chi2 {row['reduced_chi2']:.2g}",
                "elevation": prepared[best].elevation,
                "signal": prepared[best].signal * prepared[best].total,
                "fitted": fitted,
                "ground": row["ground"],
                "canopy top": row["canopy_top"],
                "chi2": row["reduced_chi2"],
                "unit": "counts",
            }
        )
    return rows, pictures


def identity_of(shot):
    """Columns of a shot that do not come from a fit."""
    return {
        "shot_number": int(shot.shot_number),
        "beam": shot.beam,
        "latitude": shot.latitude,
        "longitude": shot.longitude,
    }


def read(path, shot=None):
    """Read all shots of a file, or one. A shot that cannot be read becomes its row, with the reason."""
    if shot is not None:
        return read_gedi_l1b(path, shot)
    try:
        return read_gedi_l1b(path)
    except ValueError:
        # One damaged shot fails the file: read shot by shot.
        import h5py

        with h5py.File(path) as file:
            numbers = [(b, int(n)) for b in file if b.startswith("BEAM") for n in file[b]["shot_number"][:]]
        return [_read_shot(path, i, beam, number) for i, (beam, number) in enumerate(numbers)]


def _read_shot(path, index, beam, number):
    try:
        return read_gedi_l1b(path, index)[0]
    except ValueError as error:
        return bad_row(error, shot_number=number, beam=beam)


def compare(rows, answers):
    """Print the differences of rows from the product's values. **Returns:** numbers, and pairs to draw."""
    index = {int(n): i for i, n in enumerate(answers["shot"])}
    shared = [row for row in rows if row["shot_number"] in index and "ground" in row]
    if len(shared) < 2:
        return {}, {}
    order = np.array([index[row["shot_number"]] for row in shared])
    product = {name: answers[name][order] for name in ("elev_lowestmode", "pai", "rh")}
    fitted = columns_of(shared)
    difference = fitted["ground"] - product["elev_lowestmode"]
    is_good, is_leafy = fitted["quality"] == "good", product["pai"] > 0.1

    def rank_correlation(a, b):
        return float(stats.spearmanr(a, b).statistic)

    is_covered = np.abs(difference) <= 2.0 * fitted["ground_stderr"]
    area, rh98 = product["pai"], product["rh"][:, 98]
    largest = float(np.max(np.abs(difference[is_good]), initial=0.0))
    numbers = {
        "shots": len(shared),
        "good": int(is_good.sum()),
        "ground, median difference (m)": float(np.median(np.abs(difference))),
        "ground, largest difference of good shots (m)": largest,
        "ground within 2 s.e., good shots": float(np.mean(is_covered[is_good])) if is_good.any() else np.nan,
        "ground, median s.e. (m)": float(np.median(fitted["ground_stderr"])),
        "rank of pai": rank_correlation(fitted["pai"], area),
        "rank of pai above 0.1": rank_correlation(fitted["pai"][is_leafy], area[is_leafy]),
        "rank of pai, of layers": rank_correlation(fitted["pai_layers"], area),
        "rank of RH98": rank_correlation(fitted["rh98"], rh98),
        "rank of canopy top": rank_correlation(fitted["canopy_top"] - fitted["ground"], rh98),
    }
    for name, value in numbers.items():
        print(f"{name:48} {value:.3g}")
    pairs = {
        "ground (m)": (product["elev_lowestmode"], fitted["ground"]),
        "RH98 (m)": (rh98, fitted["rh98"]),
        "PAI": (area, fitted["pai"]),
    }
    return numbers, pairs


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="a GEDI L1B file (HDF5)")
    parser.add_argument("--shot", type=int, help="one shot: index in the file, or shot number")
    parser.add_argument("--answers", type=Path, help="npz with the product's values, by shot number")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for tables and pictures")
    options = parser.parse_args(argv)
    try:
        shots = read(options.file, options.shot)
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    stem = options.out / (options.file.stem + ("" if options.shot is None else f"_{options.shot}"))
    options.out.mkdir(parents=True, exist_ok=True)
    picture = stem.with_name(f"{stem.name}.png")
    with progress_bar() as progress:
        rows, pictures = fit_shots(shots, stem.with_name(f"{stem.name}.sqlite"), progress)
    tables = write_tables(rows, stem, UNITS)
    numbers, pairs = {}, {}
    if options.answers is not None:
        with np.load(options.answers) as answers:
            numbers, pairs = compare(rows, dict(answers))
    print(", ".join(f"{sum(r['quality'] == q for r in rows)} {q}" for q in QUALITIES))
    if pictures:
        draw_page(pictures, pairs, picture)
    print("written:", *tables, *([picture] if pictures else []))
    return rows, numbers


if __name__ == "__main__":
    main()
    sys.exit(0)
