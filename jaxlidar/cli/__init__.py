"""The command `jaxlidar`: `jaxlidar --help` lists its commands, `jaxlidar COMMAND --help` has examples.

Besides the commands of this package, every entry point of the group `jaxlidar.commands` is a command (a
`click.Command`), so that packages on top of this one can add theirs: `demo`, `retrieve`, `gedi` and
`footprints` come from the package `inversion`.

Exit statuses: 0 success; 1 failure (a sentence on the standard error says why); 2 wrong usage; 130
interrupted (results until then are saved where the command says so).
"""

import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from jaxlidar.cli.constants import FAILURE, INTERRUPTED, SUCCESS


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    **Arguments:**

    - `argv`: arguments without the name of the program. Default None: those of the process.

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
            warnings.showwarning = _print_warning
            # Not standalone: click then returns the status and raises its exceptions, which are handled here.
            status = jaxlidar.main(argv, prog_name="jaxlidar", standalone_mode=False)
        # Within `try`, as a closed pipe may be noticed only when the output is flushed.
        sys.stdout.flush()
        return status if isinstance(status, int) else SUCCESS
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _fail("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # The reader of the output (head, less) has closed it. At exit the interpreter would flush the output
        # and fail again, so it is redirected to the null device.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return SUCCESS
    except (OSError, ValueError, TypeError, ImportError) as error:
        return _fail(str(error))


def _print_warning(message: Any, *args: Any, **kwargs: Any) -> None:
    print(f"jaxlidar: warning: {message}", file=sys.stderr)


def _fail(reason: str, status: int = FAILURE) -> int:
    print(f"jaxlidar: {reason}", file=sys.stderr)
    return status
