"""Retrieval of scene properties from waveforms: fits with standard errors, and tools that need no model.

## Fits with a model

`Problem`, `retrieve`, `retrieve_many`, `Unknown`, `LogNormal`, `Smooth`, `put_profile`, `Retrieval`.

## Identifiability and verdicts

`cramer_rao`, `profile_likelihood`, `judge_fit`, `judge_record`, `Verdict`.

## Design of instruments

`design`.

## Posteriors

`log_density`, `LogDensity`.

## Echoes and deconvolution

`gaussian_decomposition`, `echo_points`, `richardson_lucy`, `wiener`.

## Heights, cover and plant area

`find_ground`, `signal_ends`, `relative_heights`, `ground_and_canopy`, `gap_probability`, `plant_area_index`,
`plant_area_profile`.

## GEDI and photon counters

`gedi_metrics`, `gedi_settings`, `gedi_table`, `photon_ground_and_canopy`.

## Comparison with references

`compare`.

## The scene of many records

`retrieve_scene`, `MarkovField`, `clumped_leaves`, `geolocate`.

## Receivers and digitisers

`Recorder`, `receiver_impulse`, `shot_response`, `recorded_pulse`, `amplitudes`, `corrected_table`.

## Leaf traits from leaf spectra

`invert_leaves`, `GapLightWarning`.

## Files

`files`.
"""

from inversion import files
from inversion.fit.design import design
from inversion.fit.identifiability import cramer_rao, profile_likelihood
from inversion.fit.log_density import LogDensity, log_density
from inversion.fit.priors import LogNormal, MarkovField, Smooth
from inversion.fit.problem import Problem
from inversion.fit.profiles import put_profile
from inversion.fit.quality import Verdict, judge_fit, judge_record
from inversion.fit.result import Retrieval
from inversion.fit.retrieval import retrieve
from inversion.fit.retrieval_many import retrieve_many
from inversion.fit.unknowns import Unknown
from inversion.leaf.leaves import GapLightWarning, invert_leaves
from inversion.metrics.comparison import compare
from inversion.metrics.cover import (
    gap_probability,
    ground_and_canopy,
    plant_area_index,
    plant_area_profile,
)
from inversion.metrics.deconvolution import richardson_lucy, wiener
from inversion.metrics.gedi import gedi_metrics, gedi_settings
from inversion.metrics.gedi_table import gedi_table
from inversion.metrics.heights import find_ground, relative_heights, signal_ends
from inversion.metrics.photons import photon_ground_and_canopy
from inversion.metrics.points import echo_points
from inversion.receiver.digitiser import amplitudes, corrected_table
from inversion.receiver.impulse import receiver_impulse, recorded_pulse
from inversion.receiver.recorder import Recorder
from inversion.receiver.shot_response import shot_response
from inversion.scene.clumps import clumped_leaves
from inversion.scene.geolocation import geolocate
from inversion.scene.retrieval import retrieve_scene
from jaxlidar.survey.decomposition import gaussian_decomposition

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
    # Identifiability and verdicts.
    "cramer_rao",
    "profile_likelihood",
    "judge_fit",
    "judge_record",
    "Verdict",
    # Design of instruments.
    "design",
    # Posteriors.
    "log_density",
    "LogDensity",
    # Echoes and deconvolution.
    "gaussian_decomposition",
    "echo_points",
    "richardson_lucy",
    "wiener",
    # Heights, cover and plant area.
    "find_ground",
    "signal_ends",
    "relative_heights",
    "ground_and_canopy",
    "gap_probability",
    "plant_area_index",
    "plant_area_profile",
    # GEDI and photon counters.
    "gedi_metrics",
    "gedi_settings",
    "gedi_table",
    "photon_ground_and_canopy",
    # Comparison with references.
    "compare",
    # The scene of many records.
    "retrieve_scene",
    "MarkovField",
    "clumped_leaves",
    "geolocate",
    # Receivers and digitisers.
    "Recorder",
    "receiver_impulse",
    "shot_response",
    "recorded_pulse",
    "amplitudes",
    "corrected_table",
    # Leaf traits from leaf spectra.
    "invert_leaves",
    "GapLightWarning",
    # Files.
    "files",
]


def __dir__() -> list[str]:
    # Public names alone, without the modules and helpers that the imports leave here.
    return sorted(__all__)
