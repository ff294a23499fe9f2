"""Exit statuses, the version, and the group of entry points that are commands."""

from importlib import metadata

COMMANDS = "jaxlidar.commands"
SUCCESS, FAILURE, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130


def version() -> str:
    """Return the installed version."""
    try:
        return metadata.version("jaxlidar")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"
