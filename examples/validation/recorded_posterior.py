"""A learned posterior of GEDI shots against simulated truth and the level 2 products.

    python examples/validation/recorded_posterior.py L1B ANSWERS [--out figures]

L1B is a file of level 1B (HDF5); ANSWERS an .npz with the products' `shot` (numbers), `elev_lowestmode`, `rh`
(shots, 101), `cover` and `pai`. The posterior is that of `examples/notebooks/neural_posterior.ipynb`, whose
cells this script runs with the pulses of L1B: a network trained on simulated records. Its intervals of 90 %
are compared with the truth of simulated scenes that it has not seen, and its medians with the products of
recorded shots, beside closed forms (`inversion.gedi_metrics`, `inversion.gedi_table`) and fits
(`gedi_table(fit=True)`). Training takes some minutes, and the fits two."""

import contextlib
import io
import json
import os
import sys
from statistics import NormalDist
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from _validation import COLOURS, EXAMPLES, comparison, finish, options
from scipy import stats

import inversion
from jaxlidar.io import read_gedi_l1b

NOTEBOOK = EXAMPLES / "notebooks" / "neural_posterior.ipynb"
# Quantities of the posterior, in its order, with their units and columns of closed forms and fits.
QUANTITIES = {
    "ground": ("m", "ground", "fit_ground"),
    "RH98": ("m", "rh_98", None),
    "cover": ("1", "cover", None),
    "plant area": ("1", "pai", "fit_pai"),
}
LEVEL = 0.9
# Standard deviations on either side of the median to which an interval of 90 % of a normal reaches.
SIGMAS = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)


def run_notebook(l1b):
    """Run the code of the notebook with the pulses of a file. **Returns:** its variables."""
    os.environ["GEDI_L1B"] = str(l1b)
    variables: dict[str, Any] = {"__name__": "__main__"}
    # This script writes the numbers of the notebook's output to its record.
    with contextlib.redirect_stdout(io.StringIO()):
        for cell in json.loads(NOTEBOOK.read_text())["cells"]:
            if cell["cell_type"] == "code":
                exec("".join(cell["source"]), variables)
    plt.close("all")
    return variables


def agreement_of(estimate, reference):
    """Numbers of how well estimates agree with the products."""
    valid = np.isfinite(estimate)
    difference = np.abs(estimate - reference)[valid]
    return {
        "median difference": float(np.median((estimate - reference)[valid])),
        "nine in ten below": float(np.quantile(difference, 0.9)),
        "rank correlation": float(
            np.corrcoef(*(stats.rankdata(x[valid]) for x in (estimate, reference)))[0, 1]
        ),
    }


def sentence_of(quantity, numbers):
    """Say how well the posterior and the other methods agree with the product in one quantity."""
    posterior = numbers["posterior"]
    others = [
        f"{values['median difference']:+.2f} ({values['rank correlation']:.2f}) of {method}"
        for method, values in numbers.items()
        if method != "posterior"
    ]
    return (
        f"{quantity[0].upper()}{quantity[1:]}: {posterior['median difference']:+.2f} in the median, by less "
        f"than {posterior['nine in ten below']:.2f} in nine of ten, with a rank correlation of "
        f"{posterior['rank correlation']:.2f}; {100 * posterior['in the interval']:.0f} % of the products "
        f"lie in the interval; beside {' and '.join(others)}."
    )


def main(argv=None):
    arguments = options(__doc__, argv, "l1b", "answers")
    with np.load(arguments.answers) as archive:
        products = {name: archive[name] for name in ("shot", "elev_lowestmode", "rh", "cover", "pai")}
    notebook = run_notebook(arguments.l1b)
    shots = read_gedi_l1b(arguments.l1b, products["shot"])
    draws, largest_input = notebook["posterior_of"](shots)
    low, median, high = np.quantile(draws, (0.5 - 0.5 * LEVEL, 0.5, 0.5 + 0.5 * LEVEL), axis=0)
    table = inversion.gedi_table(shots, fit=True)
    is_good_fit = table["fit_quality"] == "good"
    references = (products["elev_lowestmode"], products["rh"][:, 98], products["cover"], products["pai"])
    n_tests = len(notebook["truth"])
    rows: list[dict] = []
    agreement: dict[str, dict] = {}
    simulated: dict[str, dict] = {}
    for i, (quantity, (unit, column, fit_column)) in enumerate(QUANTITIES.items()):
        coverage = float(notebook["coverage"][i])
        binomial = np.sqrt(LEVEL * (1.0 - LEVEL) / n_tests)
        case = f"{n_tests} simulated records"
        rows.append(
            comparison(f"90 % interval of {quantity}", "truth", case, coverage, LEVEL, stderr=binomial)
        )
        simulated[quantity] = {
            "coverage": coverage,
            **{
                f"{method} error": [float(e) for e in np.nanquantile(error[:, i], (0.5, 0.9))]
                for method, error in notebook["errors"].items()
            },
        }
        closed_form = table["rh"][:, 98] if column == "rh_98" else table[column]
        is_inside = (references[i] >= low[:, i]) & (references[i] <= high[:, i])
        agreement[quantity] = {
            "posterior": agreement_of(median[:, i], references[i])
            | {"in the interval": float(is_inside.mean())},
            "closed forms": agreement_of(closed_form, references[i]),
        }
        if fit_column:
            fitted = np.where(is_good_fit, table[fit_column], np.nan)
            agreement[quantity]["fits"] = agreement_of(fitted, references[i])
        for shot, value, reference, width in zip(
            products["shot"], median[:, i], references[i], high[:, i] - low[:, i]
        ):
            rows.append(
                comparison(
                    f"{quantity}, median of the posterior",
                    "GEDI level 2",
                    f"shot {shot}",
                    value,
                    reference,
                    stderr=0.5 * width / SIGMAS,
                    unit=unit,
                )
            )

    def draw(figure):
        axes = figure.subplots(1, 4)
        for i, (ax, quantity) in enumerate(zip(axes, QUANTITIES)):
            origin = references[0] if i == 0 else np.zeros(len(shots))
            x = np.maximum(references[3], 1e-2) if i == 0 else references[i]
            error = np.stack([median[:, i] - low[:, i], high[:, i] - median[:, i]])
            ax.errorbar(x, median[:, i] - origin, error, fmt="o", ms=3, lw=0.6, color=COLOURS[0])
            ends = np.array([x.min(), x.max()])
            ax.plot(ends, 0.0 * ends if i == 0 else ends, color="0.4", lw=0.8)
            ax.set(xlabel=f"{quantity}, product", ylabel=f"{quantity}, posterior", title=quantity)
        axes[0].set(
            xlabel="plant area, product",
            ylabel="ground less the product's (m)",
            xscale="log",
            title="ground (m)",
        )
        axes[1].set_title("RH98 (m)")

    accuracy = "; ".join(
        f"{quantity} {100 * numbers['coverage']:.1f} %" for quantity, numbers in simulated.items()
    )
    sharpness = ", ".join(
        f"{quantity} {numbers['posterior error'][1]:.2f} against {numbers['closed forms error'][1]:.2f}"
        for quantity, numbers in simulated.items()
    )
    return finish(
        arguments,
        "recorded_posterior",
        rows,
        title="A learned posterior of GEDI shots against simulated truth and the products",
        caption=" ".join(
            (
                f"Of {n_tests} simulated records with the file's pulses, intervals of 90 % hold the truth:",
                f"{accuracy}. Nine in ten errors of the medians are below these, against closed forms:",
                f"{sharpness}. The picture, and the rest, are {len(shots)} recorded shots, with intervals of",
                "90 %, against the products.",
                *(sentence_of(quantity, numbers) for quantity, numbers in agreement.items()),
                "Where the ground's echo has a shoulder below its peak, the posterior counts low plants over",
                "lower ground among its explanations; the product takes all of it for ground.",
            )
        ),
        unchecked="""The products are themselves read from the waveform, with fixed reflectances: they are no
        truth. The posterior is that of its prior and of light scattered once. Relief, bandwidth and low
        plants of the prior were widened with these shots in view: they are no blind test of it.""",
        draw=draw,
        of_others=True,
        size=(12.0, 3.6),
        packages=("flowjax",),
        shots=len(shots),
        largest_input=[float(q) for q in np.quantile(largest_input, (0.5, 1.0))],
        simulated=simulated,
        agreement=agreement,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
