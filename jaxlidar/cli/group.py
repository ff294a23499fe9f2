"""The group of all commands, and the options that hold for each."""

from importlib import metadata
from typing import Any

import click

from jaxlidar.cli import COMMANDS, version
from jaxlidar.cli.cache import kept_programs
from jaxlidar.cli.files import convert, info
from jaxlidar.cli.optics import prospect, spectra
from jaxlidar.cli.simulation import plan, simulate
from jaxlidar.cli.trees import tree

OWN: dict[str, click.Command] = {
    str(c.name): c for c in (simulate, plan, tree, prospect, spectra, info, convert)
}


class Commands(click.Group):
    """Commands of this package and, by entry points, of others, which are loaded when they are asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*OWN, *(point.name for point in metadata.entry_points(group=COMMANDS))})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in OWN:
            return OWN[cmd_name]
        for point in metadata.entry_points(group=COMMANDS):
            if point.name == cmd_name:
                return _loaded(point)
        return None


def _loaded(point: metadata.EntryPoint) -> click.Command:
    """The command of another package, or one that says why there is none."""
    try:
        command = point.load()
        if isinstance(command, click.Command):
            return command
        why = f"{point.value} is no click.Command"
    except (ImportError, AttributeError) as error:
        why = str(error)

    def refuse() -> None:
        raise click.ClickException(f"the command {point.name} cannot be loaded: {why}")

    return click.Command(point.name, callback=refuse, help=f"Cannot be loaded: {why}.")


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    epilog="Exit statuses: 0 done, 1 failed, 2 wrong usage, 130 interrupted.",
)
@click.version_option(version(), message="jaxlidar %(version)s")
@click.option("--cache/--no-cache", default=True, help="Keep compiled programs for the next call.")
@click.pass_context
def jaxlidar(context: click.Context, cache: bool) -> Any:
    """A differentiable simulator of full-waveform lidar."""
    if cache:
        context.with_resource(kept_programs())
