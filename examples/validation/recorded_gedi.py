"""Recorded GEDI shots against the level 2 products' answers for them.

    python examples/validation/recorded_gedi.py L1B ANSWERS [--out figures] [--shots 60]

L1B is a file of level 1B (HDF5); ANSWERS an .npz with the products' `shot` (numbers), `elev_lowestmode`,
`elev_highest`, `rh` (shots, 101), and `pai`. Compared are the metrics by the product's own rules
(`inversion.gedi_metrics`), the ground by the matched pulse (`inversion.find_ground`), which is another
method, and the ground that a fitted simulation has (`inversion.gedi_table(fit=True)`, good fits). The table's
closed forms and fits are compared with the products in the text."""

import sys

import numpy as np
from _validation import COLOURS, by_quantity, comparison, finish, options
from scipy import stats

import inversion
from inversion.metrics.gedi import pulse_samples
from jaxlidar.io import read_gedi_l1b

# A bin of the record, m. The product's metrics may round to it.
BIN = 0.15
LEVELS = (25, 50, 75, 98, 100)


# Columns of closed forms and of fits begin with these.
PREFIXES = {"closed forms": "", "fits": "fit_"}


def agreement_of(table, products, prefix):
    """Numbers of how well ground and plant area of good shots agree with the products, and of their ranks."""
    is_good = table[f"{prefix}quality"] == "good"
    numbers = {"good": int(is_good.sum())}
    quantities = {"ground": "elev_lowestmode", "pai": "pai", "canopy_top": "elev_highest"}
    for name, product in quantities.items():
        # Closed forms have no top of their own: that of the product's rules has no error.
        if f"{prefix}{name}_stderr" not in table:
            continue
        estimate, stderr = table[f"{prefix}{name}"], table[f"{prefix}{name}_stderr"]
        difference = (estimate - products[product])[is_good]
        numbers[name] = {
            "median difference": float(np.median(difference)),
            "median absolute difference": float(np.median(np.abs(difference))),
            "nine in ten below": float(np.quantile(np.abs(difference), 0.9)),
            "within two standard errors": float(np.mean(np.abs(difference) <= 2.0 * stderr[is_good])),
            "rank correlation": float(stats.spearmanr(estimate[is_good], products[product][is_good])[0]),
        }
    return numbers


def sentences_of(name, numbers):
    """Say the numbers of `agreement_of`."""
    ground, area = numbers["ground"], numbers["pai"]
    held = [f"{100 * a['within two standard errors']:.0f} %" for a in (ground, area)]
    text = (
        f"Of the {name}, {numbers['good']} are rated good: their ground differs from the product's by "
        f"{ground['median difference']:+.2f} m in the median, by less than "
        f"{ground['nine in ten below']:.2f} m in nine of ten; plant area by "
        f"{area['median absolute difference']:.2f} in the median, with a rank correlation of "
        f"{area['rank correlation']:.2f}; two standard errors hold {held[0]} and {held[1]}."
    )
    if "canopy_top" in numbers:
        top = numbers["canopy_top"]
        text += (
            f" Their top differs from the highest return by {top['median difference']:+.2f} m in the median, "
            f"by less than {top['nine in ten below']:.2f} m in nine of ten; two standard errors hold "
            f"{100 * top['within two standard errors']:.0f} %."
        )
    return text


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
    table = inversion.gedi_table(shots, fit=True)
    # The fit knows nothing of relief: its own errors are too small, and the distance from the matched mode
    # tells by how much.
    stderr = np.hypot(table["fit_ground_stderr"], table["fit_ground"] - table["ground"])
    for i in np.flatnonzero(table["fit_quality"] == "good"):
        add("ground, fitted simulation", i, table["fit_ground"][i], lowest[i], stderr=stderr[i])
    agreement = {name: agreement_of(table, products, prefix) for name, prefix in PREFIXES.items()}

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
        caption=" ".join(
            (
                "Left, differences of elevations and relative heights; the product's own rules give its",
                "numbers to within a bin of 0.15 m. Right, the ground that simulations fitted to the records",
                "have; its errors include the distance from the matched mode, those in the text do not.",
                *(sentences_of(name, numbers) for name, numbers in agreement.items()),
            )
        ),
        unchecked="""The product's ground is itself read from the waveform, no survey. Plant area has no
        independent truth here. One orbit over a savanna.""",
        draw=draw,
        of_others=True,
        size=(11.0, 5.0),
        shots=len(shots),
        agreement=agreement,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
