"""Recorded GEDI shots against the level 2 products' answers for them.

    python examples/validation/recorded_gedi.py L1B ANSWERS [--out figures] [--shots 60]

L1B is a file of level 1B (HDF5); ANSWERS an .npz with the products' `shot` (numbers), `elev_lowestmode`,
`elev_highest`, `rh` (shots, 101), and `pai`. Compared are the metrics by the product's own rules
(`inversion.gedi_metrics`), the ground by the matched pulse (`inversion.find_ground`), which is another
method, and the ground that a fitted simulation has, with its standard error (`examples/fit_gedi.py`, good
fits)."""

import sys

import numpy as np
from _validation import COLOURS, by_quantity, comparison, finish, options
from fit_gedi import fit_shots

import inversion
from inversion.metrics.gedi import pulse_samples
from jaxlidar.io import read_gedi_l1b

# A bin of the record, m. The product's metrics may round to it.
BIN = 0.15
LEVELS = (25, 50, 75, 98, 100)


def main(argv=None):
    arguments = options(__doc__, argv, "l1b", "answers", shots=60)
    with np.load(arguments.answers) as archive:
        products = {name: archive[name][: arguments.shots] for name in archive.files}
    shots = read_gedi_l1b(arguments.l1b, products["shot"])
    rows = []

    def add(what, i, value, reference, **error):
        rows.append(
            comparison(
                what, "GEDI level 2", f"shot {products['shot'][i]}", value, reference, unit="m", **error
            )
        )

    metrics, lowest = inversion.gedi_metrics(shots), products["elev_lowestmode"]
    for i, shot in enumerate(shots):
        add("lowest mode, product's rules", i, metrics.elev_lowestmode[i], lowest[i], bound=BIN)
        add(
            "highest return, product's rules",
            i,
            metrics.elev_highestreturn[i],
            products["elev_highest"][i],
            bound=BIN,
        )
        for level in LEVELS:
            value, reference = metrics.rh[i, level], products["rh"][i, level]
            add(f"RH{level}, product's rules", i, value, reference, bound=BIN)
        matched_ground = inversion.find_ground(
            shot.elevation, shot.signal, pulse=pulse_samples(shot), noise=shot.noise_std
        )
        add("ground, matched pulse", i, matched_ground, lowest[i], bound=2 * BIN)
    fits = fit_shots(shots)[0] if arguments.shots else []
    for i, fit in enumerate(fits):
        if fit["quality"] == "good":
            add("ground, fitted simulation", i, fit["ground"], lowest[i], stderr=fit["ground_stderr"])

    def draw(figure):
        box_axes, ground_axes = figure.subplots(1, 2, width_ratios=(1.3, 1))
        groups = by_quantity(rows)
        names = [w for w in groups if "fitted" not in w]
        box_axes.boxplot(
            [[r["difference"] for r in groups[w]] for w in names],
            whis=(0, 100),
            tick_labels=[w.replace(", ", ",\n") for w in names],
        )
        box_axes.tick_params(axis="x", rotation=60, labelsize=7)
        box_axes.axhline(0.0, color="0.6", lw=0.8)
        box_axes.set(ylabel="difference from the product (m)", title="whole range, quartiles and median")
        fitted = sorted(groups.get("ground, fitted simulation", []), key=lambda r: r["standard error"])
        error = [2 * r["standard error"] for r in fitted]
        ground_axes.errorbar(
            range(len(fitted)),
            [r["difference"] for r in fitted],
            error,
            fmt="o",
            ms=3,
            lw=0.8,
            color=COLOURS[1],
        )
        ground_axes.axhline(0.0, color="0.6", lw=0.8)
        ground_axes.set(
            title="ground of good fits, two standard errors", xlabel="shots, in order of their errors"
        )

    return finish(
        arguments,
        "recorded_gedi",
        rows,
        title="Recorded GEDI shots against the products",
        caption="""Left, differences of elevations and relative heights; the product's own rules give its
        numbers to within a bin of 0.15 m. Right, the ground that simulations fitted to the records have.""",
        unchecked="""The product's ground is itself read from the waveform, no survey. Plant area has no
        independent truth here. One orbit over a savanna.""",
        draw=draw,
        of_others=True,
        size=(11.0, 5.0),
        shots=len(shots),
        good_fits=sum(fit["quality"] == "good" for fit in fits),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
