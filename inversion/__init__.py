"""Retrieval of scene properties from waveforms: fits with standard errors, and tools that need no model."""

from . import files
from .batch import Progress, Retrievals, retrieve_many
from .decomposition import (
    Echoes,
    find_ground,
    gap_probability,
    gaussian_decomposition,
    plant_area_index,
    relative_heights,
)
from .deconvolution import richardson_lucy, wiener
from .identifiability import CramerRao, Profile, cramer_rao, profile_likelihood
from .leaves import LeafFit, invert_leaves
from .result import Retrieval, Step
from .retrieval import retrieve
from .unknowns import LogNormal, Unknown

__all__ = [
    "CramerRao",
    "Echoes",
    "LeafFit",
    "LogNormal",
    "Profile",
    "Progress",
    "Retrieval",
    "Retrievals",
    "Step",
    "Unknown",
    "cramer_rao",
    "files",
    "find_ground",
    "gap_probability",
    "gaussian_decomposition",
    "invert_leaves",
    "plant_area_index",
    "profile_likelihood",
    "relative_heights",
    "retrieve",
    "retrieve_many",
    "richardson_lucy",
    "wiener",
]
