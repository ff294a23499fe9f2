"""Run benchmarks, and write README.md of this folder from their records: no number in it is typed by hand.

    python examples/benchmarks/run.py NAME ... [--out figures] [--quick] [--set SIZE=VALUE ...]
    python examples/benchmarks/run.py --page

A benchmark is a module of this folder. `measure` returns its record; its arguments are sizes, which `--set`
changes, and `--quick` takes those of `QUICK`, to see that all runs. `draw` returns the figure of a record,
and `section` what the page says of it. What `measure` returns as "drawn" is for the figure alone and is not
written. Several benchmarks run in processes of their own: their memory and compilation count.
"""

import argparse
import importlib
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

# Matrices are small here: with several threads scipy took five times as long on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from _common import machine, save_figure, write_json

from jaxlidar.io import atomic_write

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results"
# In the order of the page.
BENCHMARKS = (
    *("accuracy_cost", "simulation_cost", "everyday_changes", "surveys", "narrow_shots", "many_scenes"),
    *("peers", "peers_gradient", "effects_cost", "scaling", "meshes", "mesh_or_voxels", "leaves"),
    *("python_versions", "first_order_march", "one_trace_all_wavelengths", "jacobian_cost"),
    *("gradient_cost", "fit_speed", "retrieval_coverage", "posterior_sampling", "profiles"),
    *("scene_retrieval", "prospect_speed", "leaf_inversion", "devices"),
)

HEAD = """# Benchmarks: cost of accuracy, and comparisons with other codes

Each script measures one thing and has a record (JSON) and a figure; its first lines explain the comparison.
`run.py` runs them, and makes this page from the records in `results/`.

```sh
pip install -e '.[bench]'
python examples/benchmarks/run.py accuracy_cost --out examples/benchmarks/results
python examples/benchmarks/run.py --page
```

Times are seconds of wall time, warm: programs are compiled before. A tilde marks extrapolated times.
"""


def run(name: str, out: Path, **sizes) -> dict:
    """Measure, write `NAME.json` and `NAME.png`, and return the record with what is drawn alone."""
    benchmark = importlib.import_module(name)
    measured = benchmark.measure(**sizes)
    record = {"machine": machine(), **measured}
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{name}.json"
    if hasattr(benchmark, "add_to"):
        record = benchmark.add_to(json.loads(path.read_text()) if path.exists() else {}, record)
    write_json(path, {key: value for key, value in record.items() if key != "drawn"})
    save_figure(benchmark.draw(record), path.with_suffix(".png"))
    return record


def sizes_of(measure: Callable, settings: Sequence[str]) -> dict[str, object]:
    """Return the arguments of `measure` that settings like `rounds=3` name, of the type of the default."""
    parameters, sizes = inspect.signature(measure).parameters, {}
    for setting in settings:
        name, _, text = setting.partition("=")
        if name not in parameters:
            raise SystemExit(f"--set {setting}: admissible are {', '.join(parameters)}")
        default = parameters[name].default
        sizes[name] = tuple(text.split(",")) if isinstance(default, tuple) else type(default)(text)
    return sizes


def of_machine(record: dict) -> str:
    """Return a sentence on the machine of a record, or on the machines of a record of several."""
    if "machine" not in record:
        return " ".join(of_machine(part) for part in record.values())
    m = record["machine"]
    text = f"Measured on {m['cores']} cores ({m['processor']}), Python {m['python']}, jax {m['jax']}."
    if "system share" in m:
        text += f" The operating system took {m['system share']:.0%} of {m['CPU seconds']:.0f} CPU seconds."
    return text


def section(name: str, record: dict) -> str:
    """Return the section of one benchmark on the page."""
    benchmark = importlib.import_module(name)
    return f"## {benchmark.TITLE}\n\n`{name}.py`. {of_machine(record)}\n\n{benchmark.section(record)}\n"


def page() -> str:
    """Return the text of README.md."""
    paragraphs = [HEAD]
    for name in BENCHMARKS:
        paragraphs.append(section(name, json.loads((RESULTS / f"{name}.json").read_text())))
        paragraphs.append(f"![{importlib.import_module(name).TITLE}](results/{name}.png)\n")
    return "\n".join(paragraphs)


def main() -> None:
    parser = argparse.ArgumentParser(description="Run benchmarks, and write the page of their records.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(sorted(BENCHMARKS)))
    parser.add_argument("--out", default="figures", type=Path, help="folder of the results")
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that all runs")
    parser.add_argument(
        "--set", default=[], action="append", metavar="SIZE=VALUE", help="size of a benchmark"
    )
    parser.add_argument("--page", action="store_true", help="write README.md from the records")
    arguments = parser.parse_args()
    names = arguments.names
    if unknown := set(names).difference(BENCHMARKS):
        parser.error(f"unknown: {', '.join(unknown)}; admissible are {', '.join(BENCHMARKS)}")
    if arguments.set and len(names) != 1:
        parser.error("--set is of one benchmark")
    if len(names) == 1:
        benchmark = importlib.import_module(names[0])
        sizes = benchmark.QUICK if arguments.quick else {}
        record = run(names[0], arguments.out, **{**sizes, **sizes_of(benchmark.measure, arguments.set)})
        print(section(names[0], record))
    else:
        options = ["--out", str(arguments.out), *(["--quick"] if arguments.quick else [])]
        for name in names:
            subprocess.run([sys.executable, __file__, name, *options], check=True)
    if arguments.page:
        with atomic_write(FOLDER / "README.md") as draft:
            draft.write_text(page())


if __name__ == "__main__":
    main()
