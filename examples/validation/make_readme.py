"""Write README.md of this folder from the records in `results/`: no number in it is typed by hand.

Run it as `python examples/validation/make_readme.py` after a script, run with `--out
examples/validation/results`, has renewed its record.
"""

import json
from pathlib import Path

from _validation import error_of
from _writing import number, page_of, table

from jaxlidar.io import atomic_write

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results"
# The order of the page: exact references first, then other codes, measurements and records.
ORDER = (
    *("mpmath_plate", "prosail_leaves", "discrete_ordinates", "rami4pilps"),
    *("mitransient_crown", "mitransient_meshes", "mcx_crown"),
    *("leaf_databases", "recorded_gedi", "recorded_posterior", "recorded_neon", "recorded_riegl"),
    *("recorded_flat", "recorded_lvis", "recorded_clouds", "recorded_photons"),
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


def table_line(summary_row: dict, script: str) -> list[str]:
    """Return the line of the table for one quantity."""
    return [
        f"[{summary_row['what']}](#{script.replace('_', '-')})",
        summary_row["against"],
        f"{summary_row['cases']:,}",
        summary_row["case"],
        number(summary_row["here"], 4),
        number(summary_row["there"], 4) + ("" if summary_row["unit"] == "1" else f" {summary_row['unit']}"),
        number(summary_row["difference"]),
        f"{'≤' if 'bound' in summary_row else '±'} {number(error_of(summary_row))}",
        number(summary_row["rms over error"]),
        f"{number(100 * summary_row['within'], 3)} %",
    ]


HEADINGS = (
    *(
        "quantity",
        "reference",
        "cases",
        "worst case",
        "jaxlidar",
        "reference value",
        "difference",
        "its error",
    ),
    *("root mean square of all over their errors", "within two standard errors, or the bound"),
)


COST_HEADINGS = ("case", "code", "s", "error", "s to 1 %", "CPU s to 1 %", "times jaxlidar", "s, first call")


def costs(record: dict) -> tuple[str, ...]:
    """Return the paragraphs of what both codes cost, where a script has measured it."""
    if "costs" not in record:
        return ()
    ours = {cost["case"]: cost for cost in record["costs"] if cost["code"] == "jaxlidar"}
    lines = [
        [
            cost["case"],
            cost["code"],
            number(cost["seconds"]),
            f"{number(100 * cost['error'])} %",
            number(cost["seconds_to_1_percent"]),
            number(cost["cpu_seconds_to_1_percent"]),
            number(cost["cpu_seconds_to_1_percent"] / ours[cost["case"]]["cpu_seconds_to_1_percent"]),
            number(cost["first_call_seconds"]),
        ]
        for cost in record["costs"]
    ]
    text = (
        "What a waveform costs: seconds and error (root mean square over samples above 1 % of the peak) of "
        "one repetition, the seconds of repetitions until the error is 1 %, and their ratio in CPU seconds. "
        f"Both codes ran on the same {record['machine']['cores']} cores."
    )
    return text, table(COST_HEADINGS, lines)


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
        f"Unchecked: {record['unchecked']}",
        f"{record['date']}, {software}, jax {record['machine']['jax']}, "
        f"Python {record['machine']['python']}{code}.",
    )


def page() -> str:
    """Return the text of README.md."""
    records = load()
    lines = [
        table_line(summary_row, name) for name, record in records.items() for summary_row in record["summary"]
    ]
    return page_of(HEAD, TABLE, table(HEADINGS, lines), *(section(n, r) for n, r in records.items())) + "\n"


if __name__ == "__main__":
    with atomic_write(FOLDER / "README.md") as draft:
        draft.write_text(page())
