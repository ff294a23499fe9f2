"""The commands `jaxlidar info` and `jaxlidar convert`."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from jaxlidar._fields.columns import NamedColumn, match_columns, name_and_unit
from jaxlidar.cli.shared import ResultPath
from jaxlidar.formats.airborne import AirborneShots
from jaxlidar.formats.coordinates import GEOGRAPHIC
from jaxlidar.formats.dem import read_grid
from jaxlidar.formats.footprints import COLUMNS as PLACE_COLUMNS
from jaxlidar.formats.footprints import read_places
from jaxlidar.formats.las import read_stored_points
from jaxlidar.formats.las_header import read_header
from jaxlidar.formats.las_waveforms import has_packets
from jaxlidar.io import (
    AirborneShot,
    Case,
    atomic_write,
    read_case,
    read_gedi_l1b,
    read_inventory,
    read_las_waveforms,
    read_mesh,
    read_neon,
    read_pulsewaves,
    read_qsm,
    read_trajectory,
    read_vox,
    write_case,
    write_las_waveforms,
)
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import read_spectrum_csv
from jaxlidar.plants.inventory import COLUMNS as INVENTORY_COLUMNS
from jaxlidar.results.netcdf import open as open_result
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.spectral.waveform import Waveform
from jaxlidar.survey.returns import DETECTORS
from jaxlidar.survey.waveforms import Waveforms

FILE_PATH = ResultPath(exists=True)
# Number of shots of a file that are read for its description: files may be larger than memory.
MAX_DESCRIBED_SHOTS = 1000
# A column that tables of cylinders have, in the first line of a file, and the longest such line in bytes.
TREE_COLUMN, MAX_HEAD = re.compile(r"start_?x", re.IGNORECASE), 10_000
# Columns that tables of positions and attitudes have, those of time, which inventories of trees lack, and
# those whose numbers are relative to true north.
TRAJECTORY_COLUMN = re.compile(r"(?<![a-z])(roll|pitch|yaw|heading|easting)(?![a-z])", re.IGNORECASE)
TIME_COLUMN = re.compile(r"time|(?<![a-z])sow(?![a-z])", re.IGNORECASE)
GEOGRAPHIC_COLUMN = re.compile(r"(?<![a-z])(lon|lng|long|longitude|true)(?![a-z])", re.IGNORECASE)


# -- info --------------------------------------------------------------------------------------------------


def describe_case(path: Path) -> str:
    case = read_case(path)
    arguments = ", ".join(f"{name} = {value}" for name, value in case.arguments.items())
    entries = {"lidar": case.lidar, "survey": case.survey, "scene": case.scene, "simulate": arguments or None}
    return "\n".join(f"{name}: {entry}" for name, entry in entries.items() if entry is not None)


def describe_voxels(voxels: VoxelMap, dropped: dict[str, int]) -> str:
    size = " x ".join(f"{float(s):g}" for s in voxels.voxel_size)
    low = ", ".join(f"{float(x):g}" for x in voxels.origin)
    lines = [f"{' x '.join(map(str, voxels.shape))} voxels of {size} m from ({low}) m"]
    volume = float(np.prod(np.asarray(voxels.voxel_size)))
    for name, extinction in (("leaf", voxels.leaf), ("bark", voxels.bark)):
        if extinction is not None:
            # Extinction is stored for G = 1/2: the area density is twice as large.
            area = 2 * float(np.sum(np.asarray(extinction, float))) * volume
            lines.append(f"{name}: {area:.4g} m2")
    return _with_counts(lines, dropped, "voxels ")


def describe_points(path: Path) -> str:
    # In the file's own units, so that points in degrees can be described.
    cloud, system = read_stored_points(path)
    low, high = cloud.position.min(axis=0), cloud.position.max(axis=0)
    if system.kind == "map":
        horizontal, vertical = system.lengths(f"{path}: header")
        spans = _spans(low * [horizontal, horizontal, vertical], high * [horizontal, horizontal, vertical])
    else:
        spans = ", ".join(f"{axis} {a:.9g} to {b:.9g}" for axis, a, b in zip("xyz", low, high))
    with path.open("rb") as file:
        header = read_header(path, file)
    compressed = ", compressed" if header.laszip is not None else ""
    numbers, counts = np.unique(cloud.number_of_returns, return_counts=True)
    returns = ", ".join(f"{count:,} of pulses with {number}" for number, count in zip(numbers, counts))
    lines = [
        f"{len(cloud.position):,} points: {spans}, {system.name}",
        f"point format {header.point_format}{compressed}; returns: {returns}",
    ]
    text = _with_counts(lines, cloud.dropped, "points left out: ")
    return "\n".join([text, describe_shots(read_las_waveforms(path))]) if has_packets(path) else text


def describe_shots(shots: AirborneShots) -> str:
    """Describe the airborne shots of a file by at most `MAX_DESCRIBED_SHOTS` evenly spread ones."""
    stride = -(-len(shots) // MAX_DESCRIBED_SHOTS)
    sample = [shots[i] for i in range(0, len(shots), stride)]
    times = shots.gps_time
    lines = [f"{len(shots):,} airborne shots, GPS times {times.min():.6f} to {times.max():.6f} s"]
    lines += [_describe_records(sample)]
    lines += [f"noise {shots.levels.noise_mean:.4g} +- {shots.levels.noise_std:.3g}"]
    return _with_counts(lines, shots.dropped, "left out: ")


def _describe_records(shots: Sequence[AirborneShot]) -> str:
    """Describe scanner, lengths of records and geometry of some shots."""
    zenith, samples = [shot.zenith for shot in shots], [int(shot.recorded.sum()) for shot in shots]
    ends = np.array([shot.elevation[[0, -1]] for shot in shots])
    scanner, has_pulses = shots[0].scanner, any(shot.outgoing for shot in shots)
    lines = [] if scanner is None else [f"scanner {scanner.instrument}, {scanner.wavelength or '?'} nm"]
    lines += [
        f"{min(samples)} to {max(samples)} samples of {shots[0].sampling_interval:g} ns in up to "
        f"{max(len(shot.returning) for shot in shots)} segments, "
        f"{'with' if has_pulses else 'without'} outgoing pulses",
        f"zenith {min(zenith):.1f} to {max(zenith):.1f} degrees, elevation {ends.min():.1f} to "
        f"{ends.max():.1f}",
    ]
    return "\n".join(lines)


def describe_neon(path: Path) -> str:
    shots, _, dropped = read_neon(path)
    lines = [f"{len(shots):,} airborne shots", _describe_records(shots)]
    return _with_counts(lines, dropped, "shots left out: ")


def describe_gedi(path: Path) -> str:
    shots = read_gedi_l1b(path)
    latitude, longitude = [shot.latitude for shot in shots], [shot.longitude for shot in shots]
    lines = [
        f"{len(shots):,} GEDI shots of {', '.join(sorted({shot.beam for shot in shots}))}",
        f"latitude {min(latitude):.5f} to {max(latitude):.5f}, longitude {min(longitude):.5f} to "
        f"{max(longitude):.5f} degrees",
    ]
    flagged = sum(bool(shot.degrade or shot.stale_return) for shot in shots)
    return "\n".join([*lines, *([f"{flagged} of them flagged as degraded or stale"] if flagged else [])])


def describe_tree(path: Path) -> str:
    tree, dropped = read_qsm(path)
    return _with_counts(
        [f"tree of {len(tree.start):,} cylinders, {tree.height:.2f} m tall"], dropped, "cylinders "
    )


def describe_mesh(path: Path) -> str:
    mesh, dropped = read_mesh(path)
    areas = np.bincount(mesh.material, mesh.area, len(mesh.materials))
    spans = _spans(mesh.corners.min(axis=(0, 1)), mesh.corners.max(axis=(0, 1)))
    lines = [f"{len(mesh.faces):,} triangles: {spans}"]
    lines += [f"{name}: {area:.4g} m2" for name, area in zip(mesh.materials, areas)]
    return _with_counts(lines, dropped, "triangles left out: ")


def describe_terrain(path: Path) -> str:
    grid = read_grid(path)
    nodes = " x ".join(map(str, grid.heights.shape))
    spacings = " x ".join(f"{step:g}" for step in grid.spacing)
    low, high = grid.origin, grid.origin + grid.spacing * (np.array(grid.heights.shape) - 1)
    heights = grid.heights[np.isfinite(grid.heights)]
    range_of_heights = f"{heights.min():.2f} to {heights.max():.2f} m" if heights.size else "unknown"
    lines = [
        f"terrain of {nodes} nodes, {spacings} m apart",
        f"heights {range_of_heights}, {grid.crs or 'no coordinate reference system'}",
        f"x {low[0]:.2f} to {high[0]:.2f} m, y {low[1]:.2f} to {high[1]:.2f} m",
    ]
    return _with_counts(lines, {"without data": grid.heights.size - heights.size}, "nodes ")


def describe_spectrum(path: Path) -> str:
    spectrum = read_spectrum_csv(path)
    low, high = float(spectrum.wavelength[0]), float(spectrum.wavelength[-1])
    return f"spectrum {spectrum.name!r} of {spectrum.wavelength.size} samples from {low:g} to {high:g} nm"


def describe_inventory(path: Path, columns: dict[str, NamedColumn], others: list[str]) -> str:
    """Describe an inventory, with the names of its columns by quantity, and those that are not read."""
    trees = read_inventory(path)
    places = np.stack([trees.x, trees.y])
    lines = [f"inventory of {len(trees.x):,} trees: {_spans(places.min(axis=1), places.max(axis=1))}"]
    for quantity in columns.keys() - {"x", "y", "species"}:
        values = np.asarray(getattr(trees, quantity))
        known, unit = values[np.isfinite(values)], "m2" if quantity == "leaf_area" else "m"
        span = f"{known.min():.4g} to {known.max():.4g} {unit}" if known.size else "not measured"
        missing = f", {values.size - known.size} without" if 0 < known.size < values.size else ""
        lines.append(f"{quantity.replace('_', ' ')}: {span}{missing}")
    if trees.species is not None:
        names, counts = np.unique(trees.species, return_counts=True)
        lines.append("species: " + ", ".join(f"{count:,} {name}" for name, count in zip(names, counts)))
    in_order = sorted(columns.items(), key=lambda item: item[1].index)
    read = [column.name if column.name == q else f"{column.name} as {q}" for q, column in in_order]
    not_read = f"; not read: {', '.join(others)}" if others else ""
    return "\n".join([lines[0], *sorted(lines[1:]), f"columns: {', '.join(read)}{not_read}"])


def describe_places(path: Path, quantities: Collection[str]) -> str:
    """Describe a table of the places of footprints."""
    # Longitude and latitude stay as they are.
    places = read_places(path, GEOGRAPHIC)
    low, high = places.position.min(axis=0), places.position.max(axis=0)
    spans = _spans(low, high)
    if "x" not in quantities:
        names = ("longitude", "latitude")
        spans = ", ".join(f"{name} {a:.5f} to {b:.5f} degrees" for name, a, b in zip(names, low, high))
    beams = f", beams {', '.join(np.unique(places.beam))}" if "beam" in quantities else ""
    return f"places of {len(places.position):,} footprints: {spans}{beams}"


def describe_csv(path: Path) -> str:
    """Describe a table of cylinders, trees, footprints or a trajectory by its columns, else a spectrum."""
    with path.open("rb") as file:
        head = file.readline(MAX_HEAD).decode("utf-8", "replace")
    if TREE_COLUMN.search(head):
        return describe_tree(path)
    names = [name.strip() for name in re.split(r"[,;\t]", head)]
    places = _quantities(names, PLACE_COLUMNS)
    has_time = TIME_COLUMN.search(head) is not None
    has_places = places >= {"x", "y"} or places >= {"longitude", "latitude"}
    is_of_shots = has_places and not places.isdisjoint(("shot_number", "beam"))
    is_of_trees = _quantities(names, INVENTORY_COLUMNS) >= {"x", "y", "height"}
    if is_of_trees and not has_time and not is_of_shots:
        columns = match_columns(f"{path}: line 1", names, INVENTORY_COLUMNS)
        read = [column.name for column in columns.values()]
        return describe_inventory(path, columns, [name for name in names if name not in read])
    if is_of_shots or (has_places and not has_time):
        return describe_places(path, places)
    if not TRAJECTORY_COLUMN.search(head):
        return describe_spectrum(path)
    if GEOGRAPHIC_COLUMN.search(head):
        return (
            "trajectory by longitude and latitude, or with a true heading: jaxlidar.io.read_trajectory needs "
            "the crs= of a map"
        )
    return str(read_trajectory(path))


def _quantities(names: list[str], known: Mapping[str, Sequence[str]]) -> set[str]:
    """Return the quantities that columns may be; several columns may be one of them."""
    plain = {name_and_unit(name)[0] for name in names}
    return {quantity for quantity, admissible in known.items() if not plain.isdisjoint(admissible)}


def _spans(low: np.ndarray, high: np.ndarray) -> str:
    return ", ".join(f"{axis} {a:.2f} to {b:.2f} m" for axis, a, b in zip("xyz", low, high))


def _with_counts(lines: list[str], dropped: Mapping[str, int], items: str) -> str:
    """Append a line for each reason for which a reader left out or changed items of a file."""
    return "\n".join([*lines, *(f"{count} {items}{reason}" for reason, count in dropped.items() if count)])


# By the ending of the file's name.
DESCRIPTIONS: dict[str, Callable[[Path], str]] = {
    ".toml": describe_case,
    ".nc": lambda path: str(open_result(path)),
    ".zarr": lambda path: str(open_result(path)),
    ".vox": lambda path: describe_voxels(*read_vox(path)),
    ".las": describe_points,
    ".laz": describe_points,
    ".pls": lambda path: describe_shots(read_pulsewaves(path)),
    ".npz": describe_neon,
    **dict.fromkeys((".obj", ".ply", ".stl", ".gltf", ".glb"), describe_mesh),
    ".h5": describe_gedi,
    **dict.fromkeys((".tif", ".tiff", ".asc"), describe_terrain),
    ".qsm": describe_tree,
    ".txt": describe_tree,
    ".csv": describe_csv,
}


@click.command()
@click.argument("file", type=FILE_PATH)
def info(file: Path) -> None:
    """Describe the content of a file by the ending of its name.

    Known are cases (.toml), results (.nc, .zarr), voxels (.vox), points (.las, .laz), airborne waveforms
    (.las with .wdp, .pls with .wvs, NEON's .npz), GEDI level 1B (.h5), tree models (.qsm, .txt, .csv), meshes
    (.obj, .ply, .stl, .gltf, .glb), elevation models (.tif, .tiff, .asc), inventories of trees, places of
    footprints, trajectories and spectra (.csv).

    \b
    Examples:
      jaxlidar info tree.nc
      jaxlidar info plot.vox
    """
    suffix = file.suffix.lower()
    if suffix not in DESCRIPTIONS:
        raise click.BadParameter(f"{file.name}: files end in {', '.join(DESCRIPTIONS)}", param_hint="FILE")
    click.echo(DESCRIPTIONS[suffix](file))


# -- convert -----------------------------------------------------------------------------------------------


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
        # Nine significant digits represent a float32 exactly.
        np.savetxt(
            draft, np.column_stack(columns), delimiter=",", header=",".join(names), comments="", fmt="%.9g"
        )


def _voxels_to_case(source: Path, target: Path) -> None:
    voxels, dropped = read_vox(source)
    empty = [f"{count} voxels {reason}" for reason, count in dropped.items() if count]
    if empty:
        click.echo(f"taken as empty: {', '.join(empty)}", err=True)
    # The file has no optics.
    leaf = Prospect() if voxels.leaf is not None else None
    bark = 0.3 if voxels.bark is not None else None
    write_case(target, Case(scene=Scene(canopy=Canopy(voxels, leaf=leaf, bark=bark))))


def _case_to_text(source: Path, target: Path) -> None:
    write_case(target, read_case(source))


def _shots_to_las(shots: Sequence[AirborneShot], target: Path) -> None:
    write_las_waveforms(target, shots)
    if any(shot.outgoing for shot in shots[:1]):
        click.echo("left out: outgoing pulses, which LAS has no place for", err=True)


def _waveforms_to_las(source: Path, target: Path, options: dict[str, Any]) -> None:
    waves = open_result(source)
    if not isinstance(waves, Waveforms):
        raise ValueError(
            f"{source} holds a {type(waves).__name__}; points are made of the Waveforms of a survey"
        )
    click.echo(str(waves.to_las(target, **options)))


CONVERSIONS: dict[tuple[str, str], Callable[[Path, Path], None]] = {
    (".nc", ".csv"): _waveform_to_csv,
    (".zarr", ".csv"): _waveform_to_csv,
    **{(kind, ".toml"): _case_to_text for kind in (".nc", ".zarr", ".toml")},
    (".vox", ".toml"): _voxels_to_case,
    (".pls", ".las"): lambda source, target: _shots_to_las(read_pulsewaves(source), target),
    (".npz", ".las"): lambda source, target: _shots_to_las(read_neon(source).shots, target),
}


# Conversions that take the options of points.
POINT_CONVERSIONS = {(a, b): _waveforms_to_las for a in (".nc", ".zarr") for b in (".las", ".laz")}


@click.command()
@click.argument("source", type=FILE_PATH)
@click.argument("target", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--crs", help="Coordinate reference system of points, such as EPSG:32633.")
@click.option(
    "--detector",
    type=click.Choice(DETECTORS),
    help="Detector of returns, for points.  [default: peak]",
)
def convert(source: Path, target: Path, crs: str | None, detector: str | None) -> None:
    """Convert a file, by the endings of both names.

    \b
      .nc to .csv     samples of a waveform, as a table; .zarr too
      .nc to .laz     discrete returns of a survey, as points; .zarr too, and to .las
      .nc to .toml    the case that a waveform was simulated from; .zarr too
      .toml to .toml  the same case with every field written out
      .vox to .toml   a scene of the voxels, with default leaf optics
      .pls to .las    airborne waveforms, as waveform packets; NEON's .npz too

    \b
    Examples:
      jaxlidar convert tree.nc tree.csv
      jaxlidar convert strip.nc strip.laz --crs EPSG:32633
    """
    endings = source.suffix.lower(), target.suffix.lower()
    options = {name: value for name, value in (("crs", crs), ("detector", detector)) if value is not None}
    if endings in POINT_CONVERSIONS:
        POINT_CONVERSIONS[endings](source, target, options)
        click.echo(f"written: {target}")
        return
    if options:
        raise click.UsageError(
            f"--{' and --'.join(options)}: for points (.las, .laz) of waveforms (.nc, .zarr)"
        )
    conversion = CONVERSIONS.get(endings)
    if conversion is None:
        conversions = ", ".join(f"{a} to {b}" for a, b in [*CONVERSIONS, *POINT_CONVERSIONS])
        raise click.UsageError(
            f"{source.suffix or source} to {target.suffix or target} is none of {conversions}"
        )
    conversion(source, target)
    click.echo(f"written: {target}")
