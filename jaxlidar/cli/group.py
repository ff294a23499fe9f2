"""The group of all commands, and the options of the group."""

from importlib import metadata
from typing import Any

import click

from jaxlidar._fields.checks import warn_user
from jaxlidar._fingerprint import version_of
from jaxlidar._jax.compilation_cache import compilation_cache
from jaxlidar.cli.constants import COMMANDS
from jaxlidar.cli.files import convert, info
from jaxlidar.cli.optics import prospect, spectra
from jaxlidar.cli.reference import reference
from jaxlidar.cli.simulation import plan, simulate
from jaxlidar.cli.trees import tree

BUILT_IN_COMMANDS: dict[str, click.Command] = {
    str(command.name): command
    for command in (simulate, plan, tree, prospect, spectra, info, convert, reference)
}


class CommandGroup(click.Group):
    """The commands of this package, and those of other packages by entry points, loaded on first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*BUILT_IN_COMMANDS, *(point.name for point in metadata.entry_points(group=COMMANDS))})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in BUILT_IN_COMMANDS:
            return BUILT_IN_COMMANDS[cmd_name]
        for point in metadata.entry_points(group=COMMANDS):
            if point.name == cmd_name:
                return _load_command(point)
        return None


def _load_command(point: metadata.EntryPoint) -> click.Command:
    """Load the command of another package; if that fails, return a command that reports the reason.

    So a broken package does not break `jaxlidar --help` and the other commands.
    """
    try:
        command = point.load()
        if isinstance(command, click.Command):
            return command
        reason = f"{point.value} is no click.Command"
    except (ImportError, AttributeError) as error:
        reason = str(error)

    def report() -> None:
        raise click.ClickException(f"the command {point.name} cannot be loaded: {reason}")

    return click.Command(point.name, callback=report, help=f"Cannot be loaded: {reason}.")


@click.group(
    cls=CommandGroup,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    epilog="Exit statuses: 0 success, 1 failure, 2 wrong usage, 130 interrupted.",
)
@click.version_option(version_of("jaxlidar"), message="jaxlidar %(version)s")
@click.option("--cache/--no-cache", default=True, help="Store compiled programs for the next call.")
@click.pass_context
def jaxlidar(context: click.Context, cache: bool) -> Any:
    """A differentiable simulator of full-waveform lidar."""
    if cache:
        try:
            # Until the command ends: Python code that calls it may need its own configuration of JAX.
            context.with_resource(compilation_cache())
        except OSError as error:
            warn_user(f"compiled programs are not kept: {error}")
