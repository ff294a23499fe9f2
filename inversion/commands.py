"""Commands of this package: `jaxlidar demo` and `jaxlidar retrieve`."""

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
from inversion.fit.retrieval import retrieve as fit_waveform
from inversion.fit.unknowns import Unknown
from jaxlidar.cli.shared import ResultPath


@click.command()
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default="jaxlidar-demo", help="Folder."
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Of photons and noise.")
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
    if math.isnan(rtol):
        raise click.BadParameter("nan is not in the range 0<x<1.", param_hint="--rtol")
    # Made first, so that a folder that cannot be written ends the command before the work.
    out.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    say = demonstration.Say(None if quiet else sys.stderr)
    demonstration.run(out, seed=seed, rtol=rtol, voxel_size=voxel_size, say=say)
    click.echo(f"\n{time.perf_counter() - started:.0f} s")


def _unknown(ctx: Any, parameter: Any, given: tuple[str, ...]) -> list[Unknown]:
    """Unknowns of the form PATH:LOW:HIGH."""
    unknowns = []
    for text in given:
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
    callback=_unknown,
    metavar="PATH:LOW:HIGH",
    help="A quantity of the scene and its bounds; repeat for more.",
)
@click.option("--noise", type=click.FloatRange(0, min_open=True), help="Standard deviation of the samples.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Of the photons of the fit.")
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

    Noise is the waveform's own standard error where it is not given. The status is 1 where the fit has not
    converged.

    \b
    Example:
      jaxlidar retrieve hill.nc start.toml --unknown ground.height:-2:2 --noise 0.001 -o fit.nc --plot fit.png
    """
    wave, case = jl.open(observed), jl.io.read_case(start)
    if not isinstance(wave, jl.Waveform):
        raise click.UsageError(f"{observed} holds a {type(wave).__name__}, no waveform")
    if case.scene is None:
        raise click.UsageError(f"{start} has no scene")
    spread: Any = np.asarray(wave.stderr) if noise is None else noise
    if noise is None and not np.any(spread > 0):
        raise click.UsageError(f"{observed} has no standard errors: give --noise")
    say = demonstration.Say(sys.stderr if sys.stderr.isatty() and not quiet else None)
    fit = fit_waveform(
        wave,
        case.lidar or jl.Lidar(),
        case.scene,
        unknowns,
        noise=spread,
        key=jax.random.key(seed),
        progress=lambda step: say(str(step)),
    )
    click.echo(str(fit))
    if out is not None:
        fit.save(out)
        click.echo(f"result: {out}")
    if plot is not None:
        from matplotlib.figure import Figure

        axes = Figure(figsize=(6.0, 4.2), layout="constrained").subplots(1, 2, sharey=True)
        jl.plot.fit(fit.waveform, wave.reflectance, spread, axes)
        with jl.io.atomic_write(plot) as draft:
            axes[0].get_figure().savefig(draft, format=plot.suffix.lstrip(".") or "png", dpi=150)
        click.echo(f"figure: {plot}")
    return 0 if fit.converged else 1
