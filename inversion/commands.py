"""The commands `jaxlidar demo`, `jaxlidar retrieve`, `jaxlidar gedi` and `jaxlidar footprints`.

`jaxlidar` never imports this package: its command line finds the commands by the group of entry points
"jaxlidar.commands" in pyproject.toml.
"""

import contextlib
import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
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
from inversion.footprints import simulate_footprints
from inversion.metrics.gedi_table import gedi_table
from jaxlidar.cli.constants import INTERRUPTED, SUCCESS
from jaxlidar.cli.shared import (
    PLOT_OPTION,
    QUIET_OPTION,
    RESULT_SUFFIXES,
    ResultPath,
    check_suffix,
    out_option,
    save_figure,
)
from jaxlidar.formats.tables import TABLE_FORMATS
from jaxlidar.results.store import remove_store, store_beside
from jaxlidar.survey.cloud_tiles import check_tile_folder, remove_tiles, stored_tiles

# Endings of files of points, and the most footprints outside of them that are named.
_CLOUD_SUFFIXES, _NAMED = (".las", ".laz"), 10
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
@out_option("Write the result as netCDF (.nc), or as Zarr (.zarr).", *RESULT_SUFFIXES)
@PLOT_OPTION
@QUIET_OPTION
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


def _check_table_path(ctx: Any, parameter: Any, path: Path | None) -> Path | None:
    return check_suffix(path, TABLE_FORMATS)


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
    try:
        table = gedi_table(list(files), group=group, fit=fit, path=store, progress=_progress_lines(quiet))
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
    click.echo(f"{len(table)} shots: {_qualities(table)}; written: {out}")
    return SUCCESS


def _progress_lines(quiet: bool) -> Callable[[Any], None] | None:
    """Return a function that prints reports of progress on the standard error; None for quiet."""
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

    return None if quiet else report


def _qualities(table: Any) -> str:
    """Return how many rows of a table have each quality."""
    qualities, counts = np.unique(table["quality"], return_counts=True)
    return ", ".join(f"{count} {quality}" for quality, count in zip(qualities, counts))


# -- footprints --------------------------------------------------------------------------------------------


def _split_inputs(ctx: Any, parameter: Any, paths: tuple[Path, ...]) -> tuple[list[Path], Path]:
    """Return the files of points, and the one file of places."""
    clouds = [path for path in paths if path.suffix.lower() in _CLOUD_SUFFIXES]
    places = [path for path in paths if path not in clouds]
    if not clouds or len(places) != 1:
        raise click.BadParameter(
            f"{len(clouds)} files of points (.las, .laz) and {len(places)} of places; admissible are one or "
            "more, and one"
        )
    return clouds, places[0]


def _lidar_of_name(ctx: Any, parameter: Any, name: str) -> jl.Lidar:
    """Return the lidar of a name; that of a mission is its full-power beam by night."""
    try:
        return jl.instrument(f"{name} power" if f"{name} power" in jl.instruments() else name)
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


def _check_default_table(path: Path) -> None:
    """Refuse to write over a file that the user has not named, unless it is a table of this command."""
    if not path.exists():
        return
    header = b""
    if path.is_file():
        with path.open("rb") as file:
            header = file.readline()
    if not (header.startswith(b"shot_number,beam,x,y,") and b",covered,true ground," in header):
        raise click.BadParameter(
            f"{path} is there already and no table of footprints; nothing is overwritten: name the table to "
            "write",
            param_hint="--table",
        )


@contextlib.contextmanager
def _executor(workers: str | None) -> Iterator[Executor | None]:
    """Give processes of this machine by their number, or the workers of a Dask scheduler by its address."""
    refusal = click.BadParameter(
        f"{workers!r}; admissible are a number of processes, 1 or more, and the address of a Dask scheduler, "
        "such as tcp://192.168.0.1:8786",
        param_hint="--workers",
    )
    if workers is None:
        yield None
    elif ":" not in workers:
        if not (workers.isascii() and workers.isdigit() and int(workers) > 0):
            raise refusal
        with ProcessPoolExecutor(int(workers), multiprocessing.get_context("spawn")) as executor:
            yield executor
    else:
        try:
            from distributed import Client  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ImportError('workers of Dask need distributed: pip install "jaxlidar[cluster]"') from error
        try:
            # Not the default: xarray would leave its own work to a scheduler, also to one that is not there.
            client = Client(workers, set_as_default=False)
        except ValueError as error:
            raise refusal from error
        with client:
            yield client.get_executor()


@click.command()
@click.argument(
    "inputs",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    callback=_split_inputs,
    metavar="CLOUD.laz... PLACES",
)
@click.option(
    "-o",
    "--out",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="Level 1B file to write (.h5).",
)
@click.option(
    "--table",
    "table_path",
    type=click.Path(dir_okay=False, path_type=Path),
    callback=_check_table_path,
    help="Table to write: .csv, .nc, .parquet or .gpkg.  [default: beside the file, .csv]",
)
@click.option(
    "--instrument",
    "lidar",
    default="GEDI",
    callback=_lidar_of_name,
    help="Name of a lidar: jl.instruments().",
)
@click.option("--link-margin", type=float, help="Link margin of the noise, dB.  [default: no noise]")
@click.option(
    "--link-cover",
    type=click.FloatRange(0, 1, max_open=True),
    default=0.95,
    help="Canopy cover at which the link margin holds.",
)
@click.option(
    "--geolocation-error",
    type=click.FloatRange(0),
    default=0.0,
    help="Standard deviation of the stated places about the true ones, m.",
)
@click.option("--crs", help="Coordinate reference system of files that declare none, such as EPSG:32633.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Seed of light, noise and errors.")
@click.option("--workers", help="Processes (a number), or the address of a Dask scheduler.")
@QUIET_OPTION
def footprints(
    inputs: tuple[list[Path], Path],
    out: Path,
    table_path: Path | None,
    lidar: jl.Lidar,
    link_margin: float | None,
    link_cover: float,
    geolocation_error: float,
    crs: str | None,
    seed: int,
    workers: str | None,
    quiet: bool,
) -> int:
    """Simulate spaceborne footprints over airborne point clouds.

    Writes a GEDI level 1B file, and a table of each footprint: metrics without noise and with it, under the
    names of the GEDI simulator, and those of `jaxlidar gedi`. PLACES is a table (.csv) with columns x and y,
    or longitude and latitude, and optionally shot_number and beam; or a GEDI level 1B or 2A file (.h5).

    A link margin is 10 log10 of what the echo of the ground below the given cover exceeds the noise by, over
    the threshold: at 0 dB nine of ten grounds are found, and one false one in 20 records of 30 m. Without it
    records have no noise and the file states none: what follows from noise (blairSense, sensitivity) has no
    numbers, and the quality is not judged by noise.

    Clouds are simulated tile by tile. If it is interrupted, the same command continues with the tiles that
    have ended, in the folder OUT.tiles. Neither a folder of that name with other files is touched, nor a file
    with the name of the default table that is no such table: both are refused.

    \b
    Example:
      jaxlidar footprints tiles/*.laz shots.csv -o l1b.h5 --instrument GEDI --link-margin 3
    """
    clouds, places = inputs
    if out.suffix.lower() not in (".h5", ".hdf5"):
        raise click.BadParameter(f"{str(out)!r} does not end in .h5", param_hint="--out")
    is_default_table = table_path is None
    table_path = table_path or out.with_suffix(".csv")
    if places.resolve() in (out.resolve(), table_path.resolve()):
        raise click.BadParameter(f"{places} would be overwritten", param_hint="--out")
    if is_default_table:
        _check_default_table(table_path)
    folder = out.with_name(out.name + ".tiles")
    check_tile_folder(folder)
    # An empty folder may be the user's: it stays.
    is_of_user = folder.is_dir() and not any(folder.iterdir())
    try:
        with _executor(workers) as executor:
            table = simulate_footprints(
                clouds,
                places,
                out,
                folder,
                lidar=lidar,
                link_margin=link_margin,
                cover=link_cover,
                geolocation_error=geolocation_error,
                crs=crs,
                seed=seed,
                executor=executor,
                progress=_progress_lines(quiet),
            )
        table.save(table_path)
        # All that they held is in the file and the table.
        remove_tiles(folder)
    except KeyboardInterrupt:
        message = f"finished tiles are kept in {folder}: the same command continues with them"
        click.echo(
            f"jaxlidar: interrupted; {message if stored_tiles(folder) else 'no tile was finished'}", err=True
        )
        return INTERRUPTED
    finally:
        # A folder that is not empty stays, with tiles to go on with or what somebody has put there.
        if not is_of_user:
            with contextlib.suppress(OSError):
                folder.rmdir()
    click.echo(f"{len(table)} footprints: {_qualities(table)}; written: {out}, {table_path}")
    (outside,) = np.nonzero(np.isnan(table["covered"]))
    if outside.size:
        numbers = ", ".join(map(str, table["shot_number"][outside[:_NAMED]]))
        more = f" and {outside.size - _NAMED} more" if outside.size > _NAMED else ""
        click.echo(f"outside of all files of points: {outside.size} footprints, {numbers}{more}")
    return SUCCESS
