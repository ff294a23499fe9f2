"""The commands `jaxlidar demo`, `jaxlidar retrieve` and `jaxlidar gedi`.

`jaxlidar` never imports this package: its command line finds the commands by the group of entry points
"jaxlidar.commands" in pyproject.toml.
"""

import math
import sys
import time
from pathlib import Path
from typing import Any

import click
import jax
import numpy as np

import jaxlidar as jl
from inversion import demo as demonstration
from inversion.fit.problem import Problem
from inversion.fit.retrieval import retrieve as fit_waveform
from inversion.fit.unknowns import Unknown
from inversion.metrics.gedi_table import gedi_table
from jaxlidar.cli.constants import INTERRUPTED, SUCCESS
from jaxlidar.cli.shared import ResultPath, save_figure
from jaxlidar.formats.tables import TABLE_FORMATS
from jaxlidar.results.store import remove_store, store_beside

# Seconds between lines of progress in a log file.
_LOG_SECONDS = 5.0


@click.command()
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default="jaxlidar-demo", help="Folder."
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Seed of photons and noise.")
@click.option(
    "--rtol",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.01,
    help="Relative accuracy of the waveform.",
)
@click.option("--quiet", is_flag=True, help="Show no progress, only the results.")
@click.option("--voxel-size", type=click.FloatRange(0, 1, min_open=True), default=0.25, hidden=True)
def demo(out: Path, seed: int, rtol: float, quiet: bool, voxel_size: float) -> None:
    """Simulate a tree's waveform, retrieve leaf, crown and ground from a noisy one, and draw both."""
    # click's ranges let NaN pass.
    if math.isnan(rtol):
        raise click.BadParameter("nan is not in the range 0<x<1.", param_hint="--rtol")
    # Before the work: a folder that cannot be written ends the command at once.
    out.mkdir(parents=True, exist_ok=True)
    start_time = time.perf_counter()
    log = demonstration.ProgressLog(None if quiet else sys.stderr)
    demonstration.run(out, seed=seed, rtol=rtol, voxel_size=voxel_size, log=log)
    click.echo(f"\n{time.perf_counter() - start_time:.0f} s")


def _parse_unknowns(ctx: Any, parameter: Any, texts: tuple[str, ...]) -> list[Unknown]:
    """Return the unknowns of texts PATH:LOW:HIGH."""
    unknowns = []
    for text in texts:
        # Paths hold no colon: the rest are the bounds.
        path, *bounds = text.split(":")
        try:
            low, high = map(float, bounds)
        except ValueError:
            raise click.BadParameter(f"{text!r} is not of the form PATH:LOW:HIGH") from None
        unknowns.append(Unknown(path, bounds=(low, high)))
    return unknowns


@click.command()
@click.argument("observed", type=ResultPath(exists=True), metavar="WAVE.nc")
@click.argument("start", type=click.Path(exists=True, dir_okay=False, path_type=Path), metavar="CASE.toml")
@click.option(
    "--unknown",
    "unknowns",
    multiple=True,
    required=True,
    callback=_parse_unknowns,
    metavar="PATH:LOW:HIGH",
    help="A quantity of the scene and its bounds; repeat for more.",
)
@click.option("--noise", type=click.FloatRange(0, min_open=True), help="Standard deviation of the samples.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Seed of the photons of the fit.")
@click.option("-o", "--out", type=ResultPath(), help="Write the result as netCDF, or as Zarr (.zarr).")
@click.option(
    "--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw the fit and its residuals."
)
@click.option("--quiet", is_flag=True, help="Show no progress.")
def retrieve(
    observed: Path,
    start: Path,
    unknowns: list[Unknown],
    noise: float | None,
    seed: int,
    out: Path | None,
    plot: Path | None,
    quiet: bool,
) -> int:
    """Retrieve quantities of a scene from a waveform that was saved as netCDF, starting from a case.

    Without --noise, noise is the waveform's own standard error. The exit status is 1 for a fit that has not
    converged.

    \b
    Example:
      jaxlidar retrieve hill.nc start.toml --unknown ground.height:-2:2 --noise 0.001 -o fit.nc --plot fit.png
    """
    wave, case = jl.open(observed), jl.io.read_case(start)
    if not isinstance(wave, jl.Waveform):
        raise click.UsageError(f"{observed} holds a {type(wave).__name__}, not a waveform")
    if case.scene is None:
        raise click.UsageError(f"{start} has no scene")
    # Standard errors are zero in bins that no photon reached: any above zero will do.
    sigma: Any = np.asarray(wave.stderr) if noise is None else noise
    if noise is None and not np.any(sigma > 0):
        raise click.UsageError(f"{observed} has no standard errors: give --noise")
    # Steps are for a person who watches, not for a log file.
    log = demonstration.ProgressLog(sys.stderr if sys.stderr.isatty() and not quiet else None)
    problem = Problem(wave, case.lidar or jl.Lidar(), case.scene, unknowns, noise=sigma)
    fit = fit_waveform(problem, key=jax.random.key(seed), progress=lambda step: log(str(step)))
    click.echo(str(fit))
    if out is not None:
        fit.save(out)
        click.echo(f"result: {out}")
    if plot is not None:
        # matplotlib takes a while to import: only for a figure.
        from matplotlib.figure import Figure

        axes = Figure(figsize=(6.0, 4.2), layout="constrained").subplots(1, 2, sharey=True)
        jl.plot.fit(fit.waveform, wave.reflectance, sigma, axes)
        save_figure(axes[0], plot)
    return 0 if fit.converged else 1


def _check_table_path(ctx: Any, parameter: Any, path: Path) -> Path:
    """Refuse a name that ends in no format of tables, before the work."""
    if path.suffix.lower() not in TABLE_FORMATS:
        raise click.BadParameter(f"{str(path)!r} ends in none of {', '.join(TABLE_FORMATS)}")
    return path


@click.command()
@click.argument(
    "files",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE...",
)
@click.option(
    "-o",
    "--out",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    callback=_check_table_path,
    help="Table to write: .csv, .nc, .parquet or .gpkg.",
)
@click.option("--group", type=click.IntRange(1, 6), default=1, help="Setting group of rh and lowest mode.")
@click.option(
    "--fit",
    is_flag=True,
    help="Also fit a canopy of layers to each shot: about a minute, and a second for each shot.",
)
@click.option("--quiet", is_flag=True, help="Show no progress.")
def gedi(files: tuple[Path, ...], out: Path, group: int, fit: bool, quiet: bool) -> int:
    """Write a table of GEDI level 1B shots: ground, relative heights, cover and plant area.

    A row for each shot, with standard errors, quality and reasons. Shots that cannot be computed have no
    numbers, and the reason. These are closed forms, and the first choice. With --fit there are further
    columns, fit_...; if it is interrupted, the same command continues with the fits that have ended.

    \b
    Example:
      jaxlidar gedi GEDI01_B_2019108080338_O01964_T05337_02_003_01.h5 -o shots.csv
    """
    store = store_beside(out) if fit else None
    is_terminal = sys.stderr.isatty()
    last_time = time.perf_counter()

    def report(progress: Any) -> None:
        nonlocal last_time
        # A terminal rewrites its line; a log file gets a line every few seconds.
        is_due = time.perf_counter() - last_time > _LOG_SECONDS or progress.done == progress.total
        if is_terminal:
            click.echo(f"\r{progress}", err=True, nl=progress.done == progress.total)
        elif is_due:
            click.echo(str(progress), err=True)
            last_time = time.perf_counter()

    show = None if quiet else report
    try:
        table = gedi_table(list(files), group=group, fit=fit, path=store, progress=show)
    except KeyboardInterrupt:
        if store is None:
            raise
        message = f"finished fits are kept in {store}: the same command continues with them"
        click.echo(f"jaxlidar: interrupted; {message}", err=True)
        return INTERRUPTED
    table.save(out)
    # All that it held is in the table.
    if store is not None:
        remove_store(store)
    qualities, counts = np.unique(table["quality"], return_counts=True)
    summary = ", ".join(f"{count} {quality}" for quality, count in zip(qualities, counts))
    click.echo(f"{len(table)} shots: {summary}; written: {out}")
    return SUCCESS
