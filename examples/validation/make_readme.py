"""Write README.md of this folder from the records in `results/`: no number in it is typed by hand.

Run it as `python examples/validation/make_readme.py` after a script, run with `--out
examples/validation/results`, has renewed its record.
"""

import json
from pathlib import Path

from _validation import SUMMARY_COLUMNS, page_of, percent, table

from jaxlidar.io import atomic_write

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results"
# The order of the page: exact references first, then other codes, measurements and records.
ORDER = (
    *("mpmath_plate", "prosail_leaves", "prosail_canopy", "discrete_ordinates"),
    *("flight_times", "infinite_medium", "rami4pilps"),
    *("rami_reflectance", "rami_waveforms"),
    *("mitransient_crown", "mitransient_meshes", "mcx_crown", "multiscatter_slabs"),
    *("standard_errors", "leaf_databases", "recorded_gedi", "recorded_posterior"),
    *("recorded_neon", "recorded_riegl"),
    *(
        "recorded_flat",
        "recorded_lvis",
        "recorded_clouds",
        "recorded_footprints",
        "photons_on_slopes",
        "recorded_photons",
    ),
)

HEAD = """# Validation: comparisons with references, and their differences

Each script compares jaxlidar with one reference that shares no code with it, writes a record (JSON) and a
picture of differences. This page is made from the records in `results/` by `make_readme.py`.

```sh
pip install '.[bench,cli,io]'
python examples/validation/discrete_ordinates.py --out examples/validation/results
python examples/validation/make_readme.py
```

Data of other owners are not part of the project: scripts take paths as arguments and describe the files. With
`--quiet` they print nothing."""

TABLE = """Each line is one quantity. It shows the case with the largest difference in units of its error: the
value by jaxlidar, the reference, and their difference. Errors are standard errors of the difference (±), or
bounds on it (≤), which the script explains. Of independent normal differences 95 % lie within two standard
errors, their root mean square over the error is 1, and the largest of 10 is about 2 standard errors, of 100
about 3."""


def load() -> dict[str, dict]:
    """Return the existing records in the order of the page."""
    paths = [RESULTS / f"{name}.json" for name in ORDER]
    return {path.stem: json.loads(path.read_text()) for path in paths if path.exists()}


def costs(record: dict) -> tuple[str, ...]:
    """Return the paragraphs of what both codes cost, where a script has measured it."""
    if "costs" not in record:
        return ()
    ours = {cost["case"]: cost for cost in record["costs"] if cost["code"] == "jaxlidar"}
    columns = {
        "case": "case",
        "code": "code",
        "s": "seconds",
        "error": lambda cost: percent(cost["error"]),
        "s to 1 %": "seconds_to_1_percent",
        "CPU s to 1 %": "cpu_seconds_to_1_percent",
        "times jaxlidar": lambda cost: (
            cost["cpu_seconds_to_1_percent"] / ours[cost["case"]]["cpu_seconds_to_1_percent"]
        ),
        "s, first call": "first_call_seconds",
    }
    text = (
        "What a waveform costs: seconds and error (root mean square over samples above 1 % of the peak) of "
        "one repetition, the seconds of repetitions until the error is 1 %, and their ratio in CPU seconds. "
        f"Both codes ran on the same {record['machine']['cores']} cores."
    )
    return text, table(record["costs"], columns)


def own_tables(record: dict) -> tuple[str, ...]:
    """Return the tables that a script has written into its record, each after its text."""
    paragraphs = []
    for own in record.get("tables", ()):
        columns = {heading: lambda line, i=i: line[i] for i, heading in enumerate(own["headings"])}
        paragraphs += [" ".join(own["text"].split()), table(own["lines"], columns)]
    return tuple(paragraphs)


def section(script: str, record: dict) -> str:
    """Return the section of one script: figure, caption, costs, and properties that remain unchecked."""
    software = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    code = f"; {record['code']}" if "code" in record else ""
    return page_of(
        f"## {script.replace('_', ' ')}",
        f"`{script}.py`: {record['title'][0].lower()}{record['title'][1:]}.",
        f"![{record['title']}](results/{script}.png)",
        record["seen"],
        *costs(record),
        *own_tables(record),
        f"Unchecked: {record['unchecked']}",
        f"{record['date']}, {software}, jax {record['machine']['jax']}, "
        f"Python {record['machine']['python']}{code}.",
    )


def page() -> str:
    """Return the text of README.md."""
    records = load()
    rows = [
        {**r, "what": f"[{r['what']}](#{script.replace('_', '-')})"}
        for script, record in records.items()
        for r in record["summary"]
    ]
    sections = (section(script, record) for script, record in records.items())
    return page_of(HEAD, TABLE, table(rows, SUMMARY_COLUMNS), *sections) + "\n"


if __name__ == "__main__":
    with atomic_write(FOLDER / "README.md") as draft:
        draft.write_text(page())
