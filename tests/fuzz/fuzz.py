"""Fuzzing of the file readers with mutants, which are valid files with a few random changes.

A reader has to do one of two things with a mutant: read it, if the result is plausible, or refuse it with a
`ValueError` that names the file and the place of the fault. It has to do so within limits of time and memory.

    python -m tests.fuzz.fuzz                                      a few hundred mutants of each kind of file
    python -m tests.fuzz.fuzz --text 4000 --binary 1000            as many as a reader must pass in total
    python -m tests.fuzz.fuzz las --first 17 --binary 1 --keep .   reproduce one mutant and write it to a file

A mutant is determined by its kind of file and its number. The files that are changed are small ones, which
are written here, and recorded ones from the folder of reference data, if it lies beside the checkout. Mutants
are read in a child process (on Linux only), for which the operating system limits the memory and a timer
limits the time. A child process that dies is noticed and replaced.
"""

import argparse
import collections
import faulthandler
import json
import math
import re
import subprocess
import sys
import tempfile
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.fuzz.fuzz_kinds import KINDS, MAX_BYTES, MAX_SECONDS, FileKind

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
# Number of mutants of each kind of file by default, for text and for binary files.
DEFAULT_COUNTS = {"text": 400, "binary": 200}
MUTANTS_PER_CHILD = 500
GOOD_VERDICTS = ("read", "refused")


def reader_of(kind: FileKind) -> Callable[[Path], Any]:
    """Return the function that reads a kind of file, from the package or from `fuzz_kinds`."""
    import jaxlidar
    import jaxlidar.io
    from tests.fuzz import fuzz_kinds

    return next(
        getattr(namespace, kind.reader)
        for namespace in (jaxlidar.io, jaxlidar, fuzz_kinds)
        if hasattr(namespace, kind.reader)
    )


def mutants(name: str, first: int, last: int, recorded: bool = True) -> Iterator[tuple[int, bytes, str]]:
    """Generate mutants of a kind of file: number, content, and a description of the changes.

    Without `recorded`, mutants of recorded files are skipped; the numbers of the others stay the same.
    """
    kind = KINDS[name]
    originals = [make() for make in kind.small_files]
    if kind.recorded and SHARED.is_dir():
        # Once for each small file: where one file is recorded, it is the original of half of the mutants.
        paths = sorted(SHARED.glob(kind.recorded))
        originals += [path.read_bytes() for path in paths] * len(originals)
    for number in range(first, last):
        if not recorded and number % len(originals) >= len(kind.small_files):
            continue
        random = np.random.default_rng([zlib.crc32(name.encode()), number])
        content, changes = originals[number % len(originals)], []
        for _ in range(int(random.integers(1, 4))):
            content, change = kind.change(random, content)
            changes.append(change)
        yield number, content, "; ".join(changes)


# -- reading mutants ---------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """Result of reading one mutant.

    - `number`: number of the mutant.
    - `verdict`: one of `GOOD_VERDICTS`, or the name of a fault of the reader.
    - `message`: the error message, or the implausible result.
    - `changes`: description of the changes that made the mutant.
    - `seconds`, `bytes`: time and memory that reading took; NaN if the child process died.
    """

    number: int
    verdict: str
    message: str
    changes: str
    seconds: float = math.nan
    bytes: float = math.nan


def read_and_judge(kind: FileKind, read: Callable[[Path], Any], path: Path) -> tuple[str, str]:
    """Read a file in this process and return the verdict and the message of its `Outcome`.

    Verdicts: "read" (the result is plausible), "refused" (a `ValueError` names the file and the place), "no
    place" (a `ValueError` does not), "nonsense" (the result is not plausible), "memory" (too much was
    allocated), "escaped" (an error of another class). A warning is an error here, but for a `UnitWarning`:
    that is what the package says of a value that it reads, which may be anything.
    """
    from jaxlidar import UnitWarning

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", UnitWarning)
            # NumPy warns of headers that NumPy for Python 2 wrote; such files are valid.
            warnings.filterwarnings("ignore", "Reading `.npy`")
            result = read(path)
    except ValueError as error:
        message = str(error)
        if not re.search(re.escape(path.name) + kind.place, message):
            return "no place", f"{type(error).__name__}: {message}"
        return "refused", message
    except MemoryError as error:
        return "memory", repr(error)
    except BaseException as error:
        return "escaped", f"{type(error).__module__}.{type(error).__name__}: {error}"
    with np.errstate(all="ignore"):
        return ("read", "") if kind.is_plausible(result) else ("nonsense", str(result)[:300])


def read_mutants_in_child(name: str, first: int, last: int) -> None:
    """Read mutants and print the outcome of each as a line of JSON; this runs in the child process."""
    import resource

    kind = KINDS[name]
    read = reader_of(kind)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        # The unchanged files are read first, as imports and compilation do not count for any mutant.
        for make in kind.small_files:
            path = Path(folder) / f"unchanged-0{kind.suffix}"
            path.write_bytes(make())
            read(path)
        for number, content, changes in mutants(name, first, last):
            path = Path(folder) / f"{name}-{number}{kind.suffix}"
            path.write_bytes(content)
            limit = memory_use("VmSize") + MAX_BYTES
            resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
            # Writing 5 resets the high-water mark VmHWM, which then is that of this mutant alone.
            Path("/proc/self/clear_refs").write_text("5")
            memory_before, start_time = memory_use("VmHWM"), time.perf_counter()
            # No exception interrupts a reader that hangs in compiled code: the process has to end.
            faulthandler.dump_traceback_later(MAX_SECONDS, exit=True)
            verdict, message = read_and_judge(kind, read, path)
            faulthandler.cancel_dump_traceback_later()
            elapsed, peak = time.perf_counter() - start_time, memory_use("VmHWM") - memory_before
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            path.unlink()
            print(json.dumps(Outcome(number, verdict, message, changes, elapsed, peak)), flush=True)


def memory_use(field: str) -> int:
    """Return a memory statistic of this process in bytes; `field` is its name in /proc/self/status."""
    match = re.search(rf"{field}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert match, field
    return 1024 * int(match[1])


def fuzz_reader(name: str, count: int, first: int = 0) -> list[Outcome]:
    """Read `count` mutants of a kind of file in child processes and return their outcomes."""
    outcomes: list[Outcome] = []
    while len(outcomes) < count:
        start = first + len(outcomes)
        last = min(start + MUTANTS_PER_CHILD, first + count)
        command = [sys.executable, "-m", "tests.fuzz.fuzz", "--child", name, str(start), str(last)]
        with tempfile.TemporaryFile() as stderr:
            child = subprocess.run(command, stdout=subprocess.PIPE, stderr=stderr, check=False, cwd=ROOT)
            stderr.seek(0)
            errors = stderr.read().decode(errors="replace")
        outcomes += [Outcome(*json.loads(line)) for line in child.stdout.splitlines()]
        timed_out = "Timeout" in errors
        if child.returncode > 0 and not timed_out:
            raise RuntimeError(f"the child failed: {errors[-2000:]}")
        if child.returncode:
            # The child died of the mutant after the last one that it reported.
            number = first + len(outcomes)
            ((_, _, changes),) = mutants(name, number, number + 1)
            message = f"exit status {child.returncode}: {errors[:300]}"
            outcomes.append(Outcome(number, "hang" if timed_out else "abort", message, changes))
    return outcomes


def main() -> int:
    """Run the command line and return its exit status: 1 if a mutant has a verdict that is not good."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    kinds = [name for name in KINDS if name != "planted"]
    parser.add_argument("kinds", nargs="*", default=kinds, metavar="KIND", help=", ".join(kinds))
    parser.add_argument(
        "--text", type=int, default=DEFAULT_COUNTS["text"], help="mutants of each kind of text file"
    )
    parser.add_argument(
        "--binary", type=int, default=DEFAULT_COUNTS["binary"], help="mutants of each kind of binary file"
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant")
    parser.add_argument(
        "--keep", type=Path, help="folder for the mutants that are neither read well nor refused"
    )
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        name, first, last = options.child
        read_mutants_in_child(name, int(first), int(last))
        return 0
    n_faults = 0
    for name in options.kinds:
        count = options.text if KINDS[name].format == "text" else options.binary
        outcomes = fuzz_reader(name, count, options.first)
        verdicts = collections.Counter(outcome.verdict for outcome in outcomes)
        summary = ", ".join(f"{n} {verdict}" for verdict, n in verdicts.items())
        max_seconds = max(outcome.seconds for outcome in outcomes)
        max_bytes = max(outcome.bytes for outcome in outcomes)
        print(f"{name}: {summary}; at most {max_seconds:.2f} s and {max_bytes / 2**20:.0f} MB", flush=True)
        for outcome in outcomes:
            if outcome.verdict in GOOD_VERDICTS:
                continue
            n_faults += 1
            print(f"  {name} {outcome.number}: {outcome.verdict}: {outcome.message}", flush=True)
            print(f"    {outcome.changes}", flush=True)
            if options.keep:
                ((_, content, _),) = mutants(name, outcome.number, outcome.number + 1)
                (options.keep / f"{name}-{outcome.number}{KINDS[name].suffix}").write_bytes(content)
    return int(n_faults > 0)


if __name__ == "__main__":
    sys.exit(main())
