"""`jaxlidar simulate` and `jaxlidar plan`."""

import dataclasses
from pathlib import Path

import click
import jax

from jaxlidar.cli import DONE, INTERRUPTED
from jaxlidar.cli.shared import (
    CASE,
    PLOT,
    QUIET,
    new_axes,
    out,
    progress_of_simulation,
    progress_of_survey,
    save_figure,
)
from jaxlidar.io import Case, read_case
from jaxlidar.planning.plan import plan as make_plan

# Arguments of `simulate` that a plan has too.
_OF_PLANS = ("rtol", "max_orders", "max_step", "n_rays", "window", "bin_width", "footprint", "effects")


def whole_case(path: Path, seed: int | None = None, rtol: float | None = None) -> Case:
    """A case that can be simulated: with a lidar, by default the paper's, and a key, by default of seed 0."""
    from jaxlidar.instrument.lidar import Lidar

    case = read_case(path)
    if case.scene is None:
        raise click.UsageError(f"{path} has no scene")
    if seed is not None or case.key is None:
        case = dataclasses.replace(case, key=jax.random.key(seed or 0))
    if rtol is not None:
        case = dataclasses.replace(case, arguments={**case.arguments, "rtol": rtol})
    return dataclasses.replace(case, lidar=case.lidar or Lidar())


@click.command()
@CASE
@out("Write the waveform, with its case, as netCDF, or as Zarr (.zarr).")
@PLOT
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), help="Of the photons, in place of the file's.")
@click.option("--rtol", type=click.FloatRange(0, 1, min_open=True, max_open=True), help="Relative accuracy.")
@QUIET
def simulate(
    case: Path, out: Path | None, plot: Path | None, seed: int | None, rtol: float | None, quiet: bool
) -> int:
    """Simulate the waveform of a case: a lidar and a scene in a TOML file.

    Of a case with a survey, all waveforms. Ctrl-C keeps what is done: of a waveform from eight batches of
    photons on, of a survey with -o, with which the same command goes on.

    \b
    Examples:
      jaxlidar simulate examples/scenes/flat_ground.toml
      jaxlidar simulate tree.toml -o tree.nc --plot tree.png --rtol 0.02
    """
    whole = whole_case(case, seed, rtol)
    if whole.survey is not None:
        return _survey(whole, out, plot, quiet)
    with progress_of_simulation(quiet) as show:
        wave = whole.simulate(show)
    click.echo(str(wave))
    if out is not None:
        wave.save(out, whole)
        click.echo(f"waveform: {out}")
    if plot is not None:
        from jaxlidar.plot import waveform

        axes = new_axes(4.0, 4.2)
        waveform(wave, axes)
        save_figure(axes, plot)
    return INTERRUPTED if wave.info.get("stopped") == "interrupted" else DONE


def _survey(case: Case, out: Path | None, plot: Path | None, quiet: bool) -> int:
    assert case.survey is not None
    with progress_of_survey(quiet, len(case.survey)) as show:
        many = case.simulate(show, out)
    click.echo(str(many))
    if out is not None:
        click.echo(f"waveforms: {out}")
    if plot is not None:
        from jaxlidar.plot import survey

        axes = new_axes(4.6, 4.6)
        brightness = many.reflectance.sum(axis=2)[:, 0]
        survey(case.survey, case.scene, axes, values=brightness, label="apparent reflectance")
        save_figure(axes, plot)
    return DONE


@click.command()
@CASE
def plan(case: Path) -> None:
    """Show what a simulation would follow, and what leaving it out would change.

    \b
    Example:
      jaxlidar plan examples/scenes/leaf_plate_over_ground.toml
    """
    whole = whole_case(case)
    shots = whole.lidar if whole.survey is None else whole.survey
    assert shots is not None
    assert whole.scene is not None
    given = {name: value for name, value in whole.arguments.items() if name in _OF_PLANS}
    click.echo(str(make_plan(shots, whole.scene, **given)))
