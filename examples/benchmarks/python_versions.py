"""The same work on several versions of Python and JAX.

Run it as `python examples/benchmarks/python_versions.py --python PATH [--python PATH ...] [--out figures]`,
each PATH an interpreter that has jaxlidar installed, the newest last. Interpreters take turns in processes of
their own (`_python_version.py`), round after round, so that other load of the machine slows all alike; the
fastest round counts.

The scene is the crown over ground of `simulation_cost.py`. "First call" is the whole call of `simulate` in a
new process, which compiles; all other times are warm.
"""

import argparse
import json
import subprocess
from pathlib import Path

import numpy as np
from _common import machine, new_figure, print_table, save_figure, write_json


def measured(python: str) -> dict:
    """Return the measurements of one process of an interpreter."""
    worker = Path(__file__).with_name("_python_version.py")
    process = subprocess.run([python, str(worker)], capture_output=True, text=True)
    if process.returncode:
        raise SystemExit(f"{python} failed: {(process.stderr.strip() or 'no message').splitlines()[-1]}")
    return json.loads(process.stdout.splitlines()[-1])


def draw(versions: list[dict], path: Path) -> None:
    """Draw the seconds over those of the newest version."""
    figure, axes = new_figure(size=(7, 3.8))
    names, height = list(versions[-1]["seconds"]), 0.8 / len(versions)
    for i, version in enumerate(versions):
        label = f"Python {version['python']}, jax {version['jax']}"
        axes.barh(np.arange(len(names)) + i * height, list(version["ratio"].values()), height, label=label)
    axes.set_yticks(np.arange(len(names)) + 0.5 * height * (len(versions) - 1), names)
    axes.invert_yaxis()
    axes.set_xlabel(f"times the seconds of Python {versions[-1]['python']}")
    figure.legend(loc="outside upper center", ncols=len(versions), frameon=False)
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description="The same work on several Pythons.")
    parser.add_argument("--python", action="append", required=True, help="interpreter; the newest last")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", default="figures", type=Path, help="folder of the results")
    arguments = parser.parse_args()
    runs: list[list[dict]] = [[] for _ in arguments.python]
    for _ in range(arguments.rounds):
        for python, measurements in zip(arguments.python, runs):
            measurements.append(measured(python))
    versions = []
    for measurements in runs:
        seconds = {name: min(f["seconds"][name] for f in measurements) for name in measurements[0]["seconds"]}
        versions.append(
            {"python": measurements[0]["python"], "jax": measurements[0]["jax"], "seconds": seconds}
        )
    newest = versions[-1]["seconds"]
    for version in versions:
        version["ratio"] = {name: s / newest[name] for name, s in version["seconds"].items()}
    write_json(arguments.out / "python_versions.json", {"machine": machine(), "versions": versions})

    draw(versions, arguments.out / "python_versions.png")
    head = ("", *(f"{v['python']}, s" for v in versions), *(f"{v['python']}, times" for v in versions[:-1]))
    print_table(
        head,
        [(n, *(v["seconds"][n] for v in versions), *(v["ratio"][n] for v in versions[:-1])) for n in newest],
    )


if __name__ == "__main__":
    main()
