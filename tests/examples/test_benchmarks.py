"""The frame of the benchmarks: the runner, the record that it writes, and tables in Markdown."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "benchmarks"
BENCHMARK = """
from _common import new_figure

TITLE = "Squares"

def measure(count=3, files=(), factor=1.0):
    return {"squares": [factor * n**2 for n in range(count)], "files": files, "drawn": list(range(count))}

def draw(record):
    figure, axes = new_figure()
    axes.plot(record["drawn"], record["squares"])
    return figure
"""


@pytest.fixture
def run(monkeypatch, tmp_path):
    """The module of the runner; `squares` is a benchmark."""
    (tmp_path / "squares.py").write_text(BENCHMARK)
    for folder in (FOLDER, tmp_path):
        monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "_common", raising=False)
    yield importlib.import_module("run")
    for name in ("_common", "run", "squares"):
        sys.modules.pop(name, None)


def test_a_record_has_the_machine_and_not_what_is_drawn_alone(run, tmp_path):
    record = run.run("squares", tmp_path / "out", count=4)
    written = json.loads((tmp_path / "out" / "squares.json").read_text())
    assert record["drawn"] == [0, 1, 2, 3]
    assert list(written) == ["machine", "squares", "files"]
    assert written["squares"] == [0.0, 1.0, 4.0, 9.0]
    assert (tmp_path / "out" / "squares.png").read_bytes().startswith(b"\x89PNG")


def test_sizes_have_the_types_of_the_defaults(run):
    measure = importlib.import_module("squares").measure
    sizes = run.sizes_of(measure, ["count=5", "files=a.npz,b.npz", "factor=2"])
    assert sizes == {"count": 5, "files": ("a.npz", "b.npz"), "factor": 2.0}
    assert isinstance(sizes["factor"], float)
    with pytest.raises(SystemExit, match="--set side=3: admissible are count, files, factor"):
        run.sizes_of(measure, ["side=3"])


def test_tables_have_headings_of_keys_and_of_functions(run):
    rows = [{"n": 12345, "s": 0.012345, "name": "a"}, {"n": 2, "s": None, "name": "b"}]
    table = importlib.import_module("_common").table
    text = table(rows, {"name": "name", "count": "n", "s": "s", "double": lambda r: 2 * r["n"]})
    assert text.splitlines() == [
        "| name | count | s | double |",
        "| --- | --- | --- | --- |",
        "| a | 12,345 | 0.012 | 24,690 |",
        "| b | 2 |  | 4 |",
    ]


def test_every_benchmark_is_on_the_page_and_quick_sizes_are_sizes():
    """In a process of its own, as names of modules of examples stand for several files."""
    code = """
import importlib, inspect, run
files = {path.stem for path in run.FOLDER.glob("[!_]*.py")} - {"run"}
assert files == set(run.BENCHMARKS), files.symmetric_difference(run.BENCHMARKS)
for name in run.BENCHMARKS:
    benchmark = importlib.import_module(name)
    assert set(benchmark.QUICK) <= set(inspect.signature(benchmark.measure).parameters), name
"""
    subprocess.run([sys.executable, "-c", code], cwd=FOLDER, check=True)


@pytest.mark.slow
def test_the_command_measures_quickly(tmp_path):
    command = [sys.executable, str(FOLDER / "run.py"), "--quick", "prospect_speed", "many_scenes"]
    process = subprocess.run([*command, "--out", str(tmp_path)], capture_output=True, text=True, check=True)
    for name, title in (
        ("prospect_speed", "PROSPECT against prosail"),
        ("many_scenes", "a scene among many"),
    ):
        assert title in process.stdout
        assert json.loads((tmp_path / f"{name}.json").read_text())["machine"]["cores"]
        assert (tmp_path / f"{name}.png").exists()
