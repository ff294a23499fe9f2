"""Run the command as `python -m jaxlidar`."""

import sys

from jaxlidar.cli import main

if __name__ == "__main__":
    sys.exit(main())
