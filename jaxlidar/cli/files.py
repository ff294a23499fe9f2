"""`jaxlidar info` and `jaxlidar convert`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from jaxlidar.cli.shared import ResultPath
from jaxlidar.io import (
    AirborneShot,
    AirborneShots,
    Case,
    atomic_write,
    read_case,
    read_dem,
    read_gedi_l1b,
    read_las,
    read_las_waveforms,
    read_neon,
    read_obj,
    read_pulsewaves,
    read_qsm,
    read_vox,
    write_case,
    write_las_waveforms,
)
from jaxlidar.io.las_waveforms import has_packets
from jaxlidar.io.netcdf import open as open_result
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import read_spectrum_csv
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.spectral.waveform import Waveform

FILE = ResultPath(exists=True)


def _of_case(path: Path) -> str:
    case = read_case(path)
    return "\n".join(f"{name}: {part}" for name, part in _parts(case).items() if part is not None)


def _parts(case: Case) -> dict[str, Any]:
    arguments = ", ".join(f"{name} = {value}" for name, value in case.arguments.items())
    parts = {"lidar": case.lidar, "survey": case.survey, "scene": case.scene}
    return {**parts, "simulate": arguments or None}


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
    lines += [f"{n} points left out: {why}" for why, n in cloud.dropped.items() if n]
    if has_packets(path):
        lines.append(_of_shots(read_las_waveforms(path)))
    return "\n".join(lines)


def _of_shots(shots: AirborneShots) -> str:
    """Of airborne shots in a file that may be larger than memory: some evenly spread ones stand for all."""
    some = [shots[i] for i in range(len(shots))[:: -(-len(shots) // _SOME)]]
    times = shots.gps_time
    lines = [f"{len(shots):,} airborne shots, GPS times {times.min():.6f} to {times.max():.6f} s"]
    lines += [_of_records(some), f"noise {shots.levels.noise_mean:.4g} +- {shots.levels.noise_std:.3g}"]
    lines += [f"{n} points left out: {why}" for why, n in shots.dropped.items() if n]
    return "\n".join(lines)


def _of_records(shots: Sequence[AirborneShot]) -> str:
    zenith, samples = [s.zenith for s in shots], [int(s.recorded.sum()) for s in shots]
    ends = np.array([s.elevation[[0, -1]] for s in shots])
    scanner, pulses = shots[0].scanner, sum(bool(s.outgoing) for s in shots)
    lines = [] if scanner is None else [f"scanner {scanner.instrument}, {scanner.wavelength or '?'} nm"]
    lines += [
        f"{min(samples)} to {max(samples)} samples of {shots[0].sampling_interval:g} ns in up to "
        f"{max(len(s.returning) for s in shots)} segments, {'with' if pulses else 'without'} outgoing pulses",
        f"zenith {min(zenith):.1f} to {max(zenith):.1f} degrees, elevation {ends.min():.1f} to "
        f"{ends.max():.1f}",
    ]
    return "\n".join(lines)


def _of_neon(path: Path) -> str:
    shots, _, dropped = read_neon(path)
    lines = [f"{len(shots):,} airborne shots", _of_records(shots)]
    return "\n".join([*lines, *(f"{n} shots left out: {why}" for why, n in dropped.items() if n)])


def _of_gedi(path: Path) -> str:
    shots = read_gedi_l1b(path)
    latitude, longitude = [s.latitude for s in shots], [s.longitude for s in shots]
    lines = [
        f"{len(shots):,} GEDI shots of {', '.join(sorted({s.beam for s in shots}))}",
        f"latitude {min(latitude):.5f} to {max(latitude):.5f}, longitude {min(longitude):.5f} to "
        f"{max(longitude):.5f} degrees",
    ]
    flagged = sum(bool(s.degrade or s.stale_return) for s in shots)
    return "\n".join([*lines, *([f"{flagged} of them flagged as degraded or stale"] if flagged else [])])


def _of_tree(path: Path) -> str:
    read = read_qsm(path)
    lines = [f"tree of {len(read.tree.start):,} cylinders, {read.tree.height:.2f} m tall"]
    return "\n".join([*lines, *(f"{n} cylinders {why}" for why, n in read.dropped.items() if n)])


def _of_mesh(path: Path) -> str:
    mesh, dropped = read_obj(path)
    low, high = mesh.corners.min(axis=(0, 1)), mesh.corners.max(axis=(0, 1))
    spans = ", ".join(f"{axis} {a:.2f} to {b:.2f} m" for axis, a, b in zip("xyz", low, high))
    area = np.bincount(mesh.material, mesh.area, len(mesh.materials))
    lines = [f"{len(mesh.faces):,} triangles: {spans}"]
    lines += [f"{name}: {own:.4g} m2" for name, own in zip(mesh.materials, area)]
    return "\n".join([*lines, *(f"{n} triangles left out: {why}" for why, n in dropped.items() if n)])


def _of_terrain(path: Path) -> str:
    terrain, crs, filled = read_dem(path)
    heights, spacing = np.asarray(terrain.heights), np.asarray(terrain.spacing)
    nodes, apart = " x ".join(map(str, heights.shape)), " x ".join(f"{step:g}" for step in spacing)
    lines = [
        f"terrain of {nodes} nodes, {apart} m apart",
        f"heights {heights.min():.2f} to {heights.max():.2f} m, {crs or 'no coordinate reference system'}",
    ]
    return "\n".join([*lines, *([f"{filled} nodes without data"] if filled else [])])


def _of_spectrum(path: Path) -> str:
    read = read_spectrum_csv(path)
    low, high = float(read.wavelength[0]), float(read.wavelength[-1])
    return f"spectrum {read.name!r} of {read.wavelength.size} samples from {low:g} to {high:g} nm"


# Shots of a file that stand for all.
_SOME = 1000

READERS: dict[str, Callable[[Path], str]] = {
    ".toml": _of_case,
    ".nc": lambda path: str(open_result(path)),
    ".zarr": lambda path: str(open_result(path)),
    ".vox": lambda path: _of_voxels(*read_vox(path)),
    ".las": _of_points,
    ".laz": _of_points,
    ".pls": lambda path: _of_shots(read_pulsewaves(path)),
    ".npz": _of_neon,
    ".obj": _of_mesh,
    ".h5": _of_gedi,
    **dict.fromkeys((".tif", ".tiff", ".asc"), _of_terrain),
    ".qsm": _of_tree,
    ".txt": _of_tree,
    ".csv": _of_spectrum,
}


@click.command()
@click.argument("file", type=FILE)
def info(file: Path) -> None:
    """Say what is in a file, by its ending.

    These are cases (.toml), results (.nc, .zarr), voxels (.vox), points (.las, .laz), airborne waveforms
    (.las with .wdp, .pls with .wvs, NEON's .npz), GEDI level 1B (.h5), tree models (.qsm, .txt), meshes
    (.obj), elevation models (.tif, .tiff, .asc) and spectra (.csv).

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


def _case_to_text(source: Path, target: Path) -> None:
    write_case(target, read_case(source))


def _shots_to_las(shots: Sequence[AirborneShot], target: Path) -> None:
    write_las_waveforms(target, shots)
    if any(shot.outgoing for shot in shots[:1]):
        click.echo("left out: outgoing pulses, which LAS has no place for", err=True)


CONVERSIONS: dict[tuple[str, str], Callable[[Path, Path], None]] = {
    (".nc", ".csv"): _waveform_to_csv,
    (".zarr", ".csv"): _waveform_to_csv,
    **{(kind, ".toml"): _case_to_text for kind in (".nc", ".zarr", ".toml")},
    (".vox", ".toml"): _voxels_to_case,
    (".pls", ".las"): lambda source, target: _shots_to_las(read_pulsewaves(source), target),
    (".npz", ".las"): lambda source, target: _shots_to_las(read_neon(source).shots, target),
}


@click.command()
@click.argument("source", type=FILE)
@click.argument("target", type=click.Path(dir_okay=False, path_type=Path))
def convert(source: Path, target: Path) -> None:
    """Convert a file by the endings of both names.

    \b
      .nc to .csv     samples of a waveform, as a table; .zarr too
      .nc to .toml    the case that a waveform was simulated from; .zarr too
      .toml to .toml  the same case with every field written out
      .vox to .toml   a scene of the voxels, with default leaf optics
      .pls to .las    airborne waveforms, as waveform packets; NEON's .npz too

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
