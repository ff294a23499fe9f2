"""Arguments, options, figures and progress bars that several commands have."""

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click

from jaxlidar.io import atomic_write
from jaxlidar.results.store import is_zarr

CASE_ARGUMENT = click.argument("case", type=click.Path(dir_okay=False, path_type=Path), metavar="CASE.toml")
# Endings of files of results, as `jaxlidar info` knows them.
RESULT_SUFFIXES = (".nc", ".zarr")


def check_suffix(path: Path | None, suffixes: Iterable[str]) -> Path | None:
    """Refuse a name that ends in none of the suffixes, before any work. **Raises:** BadParameter."""
    if path is not None and path.suffix.lower() not in suffixes:
        raise click.BadParameter(f"{str(path)!r} ends in none of {', '.join(suffixes)}")
    return path


def _check_figure_path(ctx: Any, parameter: Any, path: Path | None) -> Path | None:
    # A name without an ending, such as that of a device, is that of a PNG.
    if path is None or not path.suffix:
        return path
    # matplotlib takes a while to import: only for a figure.
    from matplotlib.backend_bases import FigureCanvasBase

    return check_suffix(path, [f".{name}" for name in FigureCanvasBase.get_supported_filetypes()])


PLOT_OPTION = click.option(
    "--plot",
    type=click.Path(dir_okay=False, path_type=Path),
    callback=_check_figure_path,
    help="Draw a figure (.png, .pdf, .svg).",
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


def out_option(help: str, *suffixes: str) -> Callable[[Any], Any]:
    """Make the option `-o` with the given help, for names with one of the suffixes, or for any name."""

    def check(ctx: Any, parameter: Any, path: Path | None) -> Path | None:
        return check_suffix(path, suffixes) if suffixes else path

    return click.option("-o", "--out", type=ResultPath(), callback=check, help=help)


def new_axes(width: float, height: float, **options: Any) -> Any:
    """Make the axes of a figure that is not shown in a window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained").add_subplot(**options)


def save_figure(axes: Any, path: Path) -> None:
    """Write the figure of some axes, and print its path."""
    with atomic_write(path) as draft:
        axes.get_figure().savefig(draft, format=path.suffix.lstrip(".") or "png", dpi=150)
    click.echo(f"figure: {path}")


def shows_bar(quiet: bool) -> bool:
    """Return True if a command shows progress: on the standard error, if that is a terminal."""
    return not quiet and sys.stderr.isatty()
