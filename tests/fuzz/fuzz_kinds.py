"""Kinds of files that fuzz.py tests.

`KINDS` names, for each kind, the reader, functions that make small valid files, the function that changes a
file, and the function that judges whether a result is plausible.
"""

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

# Limits of reading one mutant: seconds, and bytes in addition to those that the process has before.
MAX_SECONDS, MAX_BYTES = 10.0, 2**28

# -- small files of each kind ------------------------------------------------------------------------------


def small_vox() -> bytes:
    from tests.formats.test_readers import vox

    return vox().encode()


def small_qsm() -> bytes:
    from tests.formats.test_readers import QSM

    return QSM.encode()


def small_trajectory() -> bytes:
    rows = (b"%d.5,500%d,52000%d,812,1.5,-2,35%d\n" % (i, i, i, i) for i in range(8))
    return b"GPSTime,Easting,Northing,Height,Roll,Pitch,Heading\n" + b"".join(rows)


def small_inventory() -> bytes:
    rows = (b"beech,%d.5,1%d,2%d.1,0.%d5,%d,\n" % (i, i, i, i, i + 3) for i in range(8))
    return b"species,x,y,height,dbh,crown,remarks\n" + b"".join(rows)


def small_obj() -> bytes:
    from tests.plants.test_meshes import OBJ

    return OBJ.encode()


def small_mesh(file_type: str) -> bytes:
    import trimesh

    content = trimesh.creation.box().export(file_type=file_type)
    return content.encode() if isinstance(content, str) else content


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
    """Return a LAS file (or LAZ, if `compress`) of some points.

    It has an extra dimension, a variable length record and, from point format 6 on, an extended one, which
    lies after the points.
    """
    import laspy
    from laspy.vlrs.vlrlist import VLRList

    version = "1.4" if point_format >= 6 else "1.3" if point_format >= 4 else "1.2"
    las = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
    las.header.scales = np.full(3, 0.001)
    las.add_extra_dim(laspy.ExtraBytesParams("height", "f4", "above the ground"))
    las.header.vlrs.append(laspy.VLR("me", 7, "a record", bytes(40)))
    index = np.arange(points)
    las.x, las.y, las.z = index % 100, index // 100, index % 7
    las.classification, las.intensity, las.height = index % 6, index % 250, index % 7
    las.return_number = las.number_of_returns = np.ones(points, int)
    if point_format >= 6:
        las.evlrs = VLRList([laspy.VLR("me", 8, "another record", bytes(40))])
    file = io.BytesIO()
    las.write(file, do_compress=compress)
    return file.getvalue()


def small_gedi() -> bytes:
    from tests.formats.test_gedi import write_small

    with tempfile.TemporaryDirectory() as folder:
        return write_small(Path(folder) / "small.h5").read_bytes()


def small_level_2(kind: str) -> bytes:
    from tests.formats.test_gedi_level2 import write_level_2

    with tempfile.TemporaryDirectory() as folder:
        return write_level_2(Path(folder) / "small.h5", kind).read_bytes()


def small_icesat2(writer: str, **options: bool) -> bytes:
    from tests.formats import test_icesat2

    with tempfile.TemporaryDirectory() as folder:
        return getattr(test_icesat2, writer)(Path(folder) / "small.h5", **options).read_bytes()


def small_lvis() -> bytes:
    from tests.formats.test_lvis import write_level_1

    with tempfile.TemporaryDirectory() as folder:
        return write_level_1(Path(folder) / "small.h5", 2).read_bytes()


def small_lvis_text() -> bytes:
    names = "# LFID SHOTNUMBER TIME GLON GLAT ZG ZH ZT RH50 RH98"
    rows = "57 7 6e4 285.5 45 300.25 312 320 4.5 18.5\n57 8 6e4 285 45 301 312 320 4 18"
    return f"# LVIS\n{names}\n{rows}\n".encode()


def small_neon() -> bytes:
    from tests.formats.test_neon import write_small

    with tempfile.TemporaryDirectory() as folder:
        return write_small(Path(folder) / "small.npz").read_bytes()


@functools.cache
def small_pulsewaves(index: int) -> bytes:
    """Return one of the two files of a PulseWaves record: the pulses (0) or their waves (1)."""
    from tests.formats.test_pulsewaves import small_files

    return small_files()[index]


@functools.cache
def small_las_waveforms(index: int) -> bytes:
    """Return one of the two files of LAS with waveforms: the points (0) or their packets (1)."""
    from tests.formats.test_las_waveforms import small_files

    with tempfile.TemporaryDirectory() as folder:
        return small_files(Path(folder))[index]


def read_pair(path: Path, index: int, reader: str, make: Callable[[int], bytes], suffix: str) -> list[Any]:
    """Read all shots of a record of two files, one of which is a mutant.

    `path` is that of the mutant and `index` its index among the two. The file of the other index, which has
    the name of the mutant with another `suffix`, is made here and not changed.
    """
    import jaxlidar.io

    unchanged = path.with_suffix(suffix)
    unchanged.write_bytes(make(1 - index))
    try:
        # A reader is called with the path of the first file, and looks for the second one beside it.
        return list(getattr(jaxlidar.io, reader)((path, unchanged)[index]))
    finally:
        unchanged.unlink()


def read_lvis_shots(path: Path) -> list[Any]:
    import jaxlidar.io

    return list(jaxlidar.io.read_lvis_l1b(path))


def read_atl08_at_20_m(path: Path) -> Any:
    import jaxlidar.io

    return jaxlidar.io.read_atl08(path, segment=20.0)


def read_pls(path: Path) -> list[Any]:
    return read_pair(path, 0, "read_pulsewaves", small_pulsewaves, ".wvs")


def read_wvs(path: Path) -> list[Any]:
    return read_pair(path, 1, "read_pulsewaves", small_pulsewaves, ".pls")


def read_packet_points(path: Path) -> list[Any]:
    return read_pair(path, 0, "read_las_waveforms", small_las_waveforms, ".wdp")


def read_wdp(path: Path) -> list[Any]:
    return read_pair(path, 1, "read_las_waveforms", small_las_waveforms, ".las")


# -- plausible results -------------------------------------------------------------------------------------


def finite(*arrays: Any) -> bool:
    """True if all numbers are finite, in single precision as well."""
    return all(np.all(np.abs(np.asarray(a, float)) < np.finfo(np.float32).max) for a in arrays)


def plausible_voxels(result: Any) -> bool:
    leaf, size = np.asarray(result.voxels.leaf), np.asarray(result.voxels.voxel_size)
    return finite(leaf, size, result.voxels.origin) and bool(np.all(leaf >= 0) and np.all(size > 0))


def plausible_terrain(result: Any) -> bool:
    terrain = result.terrain
    return finite(terrain.heights, terrain.spacing, terrain.origin) and bool(np.all(terrain.spacing > 0))


def plausible_tree(result: Any) -> bool:
    tree = result.tree
    return finite(tree.start, tree.end, tree.radius_start, tree.wood_volume, tree.height) and bool(
        np.all(tree.radius_start > 0) and np.all(tree.order >= 0) and np.all(tree.length > 0)
    )


def plausible_trajectory(result: Any) -> bool:
    angles = (result.roll, result.pitch, result.yaw)
    return finite(result.time, result.position, *angles) and bool(np.all(np.diff(result.time) > 0))


def plausible_inventory(result: Any) -> bool:
    return finite(result.x, result.y, result.height) and bool(np.all(result.height > 0))


def plausible_spectrum(result: Any) -> bool:
    rho, wavelength = np.asarray(result.reflectance), np.asarray(result.wavelength)
    rising = np.all(np.diff(wavelength) > 0)
    return finite(rho, wavelength) and bool(rising and np.all((rho >= 0) & (rho <= 1)))


def plausible_coefficients(result: Any) -> bool:
    rising = np.all(np.diff(result.wavelength) > 0)
    return finite(result.wavelength, result.index, result.absorption) and bool(
        rising and np.all(result.index >= 1) and np.all(result.absorption >= 0)
    )


def plausible_cloud(result: Any) -> bool:
    return finite(result.position, result.intensity) and len({len(a) for a in result[:5]}) == 1


def plausible_pulse(shot: Any) -> bool:
    power = shot.pulse_power
    has_energy = np.all(power >= 0) and np.float32(power.sum()) > 0
    return finite(shot.waveform, power, shot.pulse_time, shot.noise_mean, shot.noise_std) and bool(has_energy)


def plausible_gedi(result: Any) -> bool:
    return all(
        plausible_pulse(s)
        and finite(s.elevation, s.altitude, s.latitude, s.longitude)
        and np.allclose(np.diff(s.elevation), -0.1499 * np.cos(np.deg2rad(s.zenith)), rtol=0.03)
        for s in result
    )


def plausible_shots(result: Any) -> bool:
    return bool(result) and all(
        finite(s.waveform, s.position * s.metres, s.time, s.zenith, s.noise_mean, s.noise_std)
        and np.all(np.diff(s.time) > 0)
        and np.allclose(np.linalg.norm(s.direction * s.metres), 0.1499, rtol=0.02)
        for s in result
    )


def plausible_table(result: Any) -> bool:
    lengths = {len(result[name]) for name in result}
    return len(lengths) == 1


def plausible_track(result: Any) -> bool:
    per_photon = (
        result.distance,
        result.height,
        result.time,
        result.pulse,
        result.confidence,
        result.segment,
    )
    return (
        finite(result.distance, result.height, result.segment_start)
        and {len(column) for column in per_photon} == {len(result)}
        and bool(np.all((result.segment >= 0) & (result.segment < len(result.segment_id))))
    )


def plausible_neon(result: Any) -> bool:
    steps = [np.linalg.norm(np.diff(s.position, axis=0), axis=1) for s in result.shots]
    return (
        all(plausible_pulse(s) and finite(s.position) for s in result.shots)
        and all(np.allclose(step, 0.1499, rtol=0.03) for step in steps)
        and finite(*result.impulse)
        and bool(np.sum(result.impulse.power) > 0 and np.sum(result.impulse.pulse_power) > 0)
    )


def plausible_mesh(result: Any) -> bool:
    return finite(result.mesh.vertices) and bool(np.all(result.mesh.area > 0))


# -- the kinds ---------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class FileKind:
    """A kind of file.

    - `format`: "text" or "binary".
    - `reader`: name of the function that reads it.
    - `suffix`: ending of the name of the file.
    - `small_files`: functions that make small valid files.
    - `change`: changes the content of a file at random.
    - `is_plausible`: True if what the reader returned may be the content of a valid file.
    - `recorded`: glob pattern of recorded files in the folder of reference data; "" for none.
    - `place`: regular expression that must match in an error message after the name of the file.
    """

    format: str
    reader: str
    suffix: str
    small_files: tuple[Callable[[], bytes], ...]
    change: Callable[[Random, bytes], Changed]
    is_plausible: Callable[[Any], bool]
    recorded: str = ""
    place: str = ": ."


LINE = r"[:,].* line \d+"


def text_kind(
    reader: str,
    suffix: str,
    make: Callable[[], bytes],
    is_plausible: Callable[[Any], bool],
    recorded: str = "",
    place: str = LINE,
) -> FileKind:
    """Return a kind of text file, of which an error message names the line."""
    return FileKind("text", reader, suffix, (make,), change_text, is_plausible, recorded, place)


def small_clouds(*arguments: tuple) -> tuple[Callable[[], bytes], ...]:
    """Return functions that call `small_cloud` with different arguments."""
    return tuple(lambda a=a: small_cloud(*a) for a in arguments)


# The last one has several chunks of compressed points.
LAZ = small_clouds((True,), (True, 3), (True, 6, 120_000))
KINDS = {
    "vox": text_kind("read_vox", ".vox", small_vox, plausible_voxels, "voxels/*.vox"),
    "obj": text_kind("read_mesh", ".obj", small_obj, plausible_mesh),
    **{
        name: FileKind(
            "binary",
            "read_mesh",
            f".{name}",
            (lambda name=name: small_mesh(name), *more),
            change_bytes,
            plausible_mesh,
        )
        for name, more in (
            ("ply", ()),
            ("stl", (lambda: small_mesh("stl_ascii"),)),
            ("glb", ()),
        )
    },
    "qsm": text_kind("read_qsm", ".csv", small_qsm, plausible_tree, "voxels/tree_qsm.csv"),
    "trajectory": text_kind("read_trajectory", ".csv", small_trajectory, plausible_trajectory),
    "inventory": text_kind("read_inventory", ".csv", small_inventory, plausible_inventory),
    "grid": text_kind("read_dem", ".asc", small_grid, plausible_terrain, place=rf"{LINE}|.* x = .*, y = "),
    "tiff": FileKind("binary", "read_dem", ".tif", (small_tiff,), change_bytes, plausible_terrain),
    "spectrum": text_kind("read_spectrum_csv", ".csv", small_spectrum, plausible_spectrum),
    "coefficients": text_kind(
        "load_coefficients", ".txt", small_coefficients, plausible_coefficients, "prospect/*.txt"
    ),
    "las": FileKind(
        *("binary", "read_las", ".las", small_clouds((False,), (False, 3)), change_bytes, plausible_cloud),
        recorded="voxels/*.las",
    ),
    "laz": FileKind("binary", "read_las", ".laz", LAZ, change_bytes, plausible_cloud),
    "gedi": FileKind(
        *("binary", "read_gedi_l1b", ".h5", (small_gedi,), change_hdf5, plausible_gedi), recorded="gedi/*.h5"
    ),
    **{
        name: FileKind("binary", reader, ".h5", (make,), change_hdf5, is_plausible)
        for name, reader, make, is_plausible in (
            ("gedi 2a", "read_gedi_l2a", lambda: small_level_2("2A"), plausible_table),
            ("gedi 2b", "read_gedi_l2b", lambda: small_level_2("2B"), plausible_table),
            ("atl08", "read_atl08", lambda: small_icesat2("write_heights"), plausible_table),
            ("atl08 at 20 m", "read_atl08_at_20_m", lambda: small_icesat2("write_heights"), plausible_table),
            ("lvis", "read_lvis_shots", small_lvis, plausible_shots),
        )
    },
    "atl03": FileKind(
        *("binary", "read_atl03", ".h5"),
        tuple(lambda has=has: small_icesat2("write_photons", impulse=has) for has in (False, True)),
        change_hdf5,
        plausible_track,
    ),
    "lvis text": text_kind(
        "read_lvis_l2", ".txt", small_lvis_text, plausible_table, place=rf"{LINE}|: no line begins"
    ),
    "neon": FileKind(
        *("binary", "read_neon", ".npz", (small_neon,), change_archive, plausible_neon), recorded="neon/*.npz"
    ),
    **{
        name: FileKind(
            "binary",
            reader,
            suffix,
            (lambda make=make, index=index: make(index),),
            change_bytes,
            plausible_shots,
            # The message names the mutant, or the unchanged file beside it.
            place=r"|\.\w+: .",
        )
        for name, reader, suffix, make, index in (
            ("pls", "read_pls", ".pls", small_pulsewaves, 0),
            ("wvs", "read_wvs", ".wvs", small_pulsewaves, 1),
            ("packet points", "read_packet_points", ".las", small_las_waveforms, 0),
            ("wdp", "read_wdp", ".wdp", small_las_waveforms, 1),
        )
    },
    # A reader with planted faults, which tests the fuzzing itself.
    "planted": FileKind(
        *("planted", "read_with_planted_fault", ".bin", (lambda: b"",)),
        change=lambda random, content: (content + b"1", "longer"),
        is_plausible=lambda result: result != "nonsense",
    ),
}
# Verdicts on the first mutants of the kind "planted". Those from "memory" on need a child process.
PLANTED_VERDICTS = ("read", "refused", "no place", "nonsense", "escaped", "memory", "hang", "abort")


def read_with_planted_fault(path: Path) -> str:
    """Behave so that fuzz.py gives a certain verdict, which follows from the number in the file's name."""
    number = int(re.findall(r"\d+", path.name)[-1])
    verdict = PLANTED_VERDICTS[number % len(PLANTED_VERDICTS)]
    if verdict == "refused":
        raise ValueError(f"{path}: byte 0 is none")
    if verdict == "no place":
        raise ValueError("something is wrong")
    if verdict == "escaped":
        raise IndexError(f"{path}: there is none")
    if verdict == "memory":
        np.ones(MAX_BYTES)
    if verdict == "hang":
        time.sleep(10 * MAX_SECONDS)
    if verdict == "abort":
        os.abort()
    return verdict
