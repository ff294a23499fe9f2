"""Retrieval of scene properties from waveforms: fits with standard errors, and tools that need no model."""

from inversion import files
from inversion.fit.fit_record import Step
from inversion.fit.identifiability import CramerRao, Profile, cramer_rao, profile_likelihood
from inversion.fit.priors import LogNormal, Smooth
from inversion.fit.profiles import AveragingKernel, put_profile
from inversion.fit.quality import Verdict, judge_fit, judge_fits, judge_record
from inversion.fit.result import Retrieval, Retrievals
from inversion.fit.retrieval import retrieve
from inversion.fit.retrieval_many import Progress, retrieve_many
from inversion.fit.unknowns import Unknown
from inversion.leaf.leaves import LeafFit, invert_leaves
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
from inversion.metrics.heights import SignalEnds, find_ground, relative_heights, signal_ends
from inversion.metrics.photons import PhotonHeights, photon_ground_and_canopy
from inversion.metrics.points import EchoPoints, echo_points
from inversion.receiver.digitiser import Amplitudes, amplitudes, corrected_table
from inversion.receiver.impulse import receiver_impulse, recorded_pulse
from inversion.receiver.recorder import Recorder
from jaxlidar.extend import shorten_signatures

__all__ = [
    "Amplitudes",
    "AveragingKernel",
    "CramerRao",
    "EchoPoints",
    "Echoes",
    "GediMetrics",
    "GediSettings",
    "GroundAndCanopy",
    "LeafFit",
    "LogNormal",
    "PhotonHeights",
    "Profile",
    "Progress",
    "Recorder",
    "Retrieval",
    "Retrievals",
    "SignalEnds",
    "Smooth",
    "Step",
    "Unknown",
    "Verdict",
    "amplitudes",
    "corrected_table",
    "cramer_rao",
    "echo_points",
    "files",
    "find_ground",
    "gap_probability",
    "gaussian_decomposition",
    "gedi_metrics",
    "gedi_settings",
    "ground_and_canopy",
    "invert_leaves",
    "judge_fit",
    "judge_fits",
    "judge_record",
    "photon_ground_and_canopy",
    "plant_area_index",
    "plant_area_profile",
    "profile_likelihood",
    "put_profile",
    "receiver_impulse",
    "recorded_pulse",
    "relative_heights",
    "retrieve",
    "retrieve_many",
    "richardson_lucy",
    "signal_ends",
    "wiener",
]

shorten_signatures(globals())


def __dir__() -> list[str]:
    # Public names alone, without the modules and helpers that the imports leave here.
    return sorted(__all__)
