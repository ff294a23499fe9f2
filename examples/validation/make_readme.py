"""Write README.md of this folder from the records in `results/`: no number in it is typed by hand.

Run it as `python examples/validation/make_readme.py` after a script, run with `--out
examples/validation/results`, has renewed its record.
"""

import json
from pathlib import Path

from _validation import error_of
from _writing import number, page_of, table

from jaxlidar.io import atomic_write

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
# The order of the page: exact references first, then other codes, measurements and records.
ORDER = (
    *("mpmath_plate", "prosail_leaves", "discrete_ordinates", "rami4pilps", "mitransient_crown", "mcx_crown"),
    *("leaf_databases", "recorded_gedi", "recorded_neon", "recorded_riegl", "recorded_flat", "recorded_lvis"),
)

HEAD = """# Validation: against what it was checked, and how far off it is

Each script compares jaxlidar with one reference that shares no code with it, writes a record (JSON) and a
picture of differences. This page is made from the records in `results/` by `make_readme.py`.

```sh
pip install '.[bench,cli,io]'
python examples/validation/discrete_ordinates.py --out examples/validation/results
python examples/validation/make_readme.py
```

Data that others own are not here: scripts take them as arguments, and say what a file must hold. `--quiet`
shows nothing."""

TABLE = """One line for each kind of comparison. Of its cases it gives the one that is furthest off, in
units of its error: here, there, and their difference. Errors are standard errors of the difference (±),
or bounds that it should not exceed (≤), which the script explains. Of independent normal differences 95
% lie within two standard errors, their root mean square over the error is 1, and the worst of 10 is
about 2 of them, of 100 about 3."""


def load() -> dict[str, dict]:
    """The records that there are, in the order of the page."""
    paths = [RESULTS / f"{name}.json" for name in ORDER]
    return {path.stem: json.loads(path.read_text()) for path in paths if path.exists()}


def line(found: dict, script: str) -> list[str]:
    """The line of the table for one kind of comparison."""
    return [
        f"[{found['what']}](#{script.replace('_', '-')})",
        found["against"],
        f"{found['cases']:,}",
        found["case"],
        number(found["here"], 4),
        number(found["there"], 4) + ("" if found["unit"] == "1" else f" {found['unit']}"),
        number(found["difference"]),
        f"{'≤' if 'bound' in found else '±'} {number(error_of(found))}",
        number(found["rms over error"]),
        f"{number(100 * found['within'], 3)} %",
    ]


HEADINGS = (
    *("what", "against", "cases", "furthest off", "here", "there", "difference", "its error"),
    *("all over their errors, root mean square", "within two standard errors, or the bound"),
)


def section(script: str, record: dict) -> str:
    """Picture, what one sees, what remains unchecked."""
    software = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    code = f"; {record['code']}" if "code" in record else ""
    return page_of(
        f"## {script.replace('_', ' ')}",
        f"`{script}.py`: {record['title'][0].lower()}{record['title'][1:]}.",
        f"![{record['title']}](results/{script}.png)",
        record["seen"],
        f"Unchecked: {record['unchecked']}",
        f"{record['date']}, {software}, jax {record['machine']['jax']}, "
        f"Python {record['machine']['python']}{code}.",
    )


def page() -> str:
    """The page."""
    records = load()
    lines = [line(found, name) for name, record in records.items() for found in record["summary"]]
    return page_of(HEAD, TABLE, table(HEADINGS, lines), *(section(n, r) for n, r in records.items())) + "\n"


if __name__ == "__main__":
    with atomic_write(HERE / "README.md") as draft:
        draft.write_text(page())
