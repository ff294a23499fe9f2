"""Retrieval of scene properties from waveforms: fits with standard errors, and tools that need no model.

## Fits with a model

`Problem`, `retrieve`, `retrieve_many`, `Unknown`, `LogNormal`, `Smooth`, `put_profile`, `Retrieval`,
`Step`, `AveragingKernel`.

## Identifiability and verdicts

`cramer_rao`, `CramerRao`, `profile_likelihood`, `Profile`, `judge_fit`, `judge_fits`, `judge_record`,
`Verdict`.

## Design of instruments

`design`, `Design`.

## Posteriors

`log_density`, `LogDensity`.

## Echoes and deconvolution

`gaussian_decomposition`, `Echoes`, `echo_points`, `EchoPoints`, `richardson_lucy`, `wiener`.

## Heights, cover and plant area

`find_ground`, `signal_ends`, `SignalEnds`, `relative_heights`, `ground_and_canopy`, `GroundAndCanopy`,
`gap_probability`, `plant_area_index`, `plant_area_profile`.

## GEDI and photon counters

`gedi_metrics`, `GediMetrics`, `gedi_settings`, `GediSettings`, `gedi_table`,
`photon_ground_and_canopy`, `PhotonHeights`.

## Comparison with references

`compare`, `Comparison`, `ComparisonStatistics`, `ComparedColumn`.

## The scene of many records

`retrieve_scene`, `SceneRetrieval`, `SceneStep`, `MarkovField`, `clumped_leaves`, `geolocate`, `Geolocation`.

## Receivers and digitisers

`Recorder`, `receiver_impulse`, `shot_response`, `ShotResponse`, `recorded_pulse`, `amplitudes`, `Amplitudes`,
`corrected_table`.

## Leaf traits from leaf spectra

`invert_leaves`, `LeafFit`, `GapLightWarning`.

## Files

`files`.
"""

from inversion import files
from inversion.fit.design import Design, design
from inversion.fit.fit_summary import Step
from inversion.fit.identifiability import CramerRao, Profile, cramer_rao, profile_likelihood
from inversion.fit.log_density import LogDensity, log_density
from inversion.fit.priors import LogNormal, MarkovField, Smooth
from inversion.fit.problem import Problem
from inversion.fit.profiles import AveragingKernel, put_profile
from inversion.fit.quality import Verdict, judge_fit, judge_fits, judge_record
from inversion.fit.result import Retrieval
from inversion.fit.retrieval import retrieve
from inversion.fit.retrieval_many import retrieve_many
from inversion.fit.unknowns import Unknown
from inversion.leaf.leaves import GapLightWarning, LeafFit, invert_leaves
from inversion.metrics.comparison import ComparedColumn, Comparison, ComparisonStatistics, compare
from inversion.metrics.cover import (
    GroundAndCanopy,
    gap_probability,
    ground_and_canopy,
    plant_area_index,
    plant_area_profile,
)
from inversion.metrics.decomposition import Echoes, gaussian_decomposition
from inversion.metrics.deconvolution import richardson_lucy, wiener
from inversion.metrics.gedi import GediMetrics, GediSettings, gedi_metrics, gedi_settings
from inversion.metrics.gedi_table import gedi_table
from inversion.metrics.heights import SignalEnds, find_ground, relative_heights, signal_ends
from inversion.metrics.photons import PhotonHeights, photon_ground_and_canopy
from inversion.metrics.points import EchoPoints, echo_points
from inversion.receiver.digitiser import Amplitudes, amplitudes, corrected_table
from inversion.receiver.impulse import receiver_impulse, recorded_pulse
from inversion.receiver.recorder import Recorder
from inversion.receiver.shot_response import ShotResponse, shot_response
from inversion.scene.clumps import clumped_leaves
from inversion.scene.geolocation import Geolocation, geolocate
from inversion.scene.retrieval import SceneStep, retrieve_scene
from inversion.scene.scene_retrieval import SceneRetrieval

__all__ = [
    # Fits with a model.
    "Problem",
    "retrieve",
    "retrieve_many",
    "Unknown",
    "LogNormal",
    "Smooth",
    "put_profile",
    "Retrieval",
    "Step",
    "AveragingKernel",
    # Identifiability and verdicts.
    "cramer_rao",
    "CramerRao",
    "profile_likelihood",
    "Profile",
    "judge_fit",
    "judge_fits",
    "judge_record",
    "Verdict",
    # Design of instruments.
    "design",
    "Design",
    # Posteriors.
    "log_density",
    "LogDensity",
    # Echoes and deconvolution.
    "gaussian_decomposition",
    "Echoes",
    "echo_points",
    "EchoPoints",
    "richardson_lucy",
    "wiener",
    # Heights, cover and plant area.
    "find_ground",
    "signal_ends",
    "SignalEnds",
    "relative_heights",
    "ground_and_canopy",
    "GroundAndCanopy",
    "gap_probability",
    "plant_area_index",
    "plant_area_profile",
    # GEDI and photon counters.
    "gedi_metrics",
    "GediMetrics",
    "gedi_settings",
    "GediSettings",
    "gedi_table",
    "photon_ground_and_canopy",
    "PhotonHeights",
    # Comparison with references.
    "compare",
    "Comparison",
    "ComparisonStatistics",
    "ComparedColumn",
    # The scene of many records.
    "retrieve_scene",
    "SceneRetrieval",
    "SceneStep",
    "MarkovField",
    "clumped_leaves",
    "geolocate",
    "Geolocation",
    # Receivers and digitisers.
    "Recorder",
    "receiver_impulse",
    "shot_response",
    "ShotResponse",
    "recorded_pulse",
    "amplitudes",
    "Amplitudes",
    "corrected_table",
    # Leaf traits from leaf spectra.
    "invert_leaves",
    "LeafFit",
    "GapLightWarning",
    # Files.
    "files",
]


def __dir__() -> list[str]:
    # Public names alone, without the modules and helpers that the imports leave here.
    return sorted(__all__)
