"""What a table of a case file can stand for: classes and functions of jaxlidar, with arguments and units."""

import dataclasses
import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx

from jaxlidar._deprecated import RENAMED, warn_renamed
from jaxlidar._registry import public_objects
from jaxlidar.instrument.pulse import SampledPulse
from jaxlidar.instrument.survey import Survey
from jaxlidar.io.dem import DemRead, read_dem
from jaxlidar.io.obj import MeshRead, read_obj
from jaxlidar.io.vox import VoxelsRead, read_vox
from jaxlidar.optics.coefficients import Coefficients, load_coefficients
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import read_spectrum_csv, spectrum
from jaxlidar.plants.forest import forest
from jaxlidar.plants.habits import Branching, Habit, broadleaf, conifer, grow, shrub, spreading_tree
from jaxlidar.plants.meshes import voxelise_mesh
from jaxlidar.plants.voxelise import trim_empty_layers, voxelise
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, Ground, Plate
from jaxlidar.scenes.voxels import VoxelMap

# Classes of these rooms are kinds, if the package exports them.
ROOMS = ("jaxlidar.optics.", "jaxlidar.instrument.", "jaxlidar.scenes.")
# But for what comes after a simulation.
RECORDS = ("PhotonCounter", "PhotonEvents")
# Other ways to make a part of a scene.
MAKERS: tuple[Callable[..., Any], ...] = (
    *(Branching, Habit, broadleaf, conifer, shrub, spreading_tree, grow, forest),
    *(voxelise, voxelise_mesh, trim_empty_layers),
    *(VoxelMap.from_lad, VoxelMap.from_extinction, VoxelMap.from_probability),
    *(Survey.grid, Survey.track, Survey.scan),
    *(LeafAngles.named, LeafAngles.beta, Prospect.paper),
    *(spectrum, read_spectrum_csv, read_vox, read_dem, read_obj, load_coefficients, Coefficients),
)
# What a table without `kind` stands for where any class of these is admissible.
USUAL = {AbstractGround: Ground, AbstractSheet: Plate}
# Where an argument is not stored under its own name.
STORED = {(SampledPulse, "power"): "samples"}

DEGREES = "degrees"
COMPASS = "degrees clockwise from north"
UNITS = {
    "aerosol_scale_height": "m",
    "alpha": DEGREES,
    "altitude": "m",
    "angle": DEGREES,
    "angle_spread": DEGREES,
    "aperture": "m",
    "area": "m",
    "aspect": COMPASS,
    "azimuth": COMPASS,
    "background": "J per sample",
    "base_height": "m",
    "beam_spacing": "m",
    "bend": DEGREES,
    "bin_width": "ns",
    "bounds": "m",
    "Cab": "ug/cm2",
    "Cant": "ug/cm2",
    "Car": "ug/cm2",
    "Cc": "g/cm2",
    "clump_diameter": "m",
    "Cm": "g/cm2",
    "Cp": "g/cm2",
    "Cw": "cm",
    "decay": "ns",
    "detection_threshold": "J per sample",
    "divergence": "mrad",
    "electronic_noise": "J per sample",
    "end": "m",
    "energy": "J",
    "field_of_view": "mrad",
    "frequency": "1/s",
    "fwhm": "ns",
    "half_angle": DEGREES,
    "height": "m",
    "heights": "m",
    "jitter": "ns",
    "leaf_area": "m2",
    "length": "ns",
    "lidar_ratio": "sr",
    "line_rate": "1/s",
    "max_seconds": "s",
    "mean": DEGREES,
    "std": DEGREES,
    "max_step": "m",
    "minimum_distance": "m",
    "origin": "m",
    "position": "m",
    "pulse_rate": "1/s",
    "rayleigh_scale_height": "m",
    "roughness": "rad",
    "sampling_interval": "ns",
    "saturation": "J per sample",
    "shoot_angle": DEGREES,
    "shoot_length": "m",
    "slope": DEGREES,
    "smallest_diameter": "m",
    "spacing": "m",
    "speed": "m/s",
    "start": "m",
    "stem_angle": DEGREES,
    "time": "ns",
    "tropism": DEGREES,
    "trunk_diameter": "m",
    "visibility": "km",
    "voxel_size": "m",
    "wavelength": "nm",
    "window": "ns",
    "zenith": DEGREES,
}
# Where the same name has a unit in one class alone.
UNITS_OF = {
    (Branching, "divergence"): DEGREES,
    (read_dem, "fill"): "m",
    (Survey.grid, "low"): "m",
    (Survey.grid, "high"): "m",
    (VoxelMap, "leaf"): "1/m",
    (VoxelMap, "bark"): "1/m",
}


class Argument(NamedTuple):
    """An argument of a kind: what it may be, whether it must be given, its unit, and where it is stored."""

    annotation: Any
    required: bool
    unit: str
    stored: str


@functools.cache
def kinds() -> Mapping[str, Callable[..., Any]]:
    """All kinds by name: exported classes of scenes, lidars and optics, and functions that make them."""
    classes = {
        name: value
        for name, value in public_objects.items()
        if isinstance(value, type)
        and issubclass(value, eqx.Module)
        and value.__module__.startswith(ROOMS)
        and not inspect.isabstract(value)
        and name not in RECORDS
    }
    return {**classes, **{maker.__qualname__: maker for maker in MAKERS}}


def current_kind(name: str) -> str:
    """Return the present name of a kind; where `name` is one from before a renaming, warn."""
    if name in kinds() or RENAMED.get(name) not in kinds():
        return name
    warn_renamed(f"kind = {name!r}", f"kind = {RENAMED[name]!r}")
    return RENAMED[name]


@functools.cache
def arguments_of(maker: Callable[..., Any]) -> Mapping[str, Argument]:
    """The arguments of a class or function by name, in their order."""
    # Signatures are shortened for display; the annotations of fields and functions are the real ones.
    own = dataclasses.fields(maker) if isinstance(maker, type) and dataclasses.is_dataclass(maker) else ()
    fields = {f.name: f for f in own}
    annotations = inspect.get_annotations(maker.__init__ if isinstance(maker, type) else maker)
    found = {}
    for name, parameter in inspect.signature(maker).parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            # Of habits by name: changes of what they have.
            return arguments_of(Habit)
        stored = STORED.get((maker, name), name)  # pyright: ignore[reportArgumentType, reportCallIssue]
        annotation = fields[stored].type if stored in fields else annotations.get(name, Any)
        unit = UNITS_OF.get((maker, name), UNITS.get(name, ""))  # pyright: ignore[reportArgumentType, reportCallIssue]
        found[name] = Argument(annotation, parameter.default is parameter.empty, unit, stored)
    return found


def made(maker: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """What a class or function gives; of what a reader reports, the voxel map, terrain or mesh alone.

    **Raises:** what `maker` raises; ValueError where a reader left anything out.
    """
    result = maker(**arguments)
    if isinstance(result, DemRead):
        return result.terrain
    if isinstance(result, MeshRead):
        return result.mesh
    if not isinstance(result, VoxelsRead):
        return result
    left_out = ", ".join(f"{count} {reason}" for reason, count in result.dropped.items() if count)
    if left_out and "fill" not in arguments:
        raise ValueError(
            f"the file has voxels without a density ({left_out}): give fill, the density that they take"
        )
    return result.voxels


def choices(annotation: Any) -> tuple[Any, ...]:
    """The members of a union, or the annotation itself."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return tuple(c for member in typing.get_args(annotation) for c in choices(member))
    return (annotation,)


def item_of(annotation: Any) -> Any:
    """What the items of a sequence may be."""
    for choice in choices(annotation):
        if typing.get_origin(choice) in (tuple, list, Iterable, Sequence) and typing.get_args(choice):
            return typing.get_args(choice)[0]
    return Any


def is_tuple(annotation: Any) -> bool:
    """Whether a tuple is admissible."""
    return any(choice is tuple or typing.get_origin(choice) is tuple for choice in choices(annotation))


def is_text(annotation: Any) -> bool:
    """Whether a string is admissible."""
    return any(choice is str for choice in choices(annotation))


def usual_of(annotation: Any) -> Callable[..., Any] | None:
    """The one class that an argument can be, if there is only one, or one that is usual."""
    known = set(kinds().values())
    found = {USUAL.get(choice, choice) for choice in choices(annotation) if isinstance(choice, type)}
    fitting = [kind for kind in found if kind in known]
    return fitting[0] if len(fitting) == 1 else None
