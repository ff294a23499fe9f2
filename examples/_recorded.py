"""Common to the fits of recorded waveforms: tables of results, and a page of pictures."""

import contextlib
import csv

import matplotlib
import numpy as np
from tqdm import tqdm

from jaxlidar.io import atomic_write

matplotlib.use("Agg")
import matplotlib.pyplot as plt

QUALITIES = ("good", "doubtful", "bad")


def columns_of_canopy(canopy, fits, i, verdict):
    """Columns of fit `i` of a batch with a layered canopy: plant area, shares of the priors, the verdict."""
    estimates = canopy.estimates(fits, i)
    return {
        "pai_layers": estimates.pai,
        "clearance": canopy.clearance,
        "density": estimates.density,
        "density_stderr": estimates.density_stderr,
        **quality_of(fits, i, verdict),
    }


def quality_of(fits, i, verdict):
    """Columns of fit `i` of a batch for any scene: fractions of the priors, and the verdict."""
    return {
        **{f"prior_share_{n.replace(' ', '_')}": np.mean(s[i]) for n, s in fits.prior_share.items()},
        "reduced_chi2": float(fits.reduced_chi2[i]),
        "steps": int(fits.steps[i]),
        "status": fits.status[i],
        "quality": verdict.quality,
        "reasons": "; ".join(verdict.reasons),
    }


@contextlib.contextmanager
def progress_bar():
    """Provide a function that shows how many fits have ended; silent if the standard error is no terminal."""
    with tqdm(unit=" fits", disable=None, leave=False) as bar:

        def show(progress):
            bar.total, bar.n = progress.total, progress.done
            bar.set_postfix_str(f"{progress.converged} converged")

        yield show


def bad_row(reason, **columns):
    """Row of a shot that was not fitted, with its columns that do not come from a fit."""
    return {**columns, "quality": "bad", "reasons": str(reason)}


def columns_of(rows):
    """Values of rows by name, as arrays with the shots first; NaN or "" for rows without the name."""
    columns = {}
    # Rows differ in their names; columns come in the order in which they first occur.
    for name in dict.fromkeys(name for row in rows for name in row):
        sample = next(np.asarray(row[name]) for row in rows if name in row)
        is_text = sample.dtype.kind == "U"
        empty = "" if is_text else np.full(sample.shape, np.nan)
        values = [row.get(name, empty) for row in rows]
        columns[name] = np.array(values, dtype=object if is_text else None)
    return columns


def write_tables(rows, stem, units):
    """Write one row a shot as CSV, and as netCDF with the `units` of the columns.

    **Returns:** the two paths.
    """
    import xarray

    columns = columns_of(rows)
    # A vector becomes several columns of the CSV file, with numbers.
    flat = {}
    for name, values in columns.items():
        elements = values.reshape(len(rows), -1).T
        flat |= {name if values.ndim == 1 else f"{name}_{i}": e for i, e in enumerate(elements)}
    table, dataset = (stem.with_name(f"{stem.name}.{kind}") for kind in ("csv", "nc"))
    with atomic_write(table) as draft, draft.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(flat)
        writer.writerows(zip(*flat.values()))
    variables = {
        name: (
            ("shot", *(f"{name}_number" for _ in values.shape[1:])),
            values,
            {"units": units[name]} if name in units else {},
        )
        for name, values in columns.items()
    }
    with atomic_write(dataset) as draft:
        xarray.Dataset(variables).to_netcdf(draft, engine="h5netcdf")
    return table, dataset


def draw_shot(axes, picture):
    """Draw record and fit against elevation, with lines at the fitted heights."""
    axes.plot(picture["signal"], picture["elevation"], ".", color="0.6", markersize=3, label="recorded")
    axes.plot(picture["fitted"], picture["elevation"], color="black", linewidth=1.2, label="fit")
    styles = {"ground": ("#d55e00", "-"), "canopy top": ("#009e73", "--"), "reference": ("#0072b2", ":")}
    for name, (color, style) in styles.items():
        if name in picture:
            axes.axhline(picture[name], color=color, linestyle=style, linewidth=1.0, label=name)
    ground = picture["ground"]
    axes.set_ylim(ground - 6.0, max(ground + 12.0, picture.get("canopy top", ground) + 4.0))
    axes.set_xlabel(f"signal ({picture['unit']})", fontsize=8)
    axes.set_title(picture["title"], fontsize=9)


def draw_page(pictures, pairs, path):
    """Draw the best, middle and worst fits, by reduced chi-squared, and scatter plots.

    `pictures` are in any order, with "chi2"; `pairs` maps a quantity to two arrays, the reference's first.
    """
    ordered = sorted(pictures, key=lambda p: p["chi2"])
    middle = max(len(ordered) // 2 - 1, 0)
    groups = {"best": ordered[:3], "median": ordered[middle : middle + 3], "worst": ordered[-3:]}
    if len(ordered) <= 3:
        groups = {"all": ordered}
    rows = len(groups) + bool(pairs)
    figure, grid = plt.subplots(rows, 3, figsize=(9, 3.2 * rows), layout="constrained", squeeze=False)
    for row, (name, group) in zip(grid, groups.items()):
        for axes, picture in zip(row, group):
            draw_shot(axes, picture)
        for axes in row[len(group) :]:
            axes.set_axis_off()
        row[0].set_ylabel(f"{name} fits\nelevation (m)")
    # Ground alone has no canopy top: not every axes has all lines.
    lines = {name: line for axes in grid.flat for line, name in zip(*axes.get_legend_handles_labels())}
    for axes, (name, (reference, fitted)) in zip(grid[-1] if pairs else (), pairs.items()):
        values = np.concatenate([reference, fitted])
        ends = np.nanmin(values), np.nanmax(values)
        axes.plot(ends, ends, color="0.7", linewidth=0.8)
        axes.plot(reference, fitted, "o", color="#009e73", markersize=3)
        axes.set(xlabel=f"{name}, reference", ylabel=f"{name}, fit")
    for axes in grid[-1][len(pairs) :] if pairs else ():
        axes.set_axis_off()
    figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=5, frameon=False)
    with atomic_write(path) as draft:
        figure.savefig(draft, format="png", dpi=110)
    plt.close(figure)
