"""Kinds of the tables of a case file: classes and functions of jaxlidar, with their arguments and units."""

import dataclasses
import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxlidar._fields.checks import check_kind, concrete_array
from jaxlidar._fields.ranges import COMPASS, DEGREES
from jaxlidar._registry import public_objects
from jaxlidar.formats.dem import DemRead, read_dem
from jaxlidar.formats.inventory import read_inventory
from jaxlidar.formats.las import read_las
from jaxlidar.formats.meshes import MeshRead, read_mesh
from jaxlidar.formats.qsm import TreeRead, read_qsm
from jaxlidar.formats.trajectory import read_trajectory
from jaxlidar.formats.vox import VoxelsRead, read_vox
from jaxlidar.optics.coefficients import Coefficients, load_coefficients
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import read_spectrum_csv, spectrum
from jaxlidar.plants.forest import forest, stand_of_leaf_area
from jaxlidar.plants.habits import Branching, Habit, broadleaf, conifer, grow, shrub, spreading_tree
from jaxlidar.plants.inventory import stand_from_inventory
from jaxlidar.plants.meshes import Mesh, mesh_of, voxelise_mesh
from jaxlidar.plants.point_canopy import PointCanopy, canopy_from_points
from jaxlidar.plants.point_cloud import PointCloud
from jaxlidar.plants.stand import Stand
from jaxlidar.plants.voxelise import voxelise, voxelise_points
from jaxlidar.scenes.mesh_surface import MeshSurface
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, Ground, Plate
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.sensors.catalogue import instrument
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.pulse import SampledPulse
from jaxlidar.sensors.receiver import Receiver
from jaxlidar.sensors.survey import Survey

# Exported classes of these packages are kinds.
_PACKAGES = ("jaxlidar.optics.", "jaxlidar.sensors.", "jaxlidar.scenes.")
# Functions that return scenes or lidars, or objects in them, and classes of other packages.
_FUNCTIONS: tuple[Callable[..., Any], ...] = (
    *(Branching, Habit, broadleaf, conifer, shrub, spreading_tree, grow, forest),
    *(stand_of_leaf_area, stand_from_inventory, read_inventory, Stand, Stand.above, Stand.joined),
    *(voxelise, voxelise_mesh, VoxelMap.trimmed, Mesh, mesh_of, VoxelMap.above),
    *(canopy_from_points, voxelise_points, read_las, read_qsm),
    *(VoxelMap.from_lad, VoxelMap.from_extinction, VoxelMap.from_probability),
    *(Survey.grid, Survey.track, Survey.scan, Survey.fly, read_trajectory, instrument),
    *(LeafAngles.named, LeafAngles.beta, Prospect.paper),
    *(spectrum, read_spectrum_csv, read_vox, read_dem, read_mesh, load_coefficients, Coefficients),
)
# Methods among them, with the class of their object and the name of the argument that it is.
_METHODS = {
    Stand.above: (Stand, "stand"),
    VoxelMap.above: (VoxelMap, "voxels"),
    VoxelMap.trimmed: (VoxelMap, "voxels"),
}
# The class of a table without `kind`, by the abstract class that is admissible.
_DEFAULT_CLASSES = {AbstractGround: Ground, AbstractSheet: Plate}
# The class of such a table where several are admissible.
_PREFERRED_CLASSES = {Receiver}
# Fields of arguments that are not stored under their own name.
_FIELD_NAMES = {
    (SampledPulse, "power"): "samples",
    (Survey, "position"): "aim_position",
    (Survey, "sensor"): "sensor_position",
}
# Another way to give what a further argument holds, which is the one that is written.
ALTERNATIVE_ARGUMENTS = {(Lidar, "sensor")}

# Units of arguments by name. The fields that `quantity` makes state theirs where they are defined.
UNITS = {
    "alpha": DEGREES,
    "altitude": "m",
    "angle": DEGREES,
    "angle_spread": DEGREES,
    "area": "m",
    "attitude": DEGREES,
    "azimuth": COMPASS,
    "beam_spacing": "m",
    "bend": DEGREES,
    "bin_width": "ns",
    "bounds": "m",
    "clump_diameter": "m",
    "divergence": DEGREES,
    "ellipse_turn": DEGREES,
    "end": "m",
    "frequency": "1/s",
    "gps_time": "s",
    "half_angle": DEGREES,
    "incidence": DEGREES,
    "height": "m",
    "heights": "m",
    "leaf_area": "m2",
    "leaf_length": "m",
    "line_rate": "1/s",
    "max_seconds": "s",
    "mean": DEGREES,
    "std": DEGREES,
    "max_step": "m",
    "lever_arm": "m",
    "minimum_distance": "m",
    "mounting": DEGREES,
    "origin": "m",
    "points": "m",
    "position": "m",
    "pitch": DEGREES,
    "pulse_rate": "1/s",
    "roll": DEGREES,
    "scan_angle": DEGREES,
    "sensor": "m",
    "shoot_angle": DEGREES,
    "shoot_length": "m",
    "smallest_diameter": "m",
    "spacing": "m",
    "stated": "m and degrees",
    "step": DEGREES,
    "speed": "m/s",
    "start": "m",
    "stem_angle": DEGREES,
    "time": "s",
    "tropism": DEGREES,
    "trunk_diameter": "m",
    "voxel_size": "m",
    "wavelength": "nm",
    "wedge": DEGREES,
    "window": "ns",
    "yaw": COMPASS,
    "zenith": DEGREES,
}
# Where the same name has a unit in one class alone.
UNITS_OF = {
    (read_dem, "fill"): "m",
    (stand_from_inventory, "area"): "m2",
    (Mesh, "vertices"): "m",
    (Survey.grid, "low"): "m",
    (Survey.grid, "high"): "m",
}


class Argument(NamedTuple):
    """An argument of a kind: annotation, True if it has no default, unit, and the field with its value."""

    annotation: Any
    required: bool
    unit: str
    field: str


@functools.cache
def kinds() -> Mapping[str, Callable[..., Any]]:
    """Return all kinds by name: exported classes of scenes, lidars and optics, and functions."""
    classes = {
        name: value
        for name, value in public_objects.items()
        if isinstance(value, type)
        and issubclass(value, eqx.Module)
        and value.__module__.startswith(_PACKAGES)
        and not inspect.isabstract(value)
    }
    return {**classes, **{function.__qualname__: function for function in _FUNCTIONS}}


@functools.cache
def arguments_of(kind: Callable[..., Any]) -> Mapping[str, Argument]:
    """Return the arguments of a class or function by name, in their order."""
    # Signatures are shortened for display; the annotations of fields and functions are the real ones.
    fields = {}
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        fields = {field.name: field for field in dataclasses.fields(kind)}
    annotations = inspect.get_annotations(kind.__init__ if isinstance(kind, type) else kind)
    arguments = {}
    for name, parameter in inspect.signature(kind).parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            # The functions of habits, such as `broadleaf`, take changes of the fields of a `Habit`.
            return arguments_of(Habit)
        if name == "self":
            own_class, own_name = _METHODS[kind]
            arguments[own_name] = Argument(own_class, True, "", own_name)
            continue
        field = _FIELD_NAMES.get((kind, name), name)  # pyright: ignore[reportArgumentType, reportCallIssue]
        annotation = fields[field].type if field in fields else annotations.get(name, Any)
        unit = UNITS_OF.get((kind, name), UNITS.get(name, ""))  # pyright: ignore[reportArgumentType, reportCallIssue]
        if field in fields:
            unit = str(fields[field].metadata.get("unit") or unit)
        arguments[name] = Argument(annotation, parameter.default is parameter.empty, unit, field)
    return arguments


def argument_value(value: Any, name: str, argument: Argument) -> Any:
    """Return what an object was made of, as the argument with this name."""
    if isinstance(value, MeshSurface) and name == "mesh":
        return _mesh_of_surface(value)
    return getattr(value, argument.field)


def _mesh_of_surface(surface: MeshSurface) -> Mesh:
    """Return the mesh of a surface, without the triangles that fill up its tree."""
    stated = () if surface.instance is None else (surface.instance,)
    rows = np.unique(np.column_stack([surface.faces, surface.group, *stated]), axis=0)
    vertices = concrete_array(surface.vertices) + surface.origin
    instance = rows[:, 4] if stated else None
    return Mesh(vertices, rows[:, :3], rows[:, 3], surface.materials or ("mesh",), instance)


def call_kind(kind: Callable[..., Any], arguments: Mapping[str, Any], annotation: Any = Any) -> Any:
    """Return the result of a class or function; of that of a reader, the object that `annotation` asks for.

    **Raises:** what `kind` raises; ValueError where a reader left voxels out that no `fill` is given for, and
    where a point cloud has no terrain.
    """
    arguments = dict(arguments)
    if kind in _METHODS:
        own_class, own_name = _METHODS[kind]
        check_kind(own_name, arguments[own_name], own_class, f"a {own_class.__name__}")
        return kind(arguments.pop(own_name), **arguments)
    if kind is voxelise_points and isinstance(arguments["points"], PointCloud):
        arguments["points"] = arguments["points"].position
    result = kind(**arguments)
    if isinstance(result, DemRead):
        return result.terrain
    if isinstance(result, MeshRead):
        return result.mesh
    if isinstance(result, TreeRead):
        return result.tree
    if isinstance(result, PointCanopy):
        return _of_points(result, annotation)
    if not isinstance(result, VoxelsRead):
        return result
    left_out = ", ".join(f"{count} {reason}" for reason, count in result.dropped.items() if count)
    if left_out and "fill" not in arguments:
        raise ValueError(
            f"the file has voxels without a density ({left_out}): give fill, the density that they take"
        )
    return result.voxels


def _of_points(result: PointCanopy, annotation: Any) -> Any:
    """Return the terrain of a point cloud where a ground is admissible, and its voxel map elsewhere."""
    classes = [member for member in union_members(annotation) if isinstance(member, type)]
    if not any(issubclass(member, AbstractGround) for member in classes):
        return result.voxels
    if result.terrain is None:
        raise ValueError("points have no ground returns of which a terrain could be made")
    return result.terrain


def union_members(annotation: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the annotation itself."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return tuple(m for argument in typing.get_args(annotation) for m in union_members(argument))
    return (annotation,)


def item_annotation(annotation: Any) -> Any:
    """Return the annotation of the items of a sequence."""
    for member in union_members(annotation):
        if typing.get_origin(member) in (tuple, list, Iterable, Sequence) and typing.get_args(member):
            return typing.get_args(member)[0]
    return Any


def admits_tuple(annotation: Any) -> bool:
    """Return True if a tuple is admissible."""
    return any(m is tuple or typing.get_origin(m) is tuple for m in union_members(annotation))


def admits_text(annotation: Any) -> bool:
    """Return True if a string is admissible."""
    return any(member is str for member in union_members(annotation))


def admits_numbers_alone(annotation: Any) -> bool:
    """Return True if numbers, arrays of them and None are all that is admissible."""
    members = [member for member in union_members(annotation) if member is not types.NoneType]
    return bool(members) and all(hasattr(m, "dim_str") or m in (float, int) for m in members)


def admits_mapping(annotation: Any) -> bool:
    """Return True if a mapping is admissible."""
    classes = (getattr(member, "__origin__", member) for member in union_members(annotation))
    return any(isinstance(c, type) and issubclass(c, Mapping) for c in classes)


def default_kind(annotation: Any) -> Callable[..., Any] | None:
    """Return the class of a table without `kind`: the only one that is admissible, or a default class."""
    classes = {_DEFAULT_CLASSES.get(m, m) for m in union_members(annotation) if isinstance(m, type)}
    admissible = classes & set(kinds().values())
    admissible = admissible & _PREFERRED_CLASSES or admissible
    return admissible.pop() if len(admissible) == 1 else None
