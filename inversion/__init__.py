"""Retrieval of scene properties from waveforms: fits with standard errors, and tools that need no model."""

from . import files
from .batch import Progress, Retrievals, retrieve_many
from .counts import Amplitudes, amplitudes
from .cover import GroundAndCanopy, gap_probability, ground_and_canopy, plant_area_index, plant_area_profile
from .decomposition import Echoes, gaussian_decomposition
from .deconvolution import richardson_lucy, wiener
from .gedi import GediMetrics, GediSettings, gedi_metrics, gedi_settings
from .heights import SignalEnds, find_ground, relative_heights, signal_ends
from .identifiability import CramerRao, Profile, cramer_rao, profile_likelihood
from .impulse import receiver_impulse, recorded_pulse
from .leaves import LeafFit, invert_leaves
from .photons import PhotonHeights, photon_ground_and_canopy
from .points import EchoPoints, echo_points
from .priors import LogNormal, Smooth
from .profiles import AveragingKernel, put_profile
from .quality import Verdict, judge_fit, judge_fits, judge_record
from .recorder import Recorder
from .result import Retrieval, Step
from .retrieval import retrieve
from .tables import corrected_table
from .unknowns import Unknown

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
