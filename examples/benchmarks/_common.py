"""The frame of the benchmarks: the machine, timing in turns, the record, the figure, and text in Markdown."""

import json
import os
import platform
import resource
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import jax
import matplotlib
import numpy as np

from jaxlidar.io import atomic_write

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator, NullFormatter

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def crown_extinction(n: int, height: float = 6.0) -> np.ndarray:
    """Return random extinction coefficients, 0.5 1/m on average, in a sphere of radius 3.5 m.

    - `n`: voxels along a side of a cube of 10 m. - `height`: of the middle of the sphere above the lowest
    voxels, m.
    """
    centres = 10.0 * (np.arange(n) + 0.5) / n
    x, y, z = np.meshgrid(centres, centres, centres, indexing="ij")
    inside = (x - 5.0) ** 2 + (y - 5.0) ** 2 + (z - height) ** 2 < 3.5**2
    return np.where(inside, np.random.default_rng(0).uniform(0.0, 1.0, inside.shape), 0.0)


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


def first_and_warm(run: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Return the seconds of the first call, which compiles, and of the fastest of `rounds` others."""
    return seconds(run), min(seconds(run) for _ in range(rounds))


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


def show_progress(state: object) -> None:
    """Print the state of a long run over the one before."""
    print(f"\r{state}", end="", flush=True)


def peak_gigabytes() -> float:
    """Return the largest memory that the process has taken so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def write_json(path: Path, record: Mapping[str, object]) -> None:
    """Write a record, atomically."""
    with atomic_write(path) as draft:
        draft.write_text(json.dumps(record, indent=2) + "\n")


def new_figure(columns: int = 1, size: tuple[float, float] = (6, 4), rows: int = 1):
    """Return a figure and its axes."""
    return plt.subplots(rows, columns, figsize=size, layout="constrained")


def label_log_axis(axis, *digits: int) -> None:
    """Label an axis of few powers of ten at these digits of each, with plain numbers."""
    axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def save_figure(figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    with atomic_write(path) as draft:
        figure.savefig(draft, dpi=150, format="png")
    plt.close(figure)


def number(x: float | None, digits: int = 2) -> str:
    """Format a number with some significant digits; an empty string for None."""
    if x is None:
        return ""
    short = f"{x:.{digits}g}"
    return f"{float(short):,g}" if 1e-3 <= abs(x) < 1e6 else short


def percent(fraction: float, digits: int = 2) -> str:
    """Format a fraction in percent, with some significant digits."""
    return f"{number(100 * fraction, digits)} %"


def table(rows: Iterable, columns: Mapping[str, str | Mapping | Callable]) -> str:
    """Return a table in Markdown.

    `columns`: by heading the key of the rows, the values by row, or a function of a row. Integers are written
    in full, other numbers with two significant digits.
    """

    def cell(row, column: str | Mapping | Callable) -> str:
        if isinstance(column, str):
            value = row[column]
        elif isinstance(column, Mapping):
            value = column[row]
        else:
            value = column(row)
        if isinstance(value, int):
            return f"{value:,}"
        return value if isinstance(value, str) else number(value)

    lines = [[cell(row, column) for column in columns.values()] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in (columns, ["---"] * len(columns), *lines))


def page_of(*paragraphs: str) -> str:
    """Join paragraphs and tables by empty lines."""
    return "\n\n".join(paragraphs)
