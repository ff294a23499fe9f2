"""The command `jaxlidar`: `jaxlidar demo`, `jaxlidar spectra`, `jaxlidar --version`.

A command is a function that takes the arguments after its name and returns an exit status. Besides those of
this module, every entry point of the group `jaxlidar.commands` is a command, so that packages that build on
this one can add theirs: `demo` comes from the package `inversion`.

Exit statuses: 0 done, 1 failed (a sentence on the standard error says why), 2 wrong usage, 130 interrupted.
"""

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata

COMMANDS = "jaxlidar.commands"

Command = Callable[[Sequence[str]], int]


class CommandError(Exception):
    """An error whose message is a sentence for the user."""


def spectra(argv: Sequence[str]) -> int:
    """List the bundled reflectance spectra, of one kind or of all."""
    parser = argparse.ArgumentParser(prog="jaxlidar spectra", description=spectra.__doc__)
    parser.add_argument("kind", nargs="?", help="bark, wood, litter, char, soil or built; without it, all")
    options = parser.parse_args(argv)
    import numpy as np

    from jaxlidar.optics.spectra import spectra as listed
    from jaxlidar.optics.spectra import spectrum

    try:
        names = listed(options.kind)
    except ValueError as error:
        raise CommandError(str(error)) from error
    at = np.array([532.0, 1064.0, 1550.0])
    width = max(map(len, names))
    print(f"{'name':{width}}  {'kind':6}  " + "  ".join(f"{w:4.0f} nm" for w in at))
    for name, kind in names.items():
        values = "  ".join(f"{float(r):7.2f}" for r in spectrum(name)(at))
        print(f"{name:{width}}  {kind:6}  {values}")
    return 0


def version() -> str:
    """The installed version."""
    try:
        return metadata.version("jaxlidar")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def commands() -> Mapping[str, Command | metadata.EntryPoint]:
    """Commands by name. Those of other packages are entry points, which are loaded when they are run."""
    added = {point.name: point for point in metadata.entry_points(group=COMMANDS)}
    return {**added, "spectra": spectra}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    **Arguments:**

    - `argv`: arguments without the program's name. Default None: those of the process.

    **Returns:** the exit status.

    **Raises:** only SystemExit, for wrong usage and for `--help`.

    **Example:**

    >>> from jaxlidar.cli import main
    >>> main(["spectra", "wood"])  # doctest: +SKIP
    """
    known = commands()
    parser = argparse.ArgumentParser(
        prog="jaxlidar",
        description="A differentiable simulator of full-waveform lidar.",
        epilog="jaxlidar COMMAND --help says what a command takes.",
    )
    parser.add_argument("--version", action="version", version=f"jaxlidar {version()}")
    parser.add_argument("command", metavar="COMMAND", choices=sorted(known), help=", ".join(sorted(known)))
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    given = parser.parse_args(argv)
    chosen = known[given.command]
    try:
        if isinstance(chosen, metadata.EntryPoint):
            chosen = chosen.load()
        status = chosen(given.arguments)
        sys.stdout.flush()
        return status
    except CommandError as error:
        return _fail(str(error), 1)
    except BrokenPipeError:
        # The reader of the output (head, less) has closed it; keep the interpreter from flushing it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        return _fail(str(error), 1)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)


def _fail(why: str, status: int) -> int:
    print(f"jaxlidar: {why}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
