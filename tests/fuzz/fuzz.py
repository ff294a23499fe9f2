"""Mutants of every kind of file that a reader takes: each is read well or refused by name, soon, in little
memory.

    python -m tests.fuzz.fuzz                                      a few hundred mutants of each kind
    python -m tests.fuzz.fuzz --text 4000 --binary 1000            all that the readers are held to
    python -m tests.fuzz.fuzz las --first 17 --binary 1 --keep .   one mutant, and what was done to it

A mutant follows from its kind and its number. Half of the mutants of a kind are of small files that are
written here, half of the recorded files that lie beside the checkout, where they do. Each is read in a child
process (on Linux) that may take so much more memory and so much time; a child that dies is noticed and
replaced.
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

from tests.fuzz.fuzz_kinds import BYTES, KINDS, SECONDS, Kind

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
# Mutants of each kind where no other number is asked for, and those that one child reads.
FEW = {"text": 400, "binary": 200}
PER_CHILD = 500
GOOD = ("read", "refused")


def reader_of(kind: Kind) -> Callable[[Path], Any]:
    import jaxlidar
    import jaxlidar.io
    from tests.fuzz import fuzz_kinds

    return next(
        getattr(place, kind.reader)
        for place in (jaxlidar.io, jaxlidar, fuzz_kinds)
        if hasattr(place, kind.reader)
    )


def mutants(name: str, first: int, last: int, recorded: bool = True) -> Iterator[tuple[int, bytes, str]]:
    """Number, content and description of mutants of a kind; `recorded`: also of those of recorded files."""
    kind = KINDS[name]
    bases = [make() for make in kind.small]
    if kind.recorded and SHARED.is_dir():
        bases += [path.read_bytes() for path in sorted(SHARED.glob(kind.recorded))] * len(bases)
    for number in range(first, last):
        if not recorded and number % len(bases) >= len(kind.small):
            continue
        random = np.random.default_rng([zlib.crc32(name.encode()), number])
        data, done = bases[number % len(bases)], []
        for _ in range(int(random.integers(1, 4))):
            data, said = kind.change(random, data)
            done.append(said)
        yield number, data, "; ".join(done)


# -- reading and hunting -----------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What came of a mutant: a verdict, which is one of `GOOD` or says what is wrong; what was said; what was
    done to the file; and the seconds and bytes that reading took, where the child lived to tell."""

    number: int
    verdict: str
    said: str
    done: str
    seconds: float = math.nan
    bytes: float = math.nan


def verdict(kind: Kind, read: Callable[[Path], Any], path: Path) -> tuple[str, str]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # Of files from NumPy for Python 2, which are read.
            warnings.filterwarnings("ignore", "Reading `.npy`")
            result = read(path)
    except ValueError as error:
        said = str(error)
        if not re.search(re.escape(path.name) + kind.place, said):
            return "no place", f"{type(error).__name__}: {said}"
        return "refused", said
    except MemoryError as error:
        return "memory", repr(error)
    except BaseException as error:
        return "escaped", f"{type(error).__module__}.{type(error).__name__}: {error}"
    with np.errstate(all="ignore"):
        return ("read", "") if kind.sound(result) else ("nonsense", str(result)[:300])


def work(name: str, first: int, last: int) -> None:
    """Reads mutants, and prints one line of JSON for each."""
    import resource

    kind = KINDS[name]
    read = reader_of(kind)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        for base in kind.small:
            path = Path(folder) / f"base-0{kind.ending}"
            path.write_bytes(base())
            read(path)
        for number, data, done in mutants(name, first, last):
            path = Path(folder) / f"{name}-{number}{kind.ending}"
            path.write_bytes(data)
            resource.setrlimit(resource.RLIMIT_AS, (memory("VmSize") + BYTES, resource.RLIM_INFINITY))
            # From here on, the high-water mark is that of this mutant.
            Path("/proc/self/clear_refs").write_text("5")
            before, began = memory("VmHWM"), time.perf_counter()
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            came = verdict(kind, read, path)
            faulthandler.cancel_dump_traceback_later()
            took = time.perf_counter() - began, memory("VmHWM") - before
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            path.unlink()
            print(json.dumps(Outcome(number, *came, done, *took)), flush=True)


def memory(what: str) -> int:
    """Bytes that this process has, by the kernel's name."""
    found = re.search(rf"{what}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found, what
    return 1024 * int(found[1])


def hunt(name: str, count: int, first: int = 0) -> list[Outcome]:
    """What came of `count` mutants of a kind."""
    found: list[Outcome] = []
    while len(found) < count:
        at, last = first + len(found), min(first + len(found) + PER_CHILD, first + count)
        command = [sys.executable, "-m", "tests.fuzz.fuzz", "--work", name, str(at), str(last)]
        with tempfile.TemporaryFile() as trace:
            child = subprocess.run(command, stdout=subprocess.PIPE, stderr=trace, check=False, cwd=ROOT)
            trace.seek(0)
            errors = trace.read().decode(errors="replace")
        found += [Outcome(*json.loads(line)) for line in child.stdout.splitlines()]
        hung = "Timeout" in errors
        if child.returncode > 0 and not hung:
            raise RuntimeError(f"the child failed: {errors[-2000:]}")
        if child.returncode:
            at = first + len(found)
            ((_, _, done),) = mutants(name, at, at + 1)
            said = f"exit status {child.returncode}: {errors[:300]}"
            found.append(Outcome(at, "hang" if hung else "abort", said, done))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    kinds = [name for name in KINDS if name != "planted"]
    parser.add_argument("kinds", nargs="*", default=kinds, metavar="KIND", help=", ".join(kinds))
    parser.add_argument("--text", type=int, default=FEW["text"], help="mutants of each kind of text file")
    parser.add_argument("--binary", type=int, default=FEW["binary"], help="mutants of each binary kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant")
    parser.add_argument(
        "--keep", type=Path, help="a folder for the mutants that are not read well or refused"
    )
    parser.add_argument("--work", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.work[0], int(given.work[1]), int(given.work[2]))
        return 0
    wrong = 0
    for name in given.kinds:
        outcomes = hunt(name, given.text if KINDS[name].of == "text" else given.binary, given.first)
        verdicts = ", ".join(f"{n} {v}" for v, n in collections.Counter(o.verdict for o in outcomes).items())
        longest, most = (max(getattr(o, what) for o in outcomes) for what in ("seconds", "bytes"))
        print(f"{name}: {verdicts}; at most {longest:.2f} s and {most / 2**20:.0f} MB", flush=True)
        for number, verdict, said, done, *_ in outcomes:
            if verdict in GOOD:
                continue
            wrong += 1
            print(f"  {name} {number}: {verdict}: {said}\n    {done}", flush=True)
            if given.keep:
                ((_, data, _),) = mutants(name, number, number + 1)
                (given.keep / f"{name}-{number}{KINDS[name].ending}").write_bytes(data)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
