"""What the scripts share: the command line, rows of differences, the record, and pictures of differences."""

import argparse
import datetime
import importlib.metadata
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

EXAMPLES = Path(__file__).resolve().parents[1]
# Tools of the benchmarks and of the fits of recorded shots serve here too.
sys.path += [folder for folder in (str(EXAMPLES / "benchmarks"), str(EXAMPLES)) if folder not in sys.path]

from _common import machine, plt, print_table, save_figure, write_json  # noqa: E402
from tqdm import tqdm  # noqa: E402

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1A1A1A")


def options(
    description: str | None, argv: Sequence[str] | None, *files: str, **defaults: float
) -> argparse.Namespace:
    """The command line: `files` that the user has, a number for each of `defaults`, `--out` and `--quiet`."""
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


def steps(given: argparse.Namespace, items: Sequence) -> Iterator:
    """The items, with a bar of progress where the standard error is a terminal."""
    yield from tqdm(items, disable=given.quiet or None, leave=False)


def row(
    what: str,
    against: str,
    case: str,
    here: float,
    there: float,
    *,
    stderr: float | None = None,
    bound: float | None = None,
    unit: str = "1",
    **more: float | str,
) -> dict:
    """One comparison: with the standard error of the difference, or with a bound that it must not exceed."""
    if (stderr is None) == (bound is None):
        raise ValueError("stderr and bound: admissible is one of them")
    error = stderr if bound is None else bound
    difference = float(here) - float(there)
    return {
        "what": what,
        "against": against,
        "case": case,
        "unit": unit,
        "here": float(here),
        "there": float(there),
        "difference": difference,
        "standard error" if bound is None else "bound": float(error),
        "over error": difference / float(error),
        **more,
    }


def error_of(one: Mapping) -> float:
    """The row's standard error, or its bound."""
    return one["standard error"] if "standard error" in one else one["bound"]


def by_what(rows: Sequence[dict]) -> dict[str, list[dict]]:
    """The rows in groups, in their order."""
    return {what: [r for r in rows if r["what"] == what] for what in dict.fromkeys(r["what"] for r in rows)}


def summary(rows: Sequence[dict]) -> list[dict]:
    """For each kind of comparison the row that is furthest off, in units of its error, and how all are."""
    found = []
    for group in by_what(rows).values():
        over = np.abs([r["over error"] for r in group])
        far = group[int(np.argmax(over))]
        within = float(np.mean(over <= (1 if "bound" in far else 2)))
        rms = float(np.sqrt(np.mean(over**2)))
        found.append({**far, "cases": len(group), "rms over error": rms, "within": within})
    return found


def draw_differences(ax, rows: Sequence[dict], at: str | None = None, **how) -> None:
    """Differences with bars of two standard errors, or between lines of their bounds.

    Drawn over the number `at` of the rows, or one beside the other with their cases named.
    """
    x = np.arange(len(rows)) if at is None else np.array([r[at] for r in rows])
    off, error = np.array([r["difference"] for r in rows]), np.array([error_of(r) for r in rows])
    ax.axhline(0.0, color="0.6", linewidth=0.8)
    if "bound" in rows[0]:
        for side in (-error, error):
            ax.plot(x, side, color="0.6", linestyle="--", linewidth=0.8)
        ax.plot(x, off, "o", **{"markersize": 3, **how})
    else:
        ax.errorbar(x, off, 2.0 * error, fmt="o", **{"markersize": 3, "linewidth": 0.8, **how})
    if at is None:
        ax.set_xticks(x, [r["case"] for r in rows], rotation=40, ha="right", fontsize=7)


def finish(
    given: argparse.Namespace,
    name: str,
    rows: Sequence[dict],
    *,
    title: str,
    seen: str,
    unchecked: str,
    draw: Callable,
    size: tuple[float, float] = (8.0, 4.0),
    packages: Sequence[str] = (),
    of_others: bool = False,
    **notes,
) -> dict:
    """Write `NAME.json` and `NAME.png` and print what was found.

    `seen` are two lines on what the picture shows; `unchecked` is what the reference says nothing about. Of
    data `of_others` only the summary is written, for the rows hold their values.
    **Returns:** the record, with all rows.
    """
    record = {
        "title": title,
        "script": name,
        "seen": " ".join(seen.split()),
        "unchecked": " ".join(unchecked.split()),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": machine(),
        "versions": {n: importlib.metadata.version(n) for n in ("jaxlidar", "numpy", *packages)},
        **notes,
        "summary": summary(rows),
    }
    complete = record | {"rows": list(rows)}
    given.out.mkdir(parents=True, exist_ok=True)
    write_json(given.out / f"{name}.json", record if of_others else complete)
    figure = plt.figure(figsize=size, layout="constrained")
    draw(figure)
    save_figure(figure, given.out / f"{name}.png")
    if not given.quiet:
        head = (
            "what",
            "cases",
            "worst case",
            "here",
            "there",
            "difference",
            "error",
            "rms over it",
            "within",
        )
        lines = []
        for r in record["summary"]:
            found = (r["here"], r["there"], r["difference"], error_of(r), r["rms over error"], r["within"])
            lines.append((r["what"], r["cases"], r["case"], *found))
        print_table(head, lines)
        print("written:", given.out / f"{name}.json", given.out / f"{name}.png")
    return complete
