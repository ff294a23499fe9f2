"""Arguments, options, figures and progress bars that several commands have."""

import contextlib
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from jaxlidar._progress import Progress
from jaxlidar.io import atomic_write
from jaxlidar.io.store import is_zarr

CASE_ARGUMENT = click.argument("case", type=click.Path(dir_okay=False, path_type=Path), metavar="CASE.toml")
PLOT_OPTION = click.option(
    "--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw a figure (.png, .pdf, .svg)."
)
QUIET_OPTION = click.option("--quiet", is_flag=True, help="Show no progress.")


class ResultPath(click.Path):
    """The path of a file, or of the folder of a Zarr store, which its name ends as."""

    def __init__(self, exists: bool = False):
        super().__init__(exists=exists, path_type=Path)

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        path: Any = super().convert(value, param, ctx)
        if path.is_dir() and not is_zarr(path):
            self.fail(f"File {str(value)!r} is a directory.", param, ctx)
        return path


def out_option(help: str) -> Callable[[Any], Any]:
    """Make the option `-o` with the given help."""
    return click.option("-o", "--out", type=ResultPath(), help=help)


def new_axes(width: float, height: float, **options: Any) -> Any:
    """Make the axes of a figure that is not shown in a window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained").add_subplot(**options)


def save_figure(axes: Any, path: Path) -> None:
    """Write the figure of some axes, and print its path."""
    with atomic_write(path) as draft:
        axes.get_figure().savefig(draft, format=path.suffix.lstrip(".") or "png", dpi=150)
    click.echo(f"figure: {path}")


@contextlib.contextmanager
def simulation_progress_bar(quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """Show a progress bar for `simulate` on the standard error, if that is a terminal.

    **Returns:** a context with the function to pass as `progress=`.
    """
    from tqdm import tqdm

    bar = tqdm(
        total=100,
        unit="%",
        # None: disabled unless the file is a terminal.
        disable=True if quiet else None,
        file=sys.stderr,
        leave=False,
        bar_format="{desc} {bar} {percentage:3.0f} % {elapsed}",
        desc="simulating",
    )

    def show(progress: Progress) -> None:
        # The error falls with the square root of the number of photons, so the fraction of the work that is
        # completed is the squared ratio of the target to the current error.
        completed = 0.0
        error = math.inf if progress.error is None else progress.error
        if progress.rtol is not None and math.isfinite(error):
            completed = (progress.rtol / max(error, 1e-9)) ** 2
        bar.set_description(f"{progress.done:,} photons, error {error:.2g}", refresh=False)
        bar.n = round(100 * min(completed, 1.0))
        bar.refresh()

    with bar:
        yield show


@contextlib.contextmanager
def survey_progress_bar(quiet: bool, shots: int) -> Iterator[Callable[[Progress], None]]:
    """Show a progress bar for `simulate_many` on the standard error, if that is a terminal.

    **Returns:** a context with the function to pass as `progress=`.
    """
    from tqdm import tqdm

    disable = True if quiet else None
    bar = tqdm(total=shots, unit=" shots", disable=disable, file=sys.stderr, leave=False, desc="simulating")

    def show(progress: Progress) -> None:
        bar.n = progress.done
        bar.refresh()

    with bar:
        yield show
