"""Draw the fits of recorded GEDI waveforms beside their records, and tabulate them.

    python examples/fit_gedi.py GEDI01_B_....h5 [--shot N] [--answers answers.npz] [--out figures]

The fits are those of `inversion.gedi_table(..., fit=True)`: a layered canopy over sloping ground, with each
shot's own transmit pulse (`inversion.metrics.gedi_fit`). All shots of a file are fitted in one batch, which
resumes where it was interrupted. The script writes one row a shot to a CSV and a netCDF file, and a page with
pictures of the best, median and worst fits, beside the product's values if they are given. A shot that cannot
be fitted has a row with the reason.

The closed forms are the first choice: see `inversion.gedi_table` for how the two compare. So `ground_stderr`
here includes the difference of the fitted ground from the matched mode, and `pai` and `cover` are the closed
forms; the sum of the fitted layers is `pai_layers`. Relative heights are the fitted waveform's, read by the
product's rules (`inversion.gedi_metrics`). `prior_share_...` is the fraction of the information that the
priors give.
"""

import argparse
import sys
import types
from pathlib import Path

import numpy as np
from _recorded import (
    QUALITIES,
    bad_row,
    columns_of,
    columns_of_canopy,
    draw_page,
    progress_bar,
    write_tables,
)

import inversion
from inversion.metrics.gedi_fit import CANOPY, fit_gedi_shots
from jaxlidar.io import GediShot, read_gedi_l1b
from jaxlidar.io.gedi import read_gedi_rows

RH = (25, 50, 75, 95, 98, 100)
UNITS = {
    **dict.fromkeys(("latitude", "longitude"), "degrees"),
    **dict.fromkeys(("ground", "ground_stderr", "ground_matched", "canopy_top", "canopy_top_stderr"), "m"),
    **dict.fromkeys(("highest_return", "clearance", *(f"rh{level}" for level in RH)), "m"),
    **dict.fromkeys(("density", "density_stderr"), "m2 m-3"),
    **dict.fromkeys(("slope", "slope_stderr"), "degrees"),
}
# Quantities that are compared with the product's: names here and there, and labels.
COMPARED = {
    "ground": ("elev_lowestmode", "ground (m)"),
    "rh98": ("rh98", "RH98 (m)"),
    "pai": ("pai", "PAI"),
    "pai_layers": ("pai", "PAI of layers"),
    "canopy_height": ("rh98", "canopy top (m)"),
}
DRAWN = ("ground", "rh98", "pai")


def read(path, shot=None):
    """Read all shots of a file, or one. A shot that cannot be read becomes its row, with the reason."""
    if shot is not None:
        return read_gedi_l1b(path, shot)
    return [
        row
        if isinstance(row, GediShot)
        else bad_row(row.error, shot_number=int(row.shot_number), beam=row.beam)
        for row in read_gedi_rows(path)
    ]


def fit_shots(shots, path=None, progress=None):
    """Fit shots, all in one batch.

    **Arguments:** `shots`: of a file; a shot that could not be read is its row.

    **Returns:** a row for each shot, and pictures of those that were fitted.
    """
    records = [shot for shot in shots if not isinstance(shot, dict)]
    table = inversion.gedi_table(records)
    ground, lowest_mode = table["ground"], table["elev_lowestmode"]
    fits = fit_gedi_shots(records, ground, lowest_mode, path=path, progress=progress)
    metrics = inversion.gedi_metrics(
        [
            types.SimpleNamespace(
                elevation=fits.elevation[i],
                waveform=fits.fitted[i],
                noise_mean=0.0,
                noise_std=records[i].noise_std,
            )
            for i in np.flatnonzero(fits.numbers >= 0)
        ]
    )
    rows, pictures = [], []
    record_numbers = iter(range(len(records)))
    for shot in shots:
        if isinstance(shot, dict):
            rows.append(shot)
            continue
        i = next(record_numbers)
        if fits.numbers[i] < 0:
            # The closed form says more of records without ground.
            reasons = dict.fromkeys([*fits.verdicts[i].reasons, *table["reasons"][i].split("; ")])
            rows.append(bad_row("; ".join(filter(None, reasons)), **identity_of(shot)))
            continue
        row = row_of(fits, i, {name: column.values[i] for name, column in table.columns.items()})
        fitted_number = len(pictures)
        row["highest_return"] = float(metrics.elev_highestreturn[fitted_number])
        row |= {f"rh{level}": float(metrics.rh[fitted_number, level]) for level in RH}
        rows.append({**identity_of(shot), **row})
        pictures.append(
            {
                "title": f"shot {shot.shot_number}\n{row['quality']}, chi2 {row['reduced_chi2']:.2g}",
                "elevation": fits.elevation[i],
                "signal": fits.signal[i],
                "fitted": fits.fitted[i],
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


def row_of(fits, i, closed_forms):
    """Columns of a shot that was fitted.

    **Arguments:** `i`: number of the shot. `closed_forms`: its row of `inversion.gedi_table`.
    """
    estimates = {name: float(x[i]) for name, x in fits.estimates.items() if x.ndim == 1}
    matched = float(fits.start_ground[i])
    ground, top = estimates["ground"], estimates["canopy_top"]
    return {
        "ground": ground,
        "ground_stderr": float(np.hypot(estimates["ground_stderr"], ground - matched)),
        "ground_matched": matched,
        "canopy_top": top,
        "canopy_top_stderr": estimates["canopy_top_stderr"],
        "canopy_height": top - ground,
        **{name: float(closed_forms[name]) for name in ("pai", "pai_stderr", "cover", "cover_stderr")},
        "slope": estimates["slope"],
        "slope_stderr": estimates["slope_stderr"],
        **columns_of_canopy(CANOPY, fits.retrievals, int(fits.numbers[i]), fits.verdicts[i]),
    }


def compare(rows, answers):
    """Compare fitted rows with the product's values.

    **Returns:** what `inversion.compare` returns, and pairs to draw.
    """
    product = {"shot_number": answers["shot"], "rh98": answers["rh"][:, 98]}
    product |= {name: answers[name] for name in ("elev_lowestmode", "pai")}
    names = {name: reference for name, (reference, _) in COMPARED.items()}
    agreement = inversion.compare(columns_of(rows), product, names, classes="quality")
    pairs = {
        COMPARED[name][1]: (agreement.pairs[name].reference, agreement.pairs[name].estimate) for name in DRAWN
    }
    return agreement, pairs


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
        rows, pictures = fit_shots(shots, stem.with_name(f"{stem.name}.zarr"), progress)
    tables = write_tables(rows, stem, UNITS)
    agreement, pairs = None, {}
    if options.answers is not None and pictures:
        with np.load(options.answers) as answers:
            agreement, pairs = compare([row for row in rows if "ground" in row], dict(answers))
        print(agreement)
    print(", ".join(f"{sum(r['quality'] == q for r in rows)} {q}" for q in QUALITIES))
    if pictures:
        draw_page(pictures, pairs, picture)
    print("written:", *tables, *([picture] if pictures else []))
    return rows, agreement


if __name__ == "__main__":
    main()
    sys.exit(0)
