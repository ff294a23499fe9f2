"""Shared by the scripts: the command line, rows of comparisons, the record, its table, and figures."""

import argparse
import datetime
import importlib.metadata
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

EXAMPLES = Path(__file__).resolve().parents[1]
# The scripts also use modules of the benchmarks, of the fits of recorded shots, and of the paper.
FOLDERS = [str(folder) for folder in (EXAMPLES / "benchmarks", EXAMPLES, EXAMPLES / "paper")]
sys.path += [folder for folder in FOLDERS if folder not in sys.path]

from _common import machine, number, page_of, percent, plt, save_figure, table, write_json  # noqa: E402, F401
from tqdm import tqdm  # noqa: E402

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1A1A1A")


def options(
    description: str | None, argv: Sequence[str] | None, *files: str, **defaults: float
) -> argparse.Namespace:
    """Parse the command line: paths for `files`, a number for each of `defaults`, `--out` and `--quiet`."""
    parser = argparse.ArgumentParser(description=(description or "").split("\n")[0])
    for name in files:
        several = name.endswith("...")
        parser.add_argument(name.rstrip("."), type=Path, nargs="+" if several else None)
    for name, value in defaults.items():
        text = "default: %(default)s"
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value, help=text)
    parser.add_argument("--out", default=Path("figures"), type=Path, help="folder of JSON and picture")
    parser.add_argument("--quiet", action="store_true", help="show nothing")
    return parser.parse_args(argv)


def with_progress(arguments: argparse.Namespace, items: Sequence) -> Iterator:
    """Yield the items, with a progress bar if the standard error is a terminal."""
    yield from tqdm(items, disable=arguments.quiet or None, leave=False)


def comparison(
    quantity: str,
    reference_name: str,
    case: str,
    value: float,
    reference: float,
    *,
    stderr: float | None = None,
    bound: float | None = None,
    unit: str = "1",
    **details: float | str,
) -> dict:
    """Return one comparison, with the standard error of the difference or a bound on it."""
    if (stderr is None) == (bound is None):
        raise ValueError("stderr and bound: admissible is one of them")
    error = stderr if bound is None else bound
    difference = float(value) - float(reference)
    return {
        "what": quantity,
        "against": reference_name,
        "case": case,
        "unit": unit,
        "here": float(value),
        "there": float(reference),
        "difference": difference,
        "standard error" if bound is None else "bound": float(error),
        "over error": difference / float(error),
        **details,
    }


def error_of(comparison_row: Mapping) -> float:
    """Return the standard error of a comparison, or its bound."""
    return comparison_row["standard error"] if "standard error" in comparison_row else comparison_row["bound"]


def by_quantity(rows: Sequence[dict]) -> dict[str, list[dict]]:
    """Return the rows grouped by their quantity, in their order."""
    return {
        quantity: [r for r in rows if r["what"] == quantity]
        for quantity in dict.fromkeys(r["what"] for r in rows)
    }


def summary(rows: Sequence[dict]) -> list[dict]:
    """Return for each quantity the row with the largest difference over its error, and statistics."""
    worst = []
    for group in by_quantity(rows).values():
        ratios = np.abs([r["over error"] for r in group])
        worst_row = group[int(np.argmax(ratios))]
        within = float(np.mean(ratios <= (1 if "bound" in worst_row else 2)))
        rms = float(np.sqrt(np.mean(ratios**2)))
        worst.append({**worst_row, "cases": len(group), "rms over error": rms, "within": within})
    return worst


# What the table says of a row of the summary.
SUMMARY_COLUMNS = {
    "quantity": "what",
    "reference": "against",
    "cases": "cases",
    "worst case": "case",
    "jaxlidar": lambda r: number(r["here"], 4),
    "reference value": lambda r: number(r["there"], 4) + ("" if r["unit"] == "1" else f" {r['unit']}"),
    "difference": "difference",
    "its error": lambda r: f"{'≤' if 'bound' in r else '±'} {number(error_of(r))}",
    "root mean square of all over their errors": "rms over error",
    "within two standard errors, or the bound": lambda r: percent(r["within"], 3),
}


def draw_differences(ax, rows: Sequence[dict], abscissa: str | None = None, **style) -> None:
    """Draw differences with bars of two standard errors, or between lines of their bounds.

    The abscissa is the value of that name in the rows; by default the rows stand side by side with their
    cases.
    """
    x = np.arange(len(rows)) if abscissa is None else np.array([r[abscissa] for r in rows])
    differences, error = np.array([r["difference"] for r in rows]), np.array([error_of(r) for r in rows])
    ax.axhline(0.0, color="0.6", linewidth=0.8)
    if "bound" in rows[0]:
        for side in (-error, error):
            ax.plot(x, side, color="0.6", linestyle="--", linewidth=0.8)
        ax.plot(x, differences, "o", **{"markersize": 3, **style})
    else:
        ax.errorbar(x, differences, 2.0 * error, fmt="o", **{"markersize": 3, "linewidth": 0.8, **style})
    if abscissa is None:
        ax.set_xticks(x, [r["case"] for r in rows], rotation=40, ha="right", fontsize=7)


def finish(
    arguments: argparse.Namespace,
    name: str,
    rows: Sequence[dict],
    *,
    title: str,
    caption: str,
    unchecked: str,
    draw: Callable,
    size: tuple[float, float] = (8.0, 4.0),
    packages: Sequence[str] = (),
    of_others: bool = False,
    **notes,
) -> dict:
    """Write `NAME.json` and `NAME.png`, print the summary, and return the record with all rows.

    - `caption`: two lines on the figure. - `unchecked`: properties that the reference cannot check.
    - `of_others`: the data belong to others, so that only the summary is written, not the rows with values.
    """
    record = {
        "title": title,
        "script": name,
        "seen": " ".join(caption.split()),
        "unchecked": " ".join(unchecked.split()),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": machine(),
        "versions": {n: importlib.metadata.version(n) for n in ("jaxlidar", "numpy", *packages)},
        **notes,
        "summary": summary(rows),
    }
    complete = record | {"rows": list(rows)}
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out / f"{name}.json", record if of_others else complete)
    figure = plt.figure(figsize=size, layout="constrained")
    draw(figure)
    save_figure(figure, arguments.out / f"{name}.png")
    if not arguments.quiet:
        print(table(record["summary"], SUMMARY_COLUMNS))
        print("written:", arguments.out / f"{name}.json", arguments.out / f"{name}.png")
    return complete
