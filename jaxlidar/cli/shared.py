"""What commands share: arguments that are files, figures, and progress."""

import contextlib
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from jaxlidar._progress import Progress
from jaxlidar.io import atomic_write
from jaxlidar.io.stores import is_zarr

CASE = click.argument("case", type=click.Path(dir_okay=False, path_type=Path), metavar="CASE.toml")
PLOT = click.option(
    "--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw a figure (.png, .pdf, .svg)."
)
QUIET = click.option("--quiet", is_flag=True, help="Show no progress.")


class ResultPath(click.Path):
    """A path of a file; or of a folder, if its name ends as that of a Zarr store."""

    def __init__(self, exists: bool = False):
        super().__init__(exists=exists, path_type=Path)

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        path: Any = super().convert(value, param, ctx)
        if path.is_dir() and not is_zarr(path):
            self.fail(f"File {str(value)!r} is a directory.", param, ctx)
        return path


def out(help: str) -> Callable[[Any], Any]:
    """The option `-o`."""
    return click.option("-o", "--out", type=ResultPath(), help=help)


def new_axes(width: float, height: float, **options: Any) -> Any:
    """Axes of a figure that no window shows."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained").add_subplot(**options)


def save_figure(axes: Any, path: Path) -> None:
    """Write the figure of some axes, and say so."""
    with atomic_write(path) as draft:
        axes.get_figure().savefig(draft, format=path.suffix.lstrip(".") or "png", dpi=150)
    click.echo(f"figure: {path}")


@contextlib.contextmanager
def progress_of_simulation(quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """A bar on the standard error while `simulate` runs; none where that is no terminal."""
    from tqdm import tqdm

    bar = tqdm(
        total=100,
        unit="%",
        disable=True if quiet else None,
        file=sys.stderr,
        leave=False,
        bar_format="{desc} {bar} {percentage:3.0f} % {elapsed}",
        desc="simulating",
    )

    def show(now: Progress) -> None:
        # The error falls with the square root of the photons.
        share = (
            0.0
            if now.rtol is None or not math.isfinite(now.error)
            else (now.rtol / max(now.error, 1e-9)) ** 2
        )
        bar.set_description(f"{now.photons:,} photons, error {now.error:.2g}", refresh=False)
        bar.n = round(100 * min(share, 1.0))
        bar.refresh()

    with bar:
        yield show


@contextlib.contextmanager
def progress_of_survey(quiet: bool, shots: int) -> Iterator[Callable[[Any], None]]:
    """A bar on the standard error while `simulate_many` runs; none where that is no terminal."""
    from tqdm import tqdm

    disable = True if quiet else None
    bar = tqdm(total=shots, unit=" shots", disable=disable, file=sys.stderr, leave=False, desc="simulating")

    def show(now: Any) -> None:
        bar.n = now.done
        bar.refresh()

    with bar:
        yield show
