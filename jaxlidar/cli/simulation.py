"""The commands `jaxlidar simulate` and `jaxlidar plan`."""

import dataclasses
from pathlib import Path

import click
import jax

from jaxlidar.cli.constants import INTERRUPTED, SUCCESS
from jaxlidar.cli.shared import (
    CASE_ARGUMENT,
    PLOT_OPTION,
    QUIET_OPTION,
    RESULT_SUFFIXES,
    new_axes,
    out_option,
    save_figure,
    shows_bar,
)
from jaxlidar.io import Case, read_case
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.results.netcdf import open as open_result
from jaxlidar.results.store import is_zarr, remove_store, store_beside
from jaxlidar.sensors.lidar import Lidar

# Arguments of `simulate` that `jaxlidar.plan` has, too.
_PLAN_ARGUMENTS = ("rtol", "max_orders", "max_step", "n_rays", "window", "bin_width", "footprint", "effects")


def read_complete_case(path: Path, seed: int | None = None, rtol: float | None = None) -> Case:
    """Read a case, and add the default lidar and the key of seed 0 if it has none.

    **Raises:** UsageError for a case without a scene.
    """
    case = read_case(path)
    if case.scene is None:
        raise click.UsageError(f"{path} has no scene")
    if seed is not None or case.key is None:
        case = dataclasses.replace(case, key=jax.random.key(seed or 0))
    if rtol is not None:
        case = dataclasses.replace(case, arguments={**case.arguments, "rtol": rtol})
    return dataclasses.replace(case, lidar=case.lidar or Lidar())


@click.command()
@CASE_ARGUMENT
@out_option("Write the waveform, with its case, as netCDF (.nc), or as Zarr (.zarr).", *RESULT_SUFFIXES)
@PLOT_OPTION
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 1), help="Seed of the photons, in place of the file's."
)
@click.option("--rtol", type=click.FloatRange(0, 1, min_open=True, max_open=True), help="Relative accuracy.")
@QUIET_OPTION
def simulate(
    case: Path, out: Path | None, plot: Path | None, seed: int | None, rtol: float | None, quiet: bool
) -> int:
    """Simulate the waveform of a case: a lidar and a scene in a TOML file.

    A case with a survey gives all of its waveforms. After Ctrl-C, a waveform of eight or more batches of
    photons is kept. A survey with -o is continued by the same command.

    \b
    Examples:
      jaxlidar simulate examples/scenes/flat_ground.toml
      jaxlidar simulate tree.toml -o tree.nc --plot tree.png --rtol 0.02
    """
    complete_case = read_complete_case(case, seed, rtol)
    if complete_case.survey is not None:
        return _simulate_survey(complete_case, out, plot, quiet)
    wave = complete_case.simulate(shows_bar(quiet))
    click.echo(str(wave))
    if out is not None:
        wave.save(out, complete_case)
        click.echo(f"waveform: {out}")
    if plot is not None:
        from jaxlidar.plot import waveform

        axes = new_axes(4.0, 4.2)
        waveform(wave, axes)
        save_figure(axes, plot)
    return INTERRUPTED if wave.info.get("stopped") == "interrupted" else SUCCESS


def _simulate_survey(case: Case, out: Path | None, plot: Path | None, quiet: bool) -> int:
    assert case.survey is not None
    store = out if out is None or is_zarr(out) else store_beside(out)
    try:
        waveforms = case.simulate(shows_bar(quiet), store)
    except KeyboardInterrupt:
        if out is None:
            message = "finished shots are lost: give -o to keep them"
        else:
            message = f"finished shots are kept in {store}: the same command continues with them"
        click.echo(f"jaxlidar: interrupted; {message}", err=True)
        return INTERRUPTED
    if out is not None and store is not None and store != out:
        waveforms.save(out, dataclasses.replace(case, lidar=None))
        # The arrays of a store are read where they are used.
        waveforms = open_result(out)
        remove_store(store)
    click.echo(str(waveforms))
    if out is not None:
        click.echo(f"waveforms: {out}")
    if plot is not None:
        from jaxlidar.plot import survey

        axes = new_axes(4.6, 4.6)
        brightness = waveforms.reflectance.sum(axis=2)[:, 0]
        survey(case.survey, case.scene, axes, values=brightness, label="apparent reflectance")
        save_figure(axes, plot)
    return SUCCESS


@click.command()
@CASE_ARGUMENT
def plan(case: Path) -> None:
    """Show which effects a simulation would include, and bounds on those that it leaves out.

    \b
    Example:
      jaxlidar plan examples/scenes/leaf_plate_over_ground.toml
    """
    complete_case = read_complete_case(case)
    shots = complete_case.lidar if complete_case.survey is None else complete_case.survey
    assert shots is not None
    assert complete_case.scene is not None
    arguments = {name: value for name, value in complete_case.arguments.items() if name in _PLAN_ARGUMENTS}
    click.echo(str(make_plan(shots, complete_case.scene, **arguments)))
