"""A differentiable simulator of full-waveform lidar in JAX.

`simulate` gives the waveform of a `Lidar` over a `Scene`. Its steps can also be taken one by one: `plan`,
`reduce`, `trace_scene`, `waveform_of`.

Readers of files are in `jaxlidar.io`, figures in `jaxlidar.plot`, and what extensions build on in
`jaxlidar.extend`. Retrieval of scene properties from waveforms is in the package `inversion`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxlidar import extend, io
from jaxlidar._checks import UnitWarning
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._progress import Progress
from jaxlidar._workers import LostWorkersWarning
from jaxlidar.analog import AnalogReturns, analog_returns, photon_paths
from jaxlidar.energy import EnergyBudget, energy_budget
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.photon_counter import PhotonCounter, PhotonEvents
from jaxlidar.instrument.pulse import (
    AbstractPulse,
    ExponentiallyModifiedGaussianPulse,
    GaussianPulse,
    RectangularPulse,
    SampledPulse,
)
from jaxlidar.instrument.receiver import Receiver, first_return_window, record
from jaxlidar.instrument.scan import AbstractScan, Conical, Oscillating, RotatingPolygon
from jaxlidar.instrument.survey import Survey
from jaxlidar.io.netcdf import open, repeat
from jaxlidar.optics.coefficients import load_coefficients
from jaxlidar.optics.laws import AbstractLaw, AbstractMirror, EqualAngle, Lambertian, Specular
from jaxlidar.optics.leaf import LeafOptics
from jaxlidar.optics.leaf_angles import LeafAngles
from jaxlidar.optics.leaf_surface import LeafSurface, leaf_surface
from jaxlidar.optics.phase import AbstractPhase, HenyeyGreenstein, Isotropic
from jaxlidar.optics.plate_model import plate_model
from jaxlidar.optics.prospect import Prospect, prospect_jacobian, prospect_spectra
from jaxlidar.optics.spectra import Spectrum, read_spectrum_csv, spectra, spectrum
from jaxlidar.planning.effects import Effect
from jaxlidar.planning.plan import Plan, plan
from jaxlidar.planning.setup import Setup, reduce
from jaxlidar.plants.forest import forest
from jaxlidar.plants.habits import Branching, Habit, broadleaf, conifer, grow, shrub, spreading
from jaxlidar.plants.lsystem import LSystem, Module, Rule, Word
from jaxlidar.plants.meshes import Mesh, voxelise_mesh
from jaxlidar.plants.tree import Tree
from jaxlidar.plants.turtle import turtle
from jaxlidar.plants.voxelise import crop, voxelise, voxelise_points
from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.scene_parts import SceneParts
from jaxlidar.scenes.shapes import AbstractShape, Plane
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, AbstractSurface, Ground, Plate
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.scenes.voxels import VoxelMap
from jaxlidar.simulate import LateLightWarning, simulate
from jaxlidar.survey.coverage import OffMapWarning
from jaxlidar.survey.progress import SurveyProgress
from jaxlidar.survey.simulate_many import simulate_many
from jaxlidar.survey.truths import Truths
from jaxlidar.survey.waveforms import Waveforms
from jaxlidar.trace.response import Response, trace_scene
from jaxlidar.truth import Truth, truth_of
from jaxlidar.waveform import Waveform, total_of, waveform_of

if TYPE_CHECKING:
    from jaxlidar import plot

__all__ = [
    "SPEED_OF_LIGHT",
    "AbstractGround",
    "AbstractLaw",
    "AbstractMirror",
    "AbstractPhase",
    "AbstractPulse",
    "AbstractScan",
    "AbstractShape",
    "AbstractSheet",
    "AbstractSurface",
    "AnalogReturns",
    "Atmosphere",
    "Branching",
    "Canopy",
    "Conical",
    "Effect",
    "EnergyBudget",
    "EqualAngle",
    "ExponentiallyModifiedGaussianPulse",
    "GaussianPulse",
    "Ground",
    "Habit",
    "HenyeyGreenstein",
    "Isotropic",
    "LSystem",
    "Lambertian",
    "LateLightWarning",
    "LeafAngles",
    "LeafOptics",
    "LeafSurface",
    "Lidar",
    "LostWorkersWarning",
    "Mesh",
    "Module",
    "OffMapWarning",
    "Oscillating",
    "PhotonCounter",
    "PhotonEvents",
    "Plan",
    "Plane",
    "Plate",
    "Progress",
    "Prospect",
    "Receiver",
    "RectangularPulse",
    "Response",
    "RotatingPolygon",
    "Rule",
    "SampledPulse",
    "Scene",
    "SceneParts",
    "Setup",
    "Specular",
    "Spectrum",
    "Survey",
    "SurveyProgress",
    "Terrain",
    "Tree",
    "Truth",
    "Truths",
    "UnitWarning",
    "VoxelMap",
    "Waveform",
    "Waveforms",
    "Word",
    "analog_returns",
    "broadleaf",
    "conifer",
    "crop",
    "energy_budget",
    "extend",
    "first_return_window",
    "forest",
    "grow",
    "io",
    "leaf_surface",
    "load_coefficients",
    "open",
    "photon_paths",
    "plan",
    "plate_model",
    "plot",
    "prospect_jacobian",
    "prospect_spectra",
    "read_spectrum_csv",
    "record",
    "reduce",
    "repeat",
    "shrub",
    "simulate",
    "simulate_many",
    "spectra",
    "spectrum",
    "spreading",
    "total_of",
    "trace_scene",
    "truth_of",
    "turtle",
    "voxelise",
    "voxelise_mesh",
    "voxelise_points",
    "waveform_of",
]


def __getattr__(name: str) -> Any:
    # matplotlib takes a while to import: only for those who draw.
    if name == "plot":
        return importlib.import_module("jaxlidar.plot")
    raise AttributeError(f"module 'jaxlidar' has no attribute {name!r}")
