"""The command `jaxlidar`: `jaxlidar --help` lists what it can do, `jaxlidar COMMAND --help` has examples.

Besides those of this room, every entry point of the group `jaxlidar.commands` is a command (a
`click.Command`), so that packages that build on this one can add theirs: `demo` and `retrieve` come from the
package `inversion`.

Exit statuses: 0 done; 1 failed (a sentence on the standard error says why); 2 wrong usage; 130 interrupted
(what was done until then is kept where the command says so).
"""

import os
import sys
import warnings
from collections.abc import Sequence
from importlib import metadata
from typing import Any

COMMANDS = "jaxlidar.commands"
DONE, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130


def version() -> str:
    """The installed version."""
    try:
        return metadata.version("jaxlidar")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    **Arguments:**

    - `argv`: arguments without the program's name. Default None: those of the process.

    **Returns:** the exit status.

    **Example:**

    >>> from jaxlidar.cli import main
    >>> main(["spectra", "wood"])  # doctest: +SKIP
    """
    try:
        import click

        from jaxlidar.cli.group import jaxlidar
    except ImportError as error:
        return _fail(f"the command needs {error.name}: pip install 'jaxlidar[cli]'")
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            status = jaxlidar.main(argv, prog_name="jaxlidar", standalone_mode=False)
        sys.stdout.flush()
        return status if isinstance(status, int) else DONE
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _fail("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # The reader of the output (head, less) has closed it; keep the interpreter from flushing it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except (OSError, ValueError, TypeError, ImportError) as error:
        return _fail(str(error))


def _warn(message: Any, *args: Any, **kwargs: Any) -> None:
    print(f"jaxlidar: warning: {message}", file=sys.stderr)


def _fail(why: str, status: int = FAILED) -> int:
    print(f"jaxlidar: {why}", file=sys.stderr)
    return status
