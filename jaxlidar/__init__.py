"""A differentiable simulator of full-waveform lidar in JAX.

`simulate` gives the waveform of a `Lidar` over a `Scene`. Readers of files are in `jaxlidar.io`, figures in
`jaxlidar.plot`, and what extensions build on in `jaxlidar.extend`. Classes of results are documented with
the functions that return them, in the modules of these. Retrieval of scene properties from
waveforms is in the package `inversion`.

## Simulate a waveform

`simulate`, `Waveform`, `total_reflectance`, `Progress`, `open`, `rerun`.

## The instrument

`Lidar`, `instrument`, `instruments`, `instrument_sources`, `AbstractPulse`, `GaussianPulse`,
`ExponentiallyModifiedGaussianPulse`, `RectangularPulse`, `SampledPulse`.

## Record as a receiver does

`record`, `Receiver`, `first_return_window`, `PhotonCounter`.

## Surveys of many shots

`Survey`, `Trajectory`, `AbstractScan`, `Oscillating`, `RotatingPolygon`, `Conical`, `Panorama`, `Risley`,
`ground_position`, `simulate_many`, `simulate_tiles`, `Waveforms`, `SceneParts`, `DiscreteReturns`.

## Many scenes

`simulate_scenes`, `plan_scenes`.

## Scenes

`Scene`, `Canopy`, `VoxelMap`, `Ground`, `Terrain`, `Plate`, `MeshSurface`, `MeshInstances`, `Atmosphere`,
`AbstractGround`, `AbstractSheet`, `AbstractShape`, `Plane`.

## Leaf optics and spectra

`Prospect`, `LeafOptics`, `plate_model`, `load_coefficients`, `Spectrum`, `spectrum`, `spectrum_names`,
`read_spectrum_csv`.

## Reflection, scattering and leaf angles

`AbstractLaw`, `Lambertian`, `Specular`, `EqualAngle`, `leaf_surface`, `LeafAngles`, `AbstractPhase`,
`Isotropic`, `HenyeyGreenstein`.

## Plants

`Habit`, `Branching`, `broadleaf`, `conifer`, `shrub`, `spreading_tree`, `grow`, `forest`,
`stand_of_leaf_area`, `stand_from_inventory`, `Stand`, `Tree`, `LSystem`, `Rule`, `turtle`, `voxelise`,
`voxelise_points`, `canopy_from_points`, `voxelise_mesh`, `Mesh`, `mesh_of`, `leaf_mesh`.

## Sunlight

`reflectance_factor`, `plan_reflectance`.

## Truth and energy

`truth_of`, `energy_budget`.

## The steps of a simulation

`plan`, `Plan`, `make_setup`, `trace_scene`, `waveform_of`.

## Compiled programs

`compilation_cache`.

## Warnings and constants

`LateLightWarning`, `UnfollowedLightWarning`, `MisplacedCanopyWarning`, `LostWorkersWarning`, `OffMapWarning`,
`OutlineWarning`, `SolidMeshWarning`, `UnitWarning`, `SPEED_OF_LIGHT`.

## Packages of their own

`io`, `plot`, `extend`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxlidar import extend, io
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import UnitWarning
from jaxlidar._fingerprint import version_of
from jaxlidar._jax.compilation_cache import compilation_cache
from jaxlidar._jax.workers import LostWorkersWarning
from jaxlidar._registry import register_public_objects, waveform_html
from jaxlidar.optics.coefficients import load_coefficients
from jaxlidar.optics.laws import AbstractLaw, EqualAngle, Lambertian, Specular
from jaxlidar.optics.leaf import LeafOptics
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.optics.leaf_surface import leaf_surface
from jaxlidar.optics.phase import AbstractPhase, HenyeyGreenstein, Isotropic
from jaxlidar.optics.plate_model import plate_model
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import Spectrum, read_spectrum_csv, spectrum, spectrum_names
from jaxlidar.planning.plan import Plan, plan
from jaxlidar.planning.scene_family import plan_scenes
from jaxlidar.planning.setup import make_setup
from jaxlidar.plants.forest import forest, stand_of_leaf_area
from jaxlidar.plants.habits import Branching, Habit, broadleaf, conifer, grow, shrub, spreading_tree
from jaxlidar.plants.inventory import stand_from_inventory
from jaxlidar.plants.leaf_mesh import leaf_mesh
from jaxlidar.plants.lsystem import LSystem, Rule
from jaxlidar.plants.meshes import Mesh, SolidMeshWarning, mesh_of, voxelise_mesh
from jaxlidar.plants.point_canopy import canopy_from_points
from jaxlidar.plants.stand import Stand
from jaxlidar.plants.tree import Tree
from jaxlidar.plants.turtle import turtle
from jaxlidar.plants.voxelise import voxelise, voxelise_points
from jaxlidar.progress import Progress
from jaxlidar.results.netcdf import open, rerun
from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.mesh_surface import MeshInstances, MeshSurface
from jaxlidar.scenes.relative_height import MisplacedCanopyWarning
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.scene_parts import SceneParts
from jaxlidar.scenes.shapes import AbstractShape, OutlineWarning, Plane
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, Ground, Plate
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.sensors.catalogue import instrument, instrument_sources, instruments
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.photon_counter import PhotonCounter
from jaxlidar.sensors.pulse import (
    AbstractPulse,
    ExponentiallyModifiedGaussianPulse,
    GaussianPulse,
    RectangularPulse,
    SampledPulse,
)
from jaxlidar.sensors.receiver import Receiver, first_return_window, record
from jaxlidar.sensors.scan import AbstractScan, Conical, Oscillating, Panorama, Risley, RotatingPolygon
from jaxlidar.sensors.survey import Survey
from jaxlidar.sensors.trajectory import Trajectory
from jaxlidar.simulation.energy import energy_budget
from jaxlidar.simulation.many_scenes import simulate_scenes
from jaxlidar.simulation.one_scene import LateLightWarning, UnfollowedLightWarning, simulate
from jaxlidar.simulation.reflectance import plan_reflectance, reflectance_factor
from jaxlidar.simulation.truth import truth_of
from jaxlidar.spectral.waveform import Waveform, total_reflectance, waveform_of
from jaxlidar.survey.cloud_tiles import simulate_tiles
from jaxlidar.survey.coverage import OffMapWarning, ground_position
from jaxlidar.survey.returns import DiscreteReturns
from jaxlidar.survey.simulate_many import simulate_many
from jaxlidar.survey.waveforms import Waveforms
from jaxlidar.trace.response import trace_scene

if TYPE_CHECKING:
    from jaxlidar import plot

__all__ = [
    # Simulate a waveform.
    "simulate",
    "Waveform",
    "total_reflectance",
    "Progress",
    "open",
    "rerun",
    # The instrument.
    "Lidar",
    "instrument",
    "instruments",
    "instrument_sources",
    "AbstractPulse",
    "GaussianPulse",
    "ExponentiallyModifiedGaussianPulse",
    "RectangularPulse",
    "SampledPulse",
    # Record as a receiver does.
    "record",
    "Receiver",
    "first_return_window",
    "PhotonCounter",
    # Surveys of many shots.
    "Survey",
    "Trajectory",
    "AbstractScan",
    "Oscillating",
    "RotatingPolygon",
    "Conical",
    "Panorama",
    "Risley",
    "ground_position",
    "simulate_many",
    "simulate_tiles",
    "Waveforms",
    "SceneParts",
    "DiscreteReturns",
    # Many scenes.
    "simulate_scenes",
    "plan_scenes",
    # Scenes.
    "Scene",
    "Canopy",
    "VoxelMap",
    "Ground",
    "Terrain",
    "Plate",
    "MeshSurface",
    "MeshInstances",
    "Atmosphere",
    "AbstractGround",
    "AbstractSheet",
    "AbstractShape",
    "Plane",
    # Leaf optics and spectra.
    "Prospect",
    "LeafOptics",
    "plate_model",
    "load_coefficients",
    "Spectrum",
    "spectrum",
    "spectrum_names",
    "read_spectrum_csv",
    # Reflection, scattering and leaf angles.
    "AbstractLaw",
    "Lambertian",
    "Specular",
    "EqualAngle",
    "leaf_surface",
    "LeafAngles",
    "AbstractPhase",
    "Isotropic",
    "HenyeyGreenstein",
    # Plants.
    "Habit",
    "Branching",
    "broadleaf",
    "conifer",
    "shrub",
    "spreading_tree",
    "grow",
    "forest",
    "stand_of_leaf_area",
    "stand_from_inventory",
    "Stand",
    "Tree",
    "LSystem",
    "Rule",
    "turtle",
    "voxelise",
    "voxelise_points",
    "canopy_from_points",
    "voxelise_mesh",
    "Mesh",
    "mesh_of",
    "leaf_mesh",
    # Sunlight.
    "reflectance_factor",
    "plan_reflectance",
    # Truth and energy.
    "truth_of",
    "energy_budget",
    # The steps of a simulation.
    "plan",
    "Plan",
    "make_setup",
    "trace_scene",
    "waveform_of",
    # Compiled programs.
    "compilation_cache",
    # Warnings and constants.
    "LateLightWarning",
    "UnfollowedLightWarning",
    "MisplacedCanopyWarning",
    "LostWorkersWarning",
    "OffMapWarning",
    "OutlineWarning",
    "SolidMeshWarning",
    "UnitWarning",
    "SPEED_OF_LIGHT",
    # Packages of their own.
    "io",
    "plot",
    "extend",
]

__version__ = version_of("jaxlidar")


def __dir__() -> list[str]:
    # Public names alone, without the modules and helpers that the imports leave here.
    return sorted(__all__)


# Tables of TOML files (`jaxlidar.io.read_case`) name classes as they are exported here.
register_public_objects({name: globals()[name] for name in __all__ if name != "plot"})


# matplotlib takes a while to import: only for those who draw.
@waveform_html.register
def _waveform_html(wave: Waveform) -> str:
    from jaxlidar.plot.html import waveform_html

    return waveform_html(wave)


def __getattr__(name: str) -> Any:
    if name == "plot":
        return importlib.import_module("jaxlidar.plot")
    raise AttributeError(f"module 'jaxlidar' has no attribute {name!r}")
