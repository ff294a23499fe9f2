"""Mutants of every kind of file that a reader takes: each is read well or refused by name, soon, in little
memory.

    python tests/fuzz.py                                      a few hundred mutants of each kind
    python tests/fuzz.py --text 4000 --binary 1000            all that the readers are held to
    python tests/fuzz.py las --first 17 --binary 1 --keep .   one mutant, and what was done to it

A mutant follows from its kind and its number. Half of the mutants of a kind are of small files that are
written here, half of the recorded files that lie beside the checkout, where they do. Each is read in a child
process (on Linux) that may take so much more memory and so much time; a child that dies is noticed and
replaced.
"""

import argparse
import collections
import dataclasses
import faulthandler
import io
import json
import math
import os
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
from fuzz_changes import Changed, Random, change_archive, change_bytes, change_hdf5, change_text

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
# What reading one mutant may take: s, and bytes beyond what the process had.
SECONDS, BYTES = 10.0, 2**28
# Mutants of each kind where no other number is asked for, and those that one child reads.
FEW = {"text": 400, "binary": 200}
PER_CHILD = 500
GOOD = ("read", "refused")


# -- small files of each kind ------------------------------------------------------------------------------


def small_vox() -> bytes:
    from test_readers import vox

    return vox().encode()


def small_qsm() -> bytes:
    from test_readers import QSM

    return QSM.encode()


def small_spectrum() -> bytes:
    return b"# soil\nwavelength,reflectance\n" + b"".join(b"%d,0.%d\n" % (w, w) for w in range(400, 900, 25))


def small_coefficients() -> bytes:
    names = "lambda nrefrac SAC_CHL SAC_CAR SAC_ANT SAC_BROWN SAC_EWT SAC_PROT SAC_CBC SAC_LMA"
    rows = (f"{w} 1.{w} 0.01 0.02 0.0 0.01 {w / 1e4} 4.5 2e-3 1" for w in range(400, 430))
    return "\n".join([names, *rows, ""]).encode()


def small_cloud(compress: bool, point_format: int = 6, points: int = 60) -> bytes:
    """With extra bytes, a record of its own and, from point format 6 on, one after the points."""
    import laspy
    from laspy.vlrs.vlrlist import VLRList

    version = "1.4" if point_format >= 6 else "1.3" if point_format >= 4 else "1.2"
    las = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
    las.header.scales = [0.001] * 3
    las.add_extra_dim(laspy.ExtraBytesParams("height", "f4", "above the ground"))
    las.header.vlrs.append(laspy.VLR("me", 7, "a record", bytes(40)))
    place = np.arange(points)
    las.x, las.y, las.z = place % 100, place // 100, place % 7
    las.classification, las.intensity, las.height = place % 6, place % 250, place % 7
    las.return_number = las.number_of_returns = np.ones(points, int)
    if point_format >= 6:
        las.evlrs = VLRList([laspy.VLR("me", 8, "another record", bytes(40))])
    file = io.BytesIO()
    las.write(file, do_compress=compress)
    return file.getvalue()


def small_gedi() -> bytes:
    from test_io import write_small

    with tempfile.TemporaryDirectory() as folder:
        return write_small(Path(folder) / "small.h5").read_bytes()


def small_neon() -> bytes:
    from test_neon import write_small

    with tempfile.TemporaryDirectory() as folder:
        return write_small(Path(folder) / "small.npz").read_bytes()


# -- what is good to be read -------------------------------------------------------------------------------


def finite(*arrays: Any) -> bool:
    """Whether all numbers are finite, also in single precision."""
    return all(np.all(np.abs(np.asarray(a, float)) < np.finfo(np.float32).max) for a in arrays)


def sound_voxels(read: Any) -> bool:
    leaf, size = np.asarray(read.voxels.leaf), np.asarray(read.voxels.voxel_size)
    return finite(leaf, size, read.voxels.origin) and bool(np.all(leaf >= 0) and np.all(size > 0))


def sound_tree(read: Any) -> bool:
    tree = read.tree
    return finite(tree.start, tree.end, tree.radius_start, tree.wood_volume, tree.height) and bool(
        np.all(tree.radius_start > 0) and np.all(tree.order >= 0) and np.all(tree.length > 0)
    )


def sound_spectrum(read: Any) -> bool:
    rho, wavelength = np.asarray(read.reflectance), np.asarray(read.wavelength)
    rising = np.all(np.diff(wavelength) > 0)
    return finite(rho, wavelength) and bool(rising and np.all((rho >= 0) & (rho <= 1)))


def sound_coefficients(read: Any) -> bool:
    rising = np.all(np.diff(read.wavelength) > 0)
    return finite(read.wavelength, read.index, read.absorption) and bool(
        rising and np.all(read.index >= 1) and np.all(read.absorption >= 0)
    )


def sound_cloud(read: Any) -> bool:
    return finite(read.position, read.intensity) and len({len(a) for a in read[:5]}) == 1


def sound_pulse(shot: Any) -> bool:
    power = shot.pulse_power
    has_energy = np.all(power >= 0) and np.float32(power.sum()) > 0
    return finite(shot.waveform, power, shot.pulse_time, shot.noise_mean, shot.noise_std) and bool(has_energy)


def sound_gedi(read: Any) -> bool:
    return all(
        sound_pulse(s)
        and finite(s.elevation, s.altitude, s.latitude, s.longitude)
        and np.allclose(np.diff(s.elevation), -0.1499 * np.cos(np.deg2rad(s.zenith)), rtol=0.03)
        for s in read
    )


def sound_neon(read: Any) -> bool:
    steps = [np.linalg.norm(np.diff(s.position, axis=0), axis=1) for s in read.shots]
    return (
        all(sound_pulse(s) and finite(s.position) for s in read.shots)
        and all(np.allclose(step, 0.1499, rtol=0.03) for step in steps)
        and finite(*read.impulse)
        and bool(np.sum(read.impulse.power) > 0 and np.sum(read.impulse.pulse_power) > 0)
    )


# -- the kinds ---------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of file: its reader, what makes small ones, what changes them, and what is good to be read.

    - `of`: "text" or "binary".
    - `recorded`: pattern of the recorded files.
    - `place`: pattern of what a refusal must say after the name of the file.
    """

    of: str
    reader: str
    ending: str
    small: tuple[Callable[[], bytes], ...]
    change: Callable[[Random, bytes], Changed]
    sound: Callable[[Any], bool]
    recorded: str = ""
    place: str = ": ."


def text(reader: str, ending: str, small: Callable[[], bytes], sound: Any, recorded: str = "") -> Kind:
    return Kind("text", reader, ending, (small,), change_text, sound, recorded, r"[:,].* line \d+")


def clouds(*arguments: tuple) -> tuple[Callable[[], bytes], ...]:
    return tuple(lambda a=a: small_cloud(*a) for a in arguments)


LAZ = clouds((True,), (True, 3), (True, 6, 120_000))
KINDS = {
    "vox": text("read_vox", ".vox", small_vox, sound_voxels, "voxels/*.vox"),
    "qsm": text("read_qsm", ".csv", small_qsm, sound_tree, "voxels/tree_qsm.csv"),
    "spectrum": text("read_spectrum_csv", ".csv", small_spectrum, sound_spectrum),
    "coefficients": text(
        "load_coefficients", ".txt", small_coefficients, sound_coefficients, "prospect/*.txt"
    ),
    "las": Kind(
        *("binary", "read_las", ".las", clouds((False,), (False, 3)), change_bytes, sound_cloud),
        recorded="voxels/*.las",
    ),
    "laz": Kind("binary", "read_las", ".laz", LAZ, change_bytes, sound_cloud),
    "gedi": Kind(
        *("binary", "read_gedi_l1b", ".h5", (small_gedi,), change_hdf5, sound_gedi), recorded="gedi/*.h5"
    ),
    "neon": Kind(
        *("binary", "read_neon", ".npz", (small_neon,), change_archive, sound_neon), recorded="neon/*.npz"
    ),
    # What is to be found, one mutant each.
    "planted": Kind(
        *("planted", "planted", ".bin", (lambda: b"",), lambda random, data: (data + b"1", "longer")),
        sound=lambda read: read != "nonsense",
    ),
}
PLANTED = ("read", "refused", "no place", "nonsense", "escaped", "memory", "hang", "abort")


def planted(path: Path) -> str:
    """Does what the number in the file's name asks for."""
    what = PLANTED[int(re.findall(r"\d+", path.name)[-1]) % len(PLANTED)]
    if what == "refused":
        raise ValueError(f"{path}: byte 0 is none")
    if what == "no place":
        raise ValueError("something is wrong")
    if what == "escaped":
        raise IndexError(f"{path}: there is none")
    if what == "memory":
        np.ones(BYTES)
    if what == "hang":
        time.sleep(10 * SECONDS)
    if what == "abort":
        os.abort()
    return what


def reader_of(kind: Kind) -> Callable[[Path], Any]:
    import jaxlidar
    import jaxlidar.io

    return next(
        getattr(place, kind.reader)
        for place in (jaxlidar.io, jaxlidar, sys.modules[__name__])
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
        command = [sys.executable, __file__, "--work", name, str(at), str(last)]
        with tempfile.TemporaryFile() as trace:
            child = subprocess.run(command, stdout=subprocess.PIPE, stderr=trace, check=False)
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
