"""Shared by the benchmarks: record of the machine, timing in turns, tables and atomic file writes."""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import matplotlib

from jaxlidar.io import atomic_write

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def options(description: str, **defaults: int) -> argparse.Namespace:
    """Parse the command line: `--out` for the folder, and an integer option for each of `defaults`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", default="figures", type=Path, help="folder of the results")
    for name, value in defaults.items():
        parser.add_argument(f"--{name}", default=value, type=int)
    return parser.parse_args()


def machine() -> dict[str, object]:
    """Return the hardware and software that times depend on, and the CPU time of the run so far.

    The operating system's share is large where a program asks for much memory anew in each call, as every
    page is then cleared.
    """
    times = os.times()
    user, system = times.user + times.children_user, times.system + times.children_system
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "device": str(jax.devices()[0]),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "CPU seconds": round(user + system, 1),
        "system share": round(system / (user + system), 3),
    }


def _processor() -> str:
    cpus = Path("/proc/cpuinfo")
    if cpus.exists():
        for line in cpus.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def seconds(function: Callable, *arguments) -> float:
    """Return the wall time of one call, until its results are computed."""
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def race(contestants: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Return the times of all contestants by rounds.

    Contestants take turns, so that other load of the machine slows all of them alike. Each runs once before,
    to compile.
    """
    for run in contestants.values():
        jax.block_until_ready(run())
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, run in contestants.items():
            times[name].append(seconds(run))
    return times


def best(times: Mapping[str, list[float]]) -> dict[str, float]:
    """Return the time of the fastest round of each."""
    return {name: min(values) for name, values in times.items()}


def write_json(path: Path, record: Mapping[str, object]) -> None:
    """Write a record, atomically."""
    with atomic_write(path) as draft:
        draft.write_text(json.dumps(record, indent=2) + "\n")


def new_figure(columns: int = 1, size: tuple[float, float] = (6, 4), rows: int = 1):
    """Return a figure and its axes."""
    return plt.subplots(rows, columns, figsize=size, layout="constrained")


def save_figure(figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    with atomic_write(path) as draft:
        figure.savefig(draft, dpi=150, format="png")
    plt.close(figure)


def print_table(header: tuple[str, ...], rows: list[tuple]) -> None:
    """Print rows below a header, numbers to three significant digits."""
    text = [header, *(tuple(f"{c:.3g}" if isinstance(c, float) else str(c) for c in row) for row in rows)]
    widths = [max(len(row[i]) for row in text) for i in range(len(header))]
    for n, row in enumerate(text):
        cells = [row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:]))]
        print("  ".join(cells).rstrip())
        if n == 0:
            print("  ".join("-" * w for w in widths))
