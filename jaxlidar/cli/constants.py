"""Exit statuses, and the group of entry points that are commands."""

COMMANDS = "jaxlidar.commands"
SUCCESS, FAILURE, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130
