"""`jaxlidar info` and `jaxlidar convert`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np

from jaxlidar.io import Case, atomic_write, read_case, read_las, read_qsm, read_vox, write_case
from jaxlidar.io.netcdf import open as open_result
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import read_spectrum_csv
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.waveform import Waveform

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


def _of_case(path: Path) -> str:
    case = read_case(path)
    return "\n".join(f"{name}: {part}" for name, part in _parts(case).items() if part is not None)


def _parts(case: Case) -> dict[str, Any]:
    arguments = ", ".join(f"{name} = {value}" for name, value in case.arguments.items())
    return {"lidar": case.lidar, "scene": case.scene, "simulate": arguments or None}


def _of_voxels(voxels: VoxelMap, dropped: dict[str, int]) -> str:
    size = " x ".join(f"{float(s):g}" for s in voxels.voxel_size)
    low = ", ".join(f"{float(x):g}" for x in voxels.origin)
    lines = [f"{' x '.join(map(str, voxels.shape))} voxels of {size} m from ({low}) m"]
    for name, extinction in (("leaf", voxels.leaf), ("bark", voxels.bark)):
        if extinction is not None:
            area = (
                2
                * float(np.sum(np.asarray(extinction, float)))
                * float(np.prod(np.asarray(voxels.voxel_size)))
            )
            lines.append(f"{name}: {area:.4g} m2")
    lines += [f"{count} voxels {why}" for why, count in dropped.items() if count]
    return "\n".join(lines)


def _of_points(path: Path) -> str:
    cloud = read_las(path)
    low, high = cloud.position.min(axis=0), cloud.position.max(axis=0)
    spans = ", ".join(f"{axis} {a:.2f} to {b:.2f} m" for axis, a, b in zip("xyz", low, high))
    lines = [f"{len(cloud.position):,} points: {spans}"]
    return "\n".join([*lines, *(f"{n} points left out: {why}" for why, n in cloud.dropped.items() if n)])


def _of_tree(path: Path) -> str:
    read = read_qsm(path)
    lines = [f"tree of {len(read.tree.start):,} cylinders, {read.tree.height:.2f} m tall"]
    return "\n".join([*lines, *(f"{n} cylinders {why}" for why, n in read.dropped.items() if n)])


def _of_spectrum(path: Path) -> str:
    read = read_spectrum_csv(path)
    low, high = float(read.wavelength[0]), float(read.wavelength[-1])
    return f"spectrum {read.name!r} of {read.wavelength.size} samples from {low:g} to {high:g} nm"


READERS: dict[str, Callable[[Path], str]] = {
    ".toml": _of_case,
    ".nc": lambda path: str(open_result(path)),
    ".vox": lambda path: _of_voxels(*read_vox(path)),
    ".las": _of_points,
    ".laz": _of_points,
    ".qsm": _of_tree,
    ".txt": _of_tree,
    ".csv": _of_spectrum,
}


@click.command()
@click.argument("file", type=FILE)
def info(file: Path) -> None:
    """Say what is in a file, by its ending.

    These are cases (.toml), results (.nc), voxels (.vox), points (.las, .laz), tree models (.qsm, .txt) and
    spectra (.csv).

    \b
    Examples:
      jaxlidar info tree.nc
      jaxlidar info plot.vox
    """
    suffix = file.suffix.lower()
    if suffix not in READERS:
        raise click.BadParameter(f"{file.name}: files end in {', '.join(READERS)}", param_hint="FILE")
    click.echo(READERS[suffix](file))


def _waveform_to_csv(source: Path, target: Path) -> None:
    wave = open_result(source)
    if not isinstance(wave, Waveform):
        raise ValueError(f"{source} holds a {type(wave).__name__}; a table of samples is made of a Waveform")
    names, columns = ["time_ns", "height_m"], [np.asarray(wave.time), np.asarray(wave.height)]
    for i, wavelength in enumerate(np.asarray(wave.wavelength)):
        for name in ("reflectance", "stderr", "energy"):
            names.append(f"{name}_{wavelength:g}nm")
            columns.append(np.asarray(getattr(wave, name)[i]))
    with atomic_write(target) as draft:
        # Nine digits are exact in single precision.
        np.savetxt(
            draft, np.column_stack(columns), delimiter=",", header=",".join(names), comments="", fmt="%.9g"
        )


def _voxels_to_case(source: Path, target: Path) -> None:
    voxels, dropped = read_vox(source)
    left_out = [f"{n} voxels {why}" for why, n in dropped.items() if n]
    if left_out:
        click.echo(f"taken as empty: {', '.join(left_out)}", err=True)
    leaf = Prospect() if voxels.leaf is not None else None
    bark = 0.3 if voxels.bark is not None else None
    write_case(target, Case(scene=Scene(canopy=Canopy(voxels, leaf=leaf, bark=bark))))


CONVERSIONS: dict[tuple[str, str], Callable[[Path, Path], None]] = {
    (".nc", ".csv"): _waveform_to_csv,
    (".nc", ".toml"): lambda source, target: write_case(target, read_case(source)),
    (".toml", ".toml"): lambda source, target: write_case(target, read_case(source)),
    (".vox", ".toml"): _voxels_to_case,
}


@click.command()
@click.argument("source", type=FILE)
@click.argument("target", type=click.Path(dir_okay=False, path_type=Path))
def convert(source: Path, target: Path) -> None:
    """Convert a file by the endings of both names.

    \b
      .nc to .csv     samples of a waveform, as a table
      .nc to .toml    the case that a waveform was simulated from
      .toml to .toml  the same case with every field written out
      .vox to .toml   a scene of the voxels, with default leaf optics

    \b
    Example:
      jaxlidar convert tree.nc tree.csv
    """
    conversion = CONVERSIONS.get((source.suffix.lower(), target.suffix.lower()))
    if conversion is None:
        known = ", ".join(f"{a} to {b}" for a, b in CONVERSIONS)
        raise click.UsageError(f"{source.suffix or source} to {target.suffix or target} is none of {known}")
    conversion(source, target)
    click.echo(f"written: {target}")
