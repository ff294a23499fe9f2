"""The scene that a lidar observes: canopy, plates, ground, atmosphere and meshes, each of them optional."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxlidar._fields.checks import check_kind, concrete, concrete_array, has_tracers, kind_of
from jaxlidar._fields.crs import common_system
from jaxlidar._fields.ranges import Range
from jaxlidar._text import object_text
from jaxlidar._vectors import FAR, dot, vec
from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.mesh_surface import MeshSurface
from jaxlidar.scenes.relative_height import check_relative_height
from jaxlidar.scenes.shapes import Plane
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, AbstractSurface
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.sensors.lidar import Lidar

# Smallest distance, m, between parallel planes. In single precision closer ones coincide, and it is not
# defined which of them a ray meets first.
MIN_GAP = 1e-4
# Triangles of a mesh that are compared with a terrain.
_TRIANGLES_ON_TERRAIN = 4096


def _as_tuple(x: Any) -> Any:
    return tuple(x) if isinstance(x, Iterable) else x


def _as_meshes(x: Any) -> Any:
    """Convert to a tuple. Tuples in it, such as `leaf_mesh` gives of a stand, are taken apart."""
    if not isinstance(x, Iterable):
        return x
    return tuple(itertools.chain(*(mesh if _are_surfaces(mesh) else (mesh,) for mesh in x)))


def _are_surfaces(x: Any) -> bool:
    return isinstance(x, tuple) and all(isinstance(mesh, MeshSurface) for mesh in x)


@final
class Scene(eqx.Module):
    """A scene: the canopy, plates, ground, atmosphere and meshes that a lidar observes.

    Every element is optional. An element that is None or empty takes no computing time.

    **Arguments:**

    - `canopy`: a `Canopy`, or None. Default None.
    - `plates`: a sequence of `Plate`, or of other `AbstractSheet`. Default ().
    - `ground`: a `Ground`, a `Terrain`, another `AbstractGround`, or None. Default None.
    - `atmosphere`: an `Atmosphere`, or None. Default None.
    - `meshes`: a sequence of `MeshSurface`, or of tuples of them. Triangles that lie in the ground are met
      before it; of triangles in one plane, those of the mesh that comes first in the sequence. Beside a
      canopy or terrain with periodic sides, meshes repeat with it; one that crosses a side enters by the
      opposite one. Default ().

    **Raises:** TypeError for an argument of the wrong type; ValueError for a plate in the plane of the
    ground, of another plate, of a triangle or of a cell of the terrain, for a canopy with periodic sides over
    terrain of another period, for parts whose `crs` differ, for a canopy that lies below the terrain as a
    whole, for meshes that are wider than the period of a canopy or terrain with periodic sides, with which
    they repeat, and for meshes most of whose triangles follow the terrain and cross it.

    **Warns:** `MisplacedCanopyWarning` for plants below the terrain, or far above it.

    **Example:**

    >>> import jaxlidar as jl
    >>> plate = jl.Plate(height=5.0, reflectance=0.4, transmittance=0.4, coverage=0.5)
    >>> scene = jl.Scene(plates=[plate], ground=jl.Ground(reflectance=0.3))
    >>> [surface.name for surface in scene.surfaces]
    ['ground', 'plate']
    """

    canopy: Canopy | None = None
    plates: tuple[AbstractSheet, ...] = eqx.field(converter=_as_tuple, default=())
    ground: AbstractGround | None = None
    atmosphere: Atmosphere | None = None
    meshes: tuple[MeshSurface, ...] = eqx.field(converter=_as_meshes, default=())

    ranges: ClassVar = {"gap": Range(MIN_GAP)}

    def __str__(self) -> str:
        return object_text(self)

    def __check_init__(self):
        hint = ", as in Canopy(voxels, leaf=...)" if isinstance(self.canopy, VoxelMap) else ""
        for field, kind, admissible in (
            ("canopy", Canopy, f"a Canopy or None{hint}"),
            ("ground", AbstractGround, "a Ground or None, as in Ground(reflectance=0.3)"),
            ("atmosphere", Atmosphere, "an Atmosphere or None"),
        ):
            check_kind(field, getattr(self, field), kind | None, admissible)
        check_kind("plates", self.plates, tuple, "a tuple, as in (plate,)")
        check_kind("meshes", self.meshes, tuple, "a tuple, as in (mesh,)")
        for mesh in self.meshes:
            check_kind("one of meshes", mesh, MeshSurface, "a MeshSurface, as in MeshSurface(mesh)")
        # Two systems are refused before plants seem to lie far off the terrain.
        _ = self.crs
        if self.canopy is not None and isinstance(self.ground, Terrain):
            check_periods(self.canopy, self.ground)
            check_relative_height(self.canopy, self.ground)
        for plate in self.plates:
            if not isinstance(plate, AbstractSheet):
                raise TypeError(f"plates has {kind_of(plate)}; admissible is a tuple of Plate")
        if self.meshes:
            check_mesh_widths(self.meshes, self.period)
        names = (() if self.ground is None else ("the ground",)) + tuple(
            f"plates[{i}]" for i in range(len(self.plates))
        )
        for (low, high), gap in _gaps(self.surfaces):
            if (distance := concrete(gap)) is not None and distance < MIN_GAP:
                raise ValueError(
                    f"{names[high]} lies {distance:.1g} m from the plane of {names[low]}: which is met first "
                    f"is unknown; admissible is {MIN_GAP:g} m or more"
                )
        self._check_plates()
        self._check_meshes_on_terrain()

    def _check_plates(self) -> None:
        """Refuse plates in the plane of triangles of a mesh, or of cells of a terrain.

        Triangles that lie in the ground are met before it (`trace.march.meshes`).
        """
        if not self.plates or has_tracers((self.plates, self.ground, self.meshes)):
            return
        for i, plate in enumerate(self.plates):
            if not isinstance(plate.shape, Plane):
                continue
            # Within a program even what is computed of known values is traced, unless at compile time.
            with jax.ensure_compile_time_eval():
                plane = concrete_array(plate.shape.upward), concrete_array(plate.shape.foot)
            gaps = {f"meshes[{n}]": mesh.gap_to_plane(*plane) for n, mesh in enumerate(self.meshes)}
            if isinstance(self.ground, Terrain) and self.ground.relief:
                distance = (_corners_of_cells(self.ground) - plane[1]) @ plane[0]
                gaps["the terrain"] = float(np.abs(distance).max(axis=1).min())
            for name, distance in gaps.items():
                if distance < MIN_GAP:
                    raise ValueError(
                        f"plates[{i}] lies {distance:.1g} m from a part of {name} in its plane: which is met "
                        f"first is unknown; admissible is {MIN_GAP:g} m or more"
                    )

    def _check_meshes_on_terrain(self) -> None:
        """Refuse meshes that follow a terrain and cross it, such as triangles of its own heights.

        Terrain is bilinear between its nodes, and triangles are flat: in each cell some of them would lie
        above it and some below, and light would meet the ground or the mesh in patches. Of large meshes some
        triangles are looked at. Single triangles, as of the floor of a house, may follow the terrain.
        """
        terrain = self.ground
        if not isinstance(terrain, Terrain) or not terrain.relief or has_tracers((terrain, self.meshes)):
            return
        for n, mesh in enumerate(self.meshes):
            corners = mesh.some_corners(_TRIANGLES_ON_TERRAIN)
            eps = float(np.finfo(np.float32).eps)
            tolerance = max(MIN_GAP, 8.0 * eps * float(np.abs(corners[..., 2]).max()))
            follows = (np.abs(_clearance(terrain, corners)) < tolerance).all(axis=1)
            if np.mean(follows) <= 0.5:
                continue
            edges = 0.5 * (corners + np.roll(corners, 1, axis=1))[follows]
            clearance = _clearance(terrain, np.append(edges, edges.mean(axis=1, keepdims=True), axis=1))
            low, high = float(clearance.min()), float(clearance.max())
            if low < -tolerance and high > tolerance:
                raise ValueError(
                    f"meshes[{n}] follows the terrain, up to {-low:.2g} m below and {high:.2g} m above it: "
                    "light would meet patches of both; give one of them, or lift the mesh above the terrain"
                )

    @property
    def crs(self) -> str | None:
        """Coordinate reference system of terrain, voxel map and meshes; None if unknown."""
        ground = {"ground": self.ground.crs} if isinstance(self.ground, Terrain) else {}
        voxels = {} if self.canopy is None else {"canopy": self.canopy.voxels.crs}
        return common_system(
            ground | voxels | {f"meshes[{i}]": mesh.crs for i, mesh in enumerate(self.meshes)}
        )

    @property
    def gap(self) -> Float[Array, ""] | None:
        """Smallest distance, m, between parallel planes of the scene; None with fewer than two planes."""
        gaps = [gap for _, gap in _gaps(self.surfaces)]
        return jnp.min(jnp.stack(gaps)) if gaps else None

    @property
    def period(self) -> Float[Array, "2"] | None:
        """Periods along x and y, m, of a canopy or terrain with periodic sides; None without."""
        if self.canopy is not None and self.canopy.sides == "periodic":
            voxels = self.canopy.voxels
            return voxels.voxel_size[:2] * voxels.counts[:2].astype(float)
        if isinstance(self.ground, Terrain) and self.ground.sides == "periodic":
            return self.ground.spacing * np.array(self.ground.heights.shape, float)
        # Meshes know the period of what a simulation leaves out.
        return self.meshes[0].period if self.meshes else None

    @property
    def surfaces(self) -> tuple[AbstractSurface, ...]:
        """All surfaces in the order in which the tracer numbers them: ground, plates, materials of meshes."""
        ground = () if self.ground is None else (self.ground,)
        return (*ground, *self.plates, *itertools.chain(*(mesh.surfaces for mesh in self.meshes)))


def _clearance(terrain: Terrain, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Return the height of points above a terrain with relief, m; NaN beside it."""
    heights, origin, spacing = (concrete_array(a) for a in (terrain.heights, terrain.origin, terrain.spacing))
    nodes = np.moveaxis((points[..., :2] - origin) / spacing, -1, 0)
    mode = "grid-wrap" if terrain.sides == "periodic" else "constant"
    return points[..., 2] - scipy.ndimage.map_coordinates(
        heights.astype(float), nodes, order=1, mode=mode, cval=np.nan
    )


def _corners_of_cells(terrain: Terrain) -> Float[np.ndarray, "cells 4 3"]:
    """Return the four nodes of each cell of a terrain, m."""
    heights = concrete_array(terrain.heights)
    numbers = np.moveaxis(np.indices(heights.shape), 0, -1)
    places = concrete_array(terrain.origin) + numbers * concrete_array(terrain.spacing)
    nodes = np.concatenate([places, heights[..., None]], axis=-1)
    cells = (nodes[:-1, :-1], nodes[1:, :-1], nodes[:-1, 1:], nodes[1:, 1:])
    return np.stack(cells, axis=2).reshape(-1, 4, 3)


def _gaps(surfaces: tuple[AbstractSurface, ...]) -> Iterator[tuple[tuple[int, int], Float[Array, ""]]]:
    """Iterate over pairs of infinite planes: their numbers and distance in m, 1e30 if not parallel."""
    # A scene with one surface has no pairs, and need not compute its shape.
    planes = [(i, s.shape) for i, s in enumerate(surfaces)] if len(surfaces) > 1 else []
    planes = [(i, shape) for i, shape in planes if isinstance(shape, Plane)]
    for (i, first), (j, second) in itertools.combinations(planes, 2):
        parallel = jnp.abs(jnp.sum(first.upward * second.upward)) > 1.0 - 1e-6
        between = vec(there - here for here, there in zip(first.foot, second.foot))
        gap = jnp.abs(dot(vec(first.upward), between))
        yield (i, j), jnp.where(parallel, gap, FAR)


def check_periods(canopy: Canopy, terrain: Terrain) -> None:
    """Refuse a canopy with periodic sides over terrain of another period.

    **Raises:** ValueError with both periods.
    """
    size, spacing = concrete(canopy.voxels.voxel_size), concrete(terrain.spacing)
    if canopy.sides == "open" or size is None or spacing is None:
        return
    if terrain.sides == "open":
        raise ValueError(
            "the canopy has sides = 'periodic', the terrain 'open'; admissible for both is 'periodic'"
        )
    canopy_period, terrain_period = size[:2] * canopy.voxels.counts[:2], spacing * terrain.heights.shape
    if not np.allclose(canopy_period, terrain_period, rtol=1e-5, atol=0.0):
        raise ValueError(
            f"the canopy repeats after {canopy_period[0]:g} m and {canopy_period[1]:g} m, the terrain after "
            f"{terrain_period[0]:g} m and {terrain_period[1]:g} m; admissible are equal periods"
        )


def check_mesh_widths(meshes: tuple[MeshSurface, ...], period: Float[Array, "2"] | None) -> None:
    """Refuse meshes that are wider than the period with which they repeat: their copies would overlap.

    **Raises:** ValueError naming the instance, its width and the period.
    """
    period_value = None if period is None else concrete(period)
    if period_value is None or has_tracers(meshes):
        return
    for number, mesh in enumerate(meshes):
        boxes = mesh.bounds()
        width = boxes[:, 1, :2] - boxes[:, 0, :2]
        # The slack is the rounding of single precision.
        too_wide = np.argwhere(width > period_value * (1.0 + 1e-5))
        if len(too_wide):
            instance, axis = too_wide[0]
            raise ValueError(
                f"meshes[{number}]: instance {instance} is {width[instance, axis]:.6g} m wide along "
                f"{'xy'[axis]}; admissible with periodic sides is at most the period, "
                f"{period_value[axis]:.6g} m"
            )


def check_kinds(lidar: Any, scene: Any) -> None:
    """Refuse objects that are not a lidar and a scene, before anything is computed with them.

    **Arguments:**

    - `lidar`: an object that must be a `Lidar`.
    - `scene`: an object that must be a `Scene`.

    **Raises:** TypeError with the type of the object, and advice.
    """
    if isinstance(lidar, Scene) and isinstance(scene, Lidar):
        raise TypeError("lidar is a Scene and scene is a Lidar: they are swapped")
    for field, x, kind in (("lidar", lidar, Lidar), ("scene", scene, Scene)):
        name = kind.__name__
        if isinstance(x, list | tuple):
            advice = " (to fit many shots: inversion.retrieve_many)" if kind is Lidar else ""
            raise TypeError(
                f"{field} is {kind_of(x)}; admissible is one {name}: simulate several in a loop{advice}"
            )
        argument = next((text for text, types in _SCENE_ARGUMENTS.items() if isinstance(x, types)), None)
        hint = f", as in Scene({argument})" if kind is Scene and argument else ""
        check_kind(field, x, kind, f"a {name}{hint}")


# Elements that are given in the place of a scene, by the argument of `Scene` that takes them.
_SCENE_ARGUMENTS = {
    "canopy=canopy": Canopy,
    "canopy=Canopy(voxels, leaf=...)": VoxelMap,
    "plates=(plate,)": AbstractSheet,
    "ground=ground": AbstractGround,
    "atmosphere=atmosphere": Atmosphere,
    "meshes=(mesh,)": MeshSurface,
}
