"""Kinds of files for fuzz.py: small files of each, their readers, what changes them, what is well read."""

import dataclasses
import functools
import io
import os
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.fuzz_changes import Changed, Random, change_archive, change_bytes, change_hdf5, change_text

# What reading one mutant may take: s, and bytes beyond what the process had.
SECONDS, BYTES = 10.0, 2**28

# -- small files of each kind ------------------------------------------------------------------------------


def small_vox() -> bytes:
    from tests.io.test_readers import vox

    return vox().encode()


def small_qsm() -> bytes:
    from tests.io.test_readers import QSM

    return QSM.encode()


def small_obj() -> bytes:
    from tests.plants.test_meshes import OBJ

    return OBJ.encode()


def small_spectrum() -> bytes:
    return b"# soil\nwavelength,reflectance\n" + b"".join(b"%d,0.%d\n" % (w, w) for w in range(400, 900, 25))


def small_grid() -> bytes:
    head = "ncols 4\nnrows 3\nxllcorner 600000\nyllcorner 5200000\ncellsize 10\nnodata_value -9999\n"
    return (head + "1.5 2 3.25 4\n5 6 7 8\n9 10 11 12e-1\n").encode()


def small_tiff() -> bytes:
    import rasterio

    heights = np.arange(20.0, dtype="float32").reshape(5, 4)
    profile = {"driver": "GTiff", "width": 4, "height": 5, "count": 1, "dtype": "float32", "nodata": -9999.0}
    profile |= {"crs": "EPSG:32632", "transform": rasterio.Affine(10.0, 0.0, 6e5, 0.0, -10.0, 5.2e6)}
    with rasterio.MemoryFile() as memory:
        with memory.open(**profile) as file:
            file.write(heights, 1)
        return memory.read()


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
    from tests.io.test_gedi import write_small

    with tempfile.TemporaryDirectory() as folder:
        return write_small(Path(folder) / "small.h5").read_bytes()


def small_neon() -> bytes:
    from tests.io.test_neon import write_small

    with tempfile.TemporaryDirectory() as folder:
        return write_small(Path(folder) / "small.npz").read_bytes()


@functools.cache
def small_pulses(which: int) -> bytes:
    """Of the two files, that of the pulses (0) or of their waves (1)."""
    from tests.io.test_pulsewaves import small_files

    return small_files()[which]


@functools.cache
def small_packets(which: int) -> bytes:
    """Of the two files, that of the points (0) or of their packets (1)."""
    from tests.io.test_las_waveforms import small_files

    with tempfile.TemporaryDirectory() as folder:
        return small_files(Path(folder))[which]


def with_other(path: Path, reader: str, ending: str, small: Callable[[int], bytes], which: int) -> list[Any]:
    """All shots of two files, of which `path` is the one that was changed."""
    import jaxlidar.io

    other = path.with_suffix(ending)
    other.write_bytes(small(1 - which))
    try:
        return list(getattr(jaxlidar.io, reader)((path, other)[which]))
    finally:
        other.unlink()


def read_pls(path: Path) -> list[Any]:
    return with_other(path, "read_pulsewaves", ".wvs", small_pulses, 0)


def read_wvs(path: Path) -> list[Any]:
    return with_other(path, "read_pulsewaves", ".pls", small_pulses, 1)


def read_packet_points(path: Path) -> list[Any]:
    return with_other(path, "read_las_waveforms", ".wdp", small_packets, 0)


def read_wdp(path: Path) -> list[Any]:
    return with_other(path, "read_las_waveforms", ".las", small_packets, 1)


# -- what is good to be read -------------------------------------------------------------------------------


def finite(*arrays: Any) -> bool:
    """Whether all numbers are finite, also in single precision."""
    return all(np.all(np.abs(np.asarray(a, float)) < np.finfo(np.float32).max) for a in arrays)


def sound_voxels(read: Any) -> bool:
    leaf, size = np.asarray(read.voxels.leaf), np.asarray(read.voxels.voxel_size)
    return finite(leaf, size, read.voxels.origin) and bool(np.all(leaf >= 0) and np.all(size > 0))


def sound_terrain(read: Any) -> bool:
    terrain = read.terrain
    return finite(terrain.heights, terrain.spacing, terrain.origin) and bool(np.all(terrain.spacing > 0))


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


def sound_shots(read: Any) -> bool:
    return bool(read) and all(
        finite(s.waveform, s.position * s.metres, s.time, s.zenith, s.noise_mean, s.noise_std)
        and np.all(np.diff(s.time) > 0)
        and np.allclose(np.linalg.norm(s.direction * s.metres), 0.1499, rtol=0.02)
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


def sound_mesh(read: Any) -> bool:
    return finite(read.mesh.vertices) and bool(np.all(read.mesh.area > 0))


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


LINE = r"[:,].* line \d+"


def text(
    reader: str, ending: str, small: Callable[[], bytes], sound: Any, recorded: str = "", place: str = LINE
) -> Kind:
    return Kind("text", reader, ending, (small,), change_text, sound, recorded, place)


def clouds(*arguments: tuple) -> tuple[Callable[[], bytes], ...]:
    return tuple(lambda a=a: small_cloud(*a) for a in arguments)


LAZ = clouds((True,), (True, 3), (True, 6, 120_000))
KINDS = {
    "vox": text("read_vox", ".vox", small_vox, sound_voxels, "voxels/*.vox"),
    "obj": text("read_obj", ".obj", small_obj, sound_mesh),
    "qsm": text("read_qsm", ".csv", small_qsm, sound_tree, "voxels/tree_qsm.csv"),
    "grid": text("read_dem", ".asc", small_grid, sound_terrain, place=rf"{LINE}|.* x = .*, y = "),
    "tiff": Kind("binary", "read_dem", ".tif", (small_tiff,), change_bytes, sound_terrain),
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
    **{
        name: Kind(
            "binary",
            reader,
            ending,
            (lambda m=make, w=which: m(w),),
            change_bytes,
            sound_shots,
            place=r"|\.\w+: .",
        )
        for name, reader, ending, make, which in (
            ("pls", "read_pls", ".pls", small_pulses, 0),
            ("wvs", "read_wvs", ".wvs", small_pulses, 1),
            ("packet points", "read_packet_points", ".las", small_packets, 0),
            ("wdp", "read_wdp", ".wdp", small_packets, 1),
        )
    },
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
