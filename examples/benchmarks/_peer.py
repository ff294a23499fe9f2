"""Workers that measure another code in a process of their own: tasks, repetitions and results."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def run_peer(worker: str, task: Mapping[str, Any]) -> dict[str, np.ndarray] | str:
    """Run a worker on the arrays of a task; return its arrays, or the reason of its failure."""
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder, name)) for name in ("task.npz", "result.npz")]
        np.savez(files[0], **task)
        command = [sys.executable, str(Path(__file__).with_name(worker)), *files]
        process = subprocess.run(command, capture_output=True, text=True, errors="replace")
        if Path(files[1]).exists():
            return dict(np.load(files[1]))
    lines = (process.stderr.strip() or process.stdout.strip() or "no message").splitlines()
    reason = next((line for line in lines if line.startswith("error:")), "")
    return "; ".join(filter(None, (lines[-1], reason, f"exit status {process.returncode}")))


def read_task() -> dict[str, np.ndarray]:
    """Return the task of this worker, whose file the command line names first."""
    return dict(np.load(sys.argv[1]))


def write_result(**arrays) -> None:
    """Write the arrays that this worker returns, to the file that the command line names last."""
    np.savez(sys.argv[2], **arrays)


def repeated(function: Callable[[int], object], repeats: int) -> tuple[list, np.ndarray, float]:
    """Call a function with 0, 1, 2 ... as its seed, once more than `repeats` as the first call compiles.

    Returns the results of all but the first call, their seconds of wall and CPU time (repeats, 2), and the
    wall time of the first call.
    """
    results, times = [], []
    for seed in range(repeats + 1):
        wall_start, cpu_start = time.perf_counter(), time.process_time()
        results.append(function(seed))
        times.append((time.perf_counter() - wall_start, time.process_time() - cpu_start))
    return results[1:], np.array(times[1:]), times[0][0]


def repeated_gradient(simulation: Callable, gradient: Callable, repeats: int) -> dict[str, object]:
    """Return the times of a simulation and of its gradient, and totals and gradients by `gradient`."""
    _, simulation_times, simulation_first = repeated(simulation, repeats)
    results, gradient_times, gradient_first = repeated(gradient, repeats)
    return {
        "simulation_times": simulation_times,
        "simulation_first": simulation_first,
        "gradient_times": gradient_times,
        "gradient_first": gradient_first,
        "totals": np.array([total for total, _ in results]),
        "gradients": np.array([slopes for _, slopes in results], np.float32),
    }
