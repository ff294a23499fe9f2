"""Surveys over airborne point clouds in many files, one square tile of the scene at a time.

For each tile that has shots:

1. The rectangle that they need: the tile, extended by the radius within which a beam is followed, and by a
   buffer, as canopy and ground are computed from all points nearby.
2. The points in it are read.
3. They become a canopy and a terrain (`canopy_from_points`), with leaves as bright as the ground, so that a
   waveform is the sum of points under the footprint (Hancock et al. 2019). Ground without a return nearby, as
   of water, is black.
4. The shots are simulated at first order, and their waveforms saved.

Voxels and terrain nodes lie at multiples of their edges, so that neighbouring tiles agree on them, and have
one number in all tiles, so that all share compiled programs.

**Source:** Hancock et al. (2019), Earth Space Sci. 6, 294.
"""

import dataclasses
import functools
import os
import shutil
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from jaxlidar._fields.checks import check_key, check_kind, check_number
from jaxlidar._fields.crs import common_system
from jaxlidar._fingerprint import digest_of, fingerprint
from jaxlidar._jax.workers import in_turn, outcomes, portable_key, task
from jaxlidar.formats.checks import existing_file
from jaxlidar.formats.las import las_extent, read_las
from jaxlidar.optics.leaf import LeafOptics
from jaxlidar.plants.grid import voxel_edges
from jaxlidar.plants.point_canopy import canopy_from_points
from jaxlidar.plants.point_cloud import PointCloud
from jaxlidar.progress import Progress, ProgressOption, shows_progress
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.relative_height import MisplacedCanopyWarning
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import Ground
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.simulate_many import simulate_many
from jaxlidar.survey.waveforms import Waveforms

# Radius within which a Gaussian beam is followed, over its 1/e^2 radius; 2e-8 of its energy lies beyond.
_GAUSSIAN_EXTENT = 3.0
# Width of the buffer in m: returns are smoothed over some metres, and ground is found among its neighbours.
_BUFFER = 25.0
# Ground farther than this from any return, m, is black and bare.
_LARGEST_GAP = 5.0
# Reflectance of the ground. Leaves that scatter isotropically look 2/3 as bright as they are from above.
REFLECTANCE, _LEAF = 0.3, (0.45, 0.45)
# Canopies have a multiple of this number of layers, so that few sizes are compiled.
_LAYERS = 16
# Name of the file of a tile, with a digest of all that it depends on, and that of a draft of one.
_TILE_NAME, _DRAFT_NAME = "tile_{}.nc", ".tile_*.part"
# Arrays of waveforms that are kept.
_KEPT = ("recorded", "components")


class CloudFile(NamedTuple):
    """A file of points: its path, corners (x, y) of its extent in m, and what tells its content from others.

    - `crs`: as that of `PointCloud`. - `version`: size in bytes and time of the last change in ns.
    """

    path: Path
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    crs: str | None
    version: tuple[int, int]

    @staticmethod
    def of(path: str | os.PathLike[str]) -> "CloudFile":
        """Read the header of a file. **Raises:** as `jaxlidar.io.read_las`."""
        path = existing_file(path)
        low, high, crs = las_extent(path)
        status = path.stat()
        return CloudFile(path, low[:2], high[:2], crs, (status.st_size, status.st_mtime_ns))

    def meets(self, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]) -> bool:
        """Return True if the extent and a rectangle overlap."""
        return bool(np.all(self.low <= high) and np.all(self.high >= low))


class CloudTile(NamedTuple):
    """A tile: numbers of its shots, corners of the rectangle that they need, m, and the files of that."""

    shots: Int[np.ndarray, " shots"]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    files: list[CloudFile]


@shows_progress
def simulate_tiles(
    files: Sequence[str | os.PathLike[str]],
    survey: Survey,
    folder: str | os.PathLike[str],
    *,
    key: PRNGKeyArray,
    voxel_size: float | tuple[float, float, float] = (2.0, 2.0, 0.5),
    tile: float = 100.0,
    rtol: float = 0.03,
    executor: Executor | None = None,
    progress: ProgressOption = None,
) -> list[tuple[Int[np.ndarray, " shots"], Waveforms]]:
    """Simulate a survey over airborne point clouds in many files, one tile at a time.

    Each tile becomes a canopy and a terrain (`canopy_from_points`) with leaves as bright as the ground, and
    its shots are simulated at first order: waveforms are close to the sum of the points under a footprint.
    Memory is that of one tile with a buffer of 25 m, and of the two files that were read last. Farther than 5
    m from any return, as on water, the ground is black and bare.

    **Arguments:**

    - `files`: paths of LAS or LAZ files, as those of `jaxlidar.io.read_las`, in one coordinate reference
      system. Neighbouring files make each other's buffer; none may hold the same points as another.
    - `survey`: a `Survey` of beams that go straight down from an altitude, in the same system.
    - `folder`: for a netCDF file with the `Waveforms` of each tile. The same call goes on with those that
      are there, also after it was killed; a tile is simulated again where its points, its shots or an
      argument have changed. Missing folders are created.
    - `key`: a JAX random key. The same key gives the same waveforms.
    - `voxel_size`: voxel edges in m, as for `canopy_from_points`. Default (2, 2, 0.5): finer ones change
      footprints of 20 m little, and take longer.
    - `tile`: edge of a tile in m, positive. Large tiles take more memory; small ones share less of the work
      between shots. Default 100.
    - `rtol`: relative error to reach for every shot, in (0, 1). Default 0.03.
    - `executor`: a `concurrent.futures.Executor`, whose workers do one tile each, as for `simulate_many`.
      They read the files and write to the folder. Default None: this process, on all cores.
    - `progress`: True for a bar with the time left; or a function called with a `Progress` after every tile.
      Default None: silent.

    **Returns:** for each tile, (shots,) the numbers of its shots in the survey, and their `Waveforms`, with
    `recorded` and `components`. Shots more than 5 m outside of the extents of all files are in no tile.
    `jaxlidar.io.write_gedi_l1b` takes a list of such `Waveforms`.

    **Raises:** what `jaxlidar.io.read_las` raises; ValueError for no file, one given twice, systems that
    differ, a survey of tilted beams or sensors, one that lies outside of all files, and numbers outside their
    ranges; TypeError for objects of the wrong type. OSError where the folder cannot be written. RuntimeError
    where the worker of a tile dies twice.

    **Source:** Hancock et al. (2019), Earth Space Sci. 6, 294.

    **Example:** two files of bare ground, side by side.

    >>> import pathlib, tempfile
    >>> import jax, numpy as np, jaxlidar as jl
    >>> folder, files = pathlib.Path(tempfile.mkdtemp()), []
    >>> for start in (0.0, 50.0):
    ...     x, y = np.meshgrid(start + np.arange(0.5, 50.0), np.arange(0.5, 50.0))
    ...     points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 7.0)])
    ...     files.append(folder / f"{start:g}.las")
    ...     jl.io.write_las(files[-1], points, classification=np.full(len(points), 2))
    >>> survey = jl.Survey(jl.instrument("GEDI power"), [(50.0, 25.0), (900.0, 25.0)])
    >>> ((shots, waves),) = jl.simulate_tiles(files, survey, folder / "tiles", key=jax.random.key(0))
    >>> peak = waves.recorded[0, 0].argmax()
    >>> print(shots, f"{waves.height_of_shot(0)[peak]:.1f} m")
    [0] 7.0 m
    """
    check_kind("files", files, Sequence, "a list of paths of LAS or LAZ files")
    check_kind("survey", survey, Survey, "a Survey, as in Survey(lidar, position=...)")
    check_kind("folder", folder, str | os.PathLike, "a path")
    check_key(key)
    edges = voxel_edges(voxel_size)
    check_number("tile", tile, 0.0, low_open=True)
    check_number("rtol", rtol, 0.0, 1.0, low_open=True, high_open=True)
    check_kind("executor", executor, Executor | None, "a concurrent.futures.Executor, or None")
    if survey.has_sensor_position or np.any(survey.zenith > 0):
        placed = "placed by its sensors" if survey.has_sensor_position else "of tilted beams"
        raise ValueError(f"survey is {placed}; admissible are beams straight down from an altitude")
    clouds = [CloudFile.of(path) for path in files]
    if not clouds:
        raise ValueError("files is empty; admissible are one or more LAS or LAZ files")
    ((path, times),) = Counter(cloud.path.resolve() for cloud in clouds).most_common(1)
    if times > 1:
        raise ValueError(f"files has {path} {times} times; admissible is each file once")
    common_system({"survey": survey.crs} | {str(cloud.path): cloud.crs for cloud in clouds})
    folder = Path(folder)
    tiles = _tiles(clouds, survey, float(tile), edges)
    # After all that is refused, which leaves no folder behind.
    folder.mkdir(parents=True, exist_ok=True)
    tasks, paths = [], []
    for number, cloud_tile in enumerate(tiles):
        part, tile_key = survey.subset(cloud_tile.shots), jax.random.fold_in(key, number)
        arguments = (cloud_tile, part, edges, float(rtol))
        # All that the waveforms depend on is part of the name, so that files are never mixed up.
        digest = digest_of(fingerprint({"tile": arguments, "key": portable_key(tile_key)}))
        paths.append(folder / _TILE_NAME.format(digest[:32]))
        tasks.append(task(number, simulate_tile, (*arguments, paths[-1]), tile_key))
    missing = [unit for unit in tasks if not paths[unit.number].is_file()]
    shots = sum(len(cloud_tile.shots) for cloud_tile in tiles)
    stored = done = shots - sum(len(tiles[unit.number].shots) for unit in missing)
    start_time = time.perf_counter()
    # In this process a tile has all cores, and the next one waits.
    run = in_turn(missing) if executor is None else outcomes(missing, executor)
    try:
        for unit, _ in run:
            done += len(tiles[unit.number].shots)
            if callable(progress):
                progress(Progress(done, shots, time.perf_counter() - start_time, stored=stored))
    except KeyboardInterrupt as error:
        error.add_note(f"finished tiles are kept in {folder}: the same call continues with them")
        raise
    return [(cloud_tile.shots, Waveforms.open(path)) for cloud_tile, path in zip(tiles, paths)]


def check_tile_folder(folder: Path) -> None:
    """Refuse a folder that has anything but tiles. **Raises:** ValueError; NotADirectoryError for a file."""
    if not folder.exists():
        return
    tiles = {*stored_tiles(folder), *folder.glob(_DRAFT_NAME)}
    others = sorted(path.name for path in folder.iterdir() if path not in tiles)
    if others:
        raise ValueError(
            f"{folder} has {others[0]!r}, which is no tile; admissible is a folder of tiles alone, or none: "
            "nothing is overwritten. Move it, or give another name to the output"
        )


def remove_tiles(folder: Path) -> None:
    """Remove the files of tiles, and nothing else, from a folder."""
    for path in stored_tiles(folder):
        path.unlink(missing_ok=True)
    for path in folder.glob(_DRAFT_NAME):
        shutil.rmtree(path, ignore_errors=True)


def stored_tiles(folder: Path) -> list[Path]:
    """Return the files of tiles in a folder."""
    return list(folder.glob(_TILE_NAME.format("[0-9a-f]" * 32)))


def _tiles(clouds: list[CloudFile], survey: Survey, edge: float, voxel_edge: np.ndarray) -> list[CloudTile]:
    """Return the tiles with shots that lie within the extent of a file. **Raises:** ValueError for none."""
    position = survey.position
    is_inside = np.zeros(len(survey), bool)
    for cloud in clouds:
        # Extents are those of returns: between those of neighbours there is a gap.
        low, high = cloud.low - _LARGEST_GAP, cloud.high + _LARGEST_GAP
        is_inside |= np.all((position >= low) & (position <= high), axis=1)
    (inside,) = np.nonzero(is_inside)
    if inside.size == 0:
        low, high = (
            f(a, axis=0) for f, a in ((np.min, [c.low for c in clouds]), (np.max, [c.high for c in clouds]))
        )
        raise ValueError(
            f"survey: no shot lies within the extent of a file: shots have x and y from "
            f"{position.min(axis=0).tolist()} to {position.max(axis=0).tolist()} m, the files from "
            f"{low.tolist()} to {high.tolist()} m; admissible is one coordinate reference system"
        )
    extent = _GAUSSIAN_EXTENT if survey.lidar.profile == "gaussian" else 1.0
    # With the buffer.
    reach = extent * float(survey.footprint_radius.max()) + _BUFFER
    corners, tile_of_shot = np.unique(np.floor(position[inside] / edge), axis=0, return_inverse=True)
    tiles = []
    for number, corner in enumerate(edge * corners):
        # Multiples of the voxel's edge, and one number of voxels in all tiles.
        low = voxel_edge[:2] * np.floor((corner - reach) / voxel_edge[:2])
        high = low + voxel_edge[:2] * np.ceil((edge + 2.0 * reach) / voxel_edge[:2] + 1.0)
        files = [cloud for cloud in clouds if cloud.meets(low, high)]
        tiles.append(CloudTile(inside[tile_of_shot.reshape(-1) == number], low, high, files))
    return tiles


def simulate_tile(
    tile: CloudTile,
    survey: Survey,
    voxel_edge: Float[np.ndarray, "3"],
    rtol: float,
    path: Path,
    key: PRNGKeyArray,
) -> None:
    """Simulate the shots of a tile and save their waveforms; the file appears when it is complete."""
    with warnings.catch_warnings():
        # On slopes, some low plants of a column of 2 m lie below its ground: sums of points hardly change.
        warnings.simplefilter("ignore", MisplacedCanopyWarning)
        scene = scene_of_tile(tile, voxel_edge)
        # Light that is shared saves nothing here, and its programs depend on the number of shots of a tile.
        waves = simulate_many(survey, scene, key=key, rtol=rtol, max_orders=1, shared=False, keep=_KEPT)
    waves.save(path)


def scene_of_tile(tile: CloudTile, voxel_edge: Float[np.ndarray, "3"]) -> Scene:
    """Return the canopy and the terrain of a tile; black ground where no points are."""
    low, high = tile.low, tile.high
    points = _points_between(tile.files, low, high)
    if len(points.position) == 0:
        return Scene(ground=Ground(reflectance=0.0))
    z_low, z_high = points.position[:, 2].min(), points.position[:, 2].max()
    bottom = voxel_edge[2] * np.floor(z_low / voxel_edge[2])
    layers = _LAYERS * int(np.floor((z_high - bottom) / voxel_edge[2] / _LAYERS) + 1)
    columns = np.rint((high - low) / voxel_edge[:2]).astype(int)
    cloud = canopy_from_points(
        points,
        (float(voxel_edge[0]), float(voxel_edge[1]), float(voxel_edge[2])),
        reflectance=REFLECTANCE,
        origin=(float(low[0]), float(low[1]), float(bottom)),
        shape=(int(columns[0]), int(columns[1]), layers),
    )
    # Within the map, and not far from all returns, plants are made of those nearby. Elsewhere are none.
    axes = [low[k] + voxel_edge[k] * np.arange(columns[k] + 1) for k in range(2)]
    middles = [axis[:-1] + 0.5 * voxel_edge[k] for k, axis in enumerate(axes)]
    is_near = _is_near(points, middles)[:, :, None]
    assert cloud.voxels.leaf is not None
    voxels = dataclasses.replace(cloud.voxels, leaf=np.where(is_near, np.asarray(cloud.voxels.leaf), 0.0))
    canopy = Canopy(voxels, leaf=LeafOptics(*_LEAF))
    if cloud.terrain is None:
        return Scene(canopy=canopy)
    # Nodes at the edges of voxels. Beyond its rim a terrain has no heights.
    x, y = (
        np.clip(axis, *ends) for axis, *ends in zip(axes, np.asarray(cloud.terrain.origin), cloud.terrain.end)
    )
    ground = dataclasses.replace(
        cloud.terrain,
        heights=np.asarray(cloud.terrain.height_at(*np.meshgrid(x, y, indexing="ij"))),
        spacing=voxel_edge[:2],
        origin=tuple(low),
        reflectance=np.where(_is_near(points, axes), REFLECTANCE, 0.0),
    )
    return Scene(canopy=canopy, ground=ground)


def _is_near(points: PointCloud, axes: list[np.ndarray]) -> Bool[np.ndarray, "nx ny"]:
    """Return True for the places of a grid that have a return nearby."""
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    # Relative to one of them: map coordinates are large.
    origin = places[0, 0]
    distance, _ = scipy.spatial.KDTree(points.position[:, :2] - origin).query(
        places - origin, distance_upper_bound=_LARGEST_GAP
    )
    return np.isfinite(distance)


@functools.lru_cache(maxsize=2)
def _points_of(path: Path, version: tuple[int, int]) -> PointCloud:
    """Read a file. The last ones are kept: neighbouring tiles need them, too."""
    return read_las(path)._replace(extra=None)


def _points_between(
    files: list[CloudFile], low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> PointCloud:
    """Return the points of files in a rectangle, without its upper border."""
    parts = []
    for file in files:
        cloud = _points_of(file.path, file.version)
        is_inside = np.all((cloud.position[:, :2] >= low) & (cloud.position[:, :2] < high), axis=1)
        parts.append((cloud, is_inside))

    def joined(name: str) -> Any:
        columns = [getattr(cloud, name) for cloud, _ in parts]
        if any(column is None for column in columns):
            return None
        return np.concatenate([column[is_inside] for column, (_, is_inside) in zip(columns, parts)])

    names = ("position", "classification", "return_number", "number_of_returns", "intensity", "scan_angle")
    crs = next((file.crs for file in files if file.crs is not None), None)
    return PointCloud(**{name: joined(name) for name in names}, dropped={}, crs=crs)
