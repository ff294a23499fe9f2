"""Draw the first example of README.md: run it as `python examples/figures/example.py`."""

import contextlib
import re
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

from jaxlidar.io import atomic_write

FOLDER = Path(__file__).resolve().parent


def main() -> None:
    """Run the example as it is printed and save its picture."""
    page = (FOLDER.parents[1] / "README.md").read_text()
    code = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    names: dict = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(code, names)
    with atomic_write(FOLDER / "example.png") as draft:
        names["axes"].get_figure().savefig(draft, dpi=110, format="png")


if __name__ == "__main__":
    main()
