"""Measured leaves: PROSPECT fitted to their spectra, and the chemistry that it gives.

    python examples/validation/leaf_databases.py PATH... [--out figures]

Each PATH is an .npz of leaves as of the ANGERS, LOPEX or NASA FFT database: `wavelength_nm`, `R` and `T`
(leaves, wavelengths), `leaf_chltot_per_area`, `leaf_cartot_per_area` (ug/cm2), `leaf_water_thickness` (cm)
and `leaf_mass_per_area` (g/cm2), and, where there are needles, `needle`, True for them. Traits are found from
the bands that the literature recommends (`invert_leaves(domain="recommended", needle=...)`), with standard
errors that the fit states.
"""

import itertools
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
    rows, pictures, kinds = [], {}, []
    for path in with_progress(arguments, arguments.paths):
        with np.load(path) as archive:
            record = dict(archive)
        is_needle = np.asarray(record.get("needle", np.zeros(len(record["R"]), bool)))
        spectra = record["wavelength_nm"], record["R"], record["T"]
        fit = invert_leaves(*spectra, domain="recommended", needle=is_needle)
        for kind, is_kind in (("", ~is_needle), (", needles", is_needle)):
            if not np.any(is_kind):
                continue
            name = path.stem + kind
            kinds.append(name)
            for trait, (column, unit) in CHEMISTRY.items():
                fitted, error = np.asarray(fit.traits[trait], float), np.asarray(fit.stderr[trait], float)
                is_measured = is_kind & np.isfinite(record[column]) & np.isfinite(error)
                for i in np.flatnonzero(is_measured):
                    values, what = (fitted[i], record[column][i]), f"{trait} of leaves, {name}"
                    rows.append(
                        comparison(what, "chemistry", f"leaf {i}", *values, stderr=error[i], unit=unit)
                    )
                pictures[name, trait] = rows[len(rows) - np.count_nonzero(is_measured) :]

    def draw(figure):
        axes = figure.subplots(len(kinds), len(CHEMISTRY), squeeze=False)
        for ax, (name, trait) in zip(axes.flat, itertools.product(kinds, CHEMISTRY)):
            if not (group := pictures[name, trait]):
                # The database has no such measurement.
                ax.set_axis_off()
                continue
            chemistry, differences, error = (
                np.array([r[k] for r in group]) for k in ("there", "difference", "standard error")
            )
            ax.errorbar(chemistry, differences, 2 * error, fmt="o", ms=2, lw=0.5, color=COLOURS[0])
            ax.axhline(0.0, color="0.6", lw=0.8)
            within = np.mean(np.abs(differences) < 2 * error)
            is_present = chemistry > 0
            median = 100 * np.median(differences[is_present] / chemistry[is_present])
            title = f"{name}:\n{trait}, {100 * within:.0f} % within 2 s.e., median {median:+.1f} %"
            ax.set_title(title, fontsize=8)
            ax.locator_params(axis="x", nbins=4)
            ax.set(xlabel=f"measured ({CHEMISTRY[trait][1]})")
        for row in axes:
            next(ax for ax in row if ax.axison).set_ylabel("fitted less measured")

    return finish(
        arguments,
        "leaf_databases",
        rows,
        title="Measured leaves",
        caption="""Fitted less measured chemistry, leaf by leaf, with bars of two standard errors as the
        fit states them: they should reach zero for 95 % of the leaves. Medians are relative. Errors of
        Cab and Car contain 12 and 14 % for what spectra do not tell. Cw and Cm of needles come from a
        domain of their own.""",
        unchecked="""Chemistry has errors of its own, which are not known and not in the bars. Coefficients of
        PROSPECT-D were calibrated with such leaves, some of these among them.""",
        draw=draw,
        of_others=True,
        size=(13.0, 3.2 * len(kinds)),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
