"""Measured leaves: PROSPECT fitted to their spectra, and the chemistry that it gives.

    python examples/validation/leaf_databases.py PATH... [--out figures]

Each PATH is an .npz of leaves as of the ANGERS or LOPEX database: `wavelength_nm`, `R` and `T` (leaves,
wavelengths), and `leaf_chltot_per_area`, `leaf_cartot_per_area` (ug/cm2), `leaf_water_thickness` (cm) and
`leaf_mass_per_area` (g/cm2). Traits are found from the bands that the literature recommends
(`invert_leaves(domain="recommended")`), with the standard errors that the fit states.
"""

import sys

import numpy as np
from _validation import COLOURS, comparison, finish, options, with_progress

from inversion import invert_leaves

CHEMISTRY = {
    "Cab": ("leaf_chltot_per_area", "ug/cm2"),
    "Car": ("leaf_cartot_per_area", "ug/cm2"),
    "Cw": ("leaf_water_thickness", "cm"),
    "Cm": ("leaf_mass_per_area", "g/cm2"),
}


def main(argv=None):
    arguments = options(__doc__, argv, "paths...")
    rows, pictures = [], []
    for path in with_progress(arguments, arguments.paths):
        with np.load(path) as archive:
            record = dict(archive)
        name = path.stem
        fit = invert_leaves(record["wavelength_nm"], record["R"], record["T"], domain="recommended")
        for trait, (column, unit) in CHEMISTRY.items():
            fitted, error = np.asarray(fit.traits[trait], float), np.asarray(fit.stderr[trait], float)
            measured_leaves = np.flatnonzero(np.isfinite(record[column]) & np.isfinite(error))
            for i in measured_leaves:
                values, what = (fitted[i], record[column][i]), f"{trait} of leaves, {name}"
                rows.append(comparison(what, "chemistry", f"leaf {i}", *values, stderr=error[i], unit=unit))
            pictures.append((name, trait, unit, rows[len(rows) - measured_leaves.size :]))

    def draw(figure):
        axes = figure.subplots(len(arguments.paths), len(CHEMISTRY), squeeze=False)
        for ax, (name, trait, unit, group) in zip(axes.flat, pictures):
            chemistry, differences, error = (
                np.array([r[k] for r in group]) for k in ("there", "difference", "standard error")
            )
            ax.errorbar(chemistry, differences, 2 * error, fmt="o", ms=2, lw=0.5, color=COLOURS[0])
            ax.axhline(0.0, color="0.6", lw=0.8)
            within = np.mean(np.abs(differences) < 2 * error)
            ax.set_title(f"{name}: {trait}, {100 * within:.0f} % within 2 s.e.", fontsize=8)
            ax.set(xlabel=f"measured ({unit})")
        for ax in axes[:, 0]:
            ax.set_ylabel("fitted less measured")

    return finish(
        arguments,
        "leaf_databases",
        rows,
        title="Measured leaves",
        caption="""Fitted less measured chemistry, leaf by leaf, with bars of two standard errors as the fit
        states them: they should reach zero for 95 % of the leaves. Where fewer do, PROSPECT is off by
        more than spectra alone can tell.""",
        unchecked="""Chemistry has errors of its own, which are not known and not in the bars. Coefficients of
        PROSPECT-D were calibrated with such leaves, some of these among them.""",
        draw=draw,
        of_others=True,
        size=(13.0, 3.2 * len(arguments.paths)),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
