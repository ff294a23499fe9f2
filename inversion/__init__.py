"""Retrievals: what a scene must be like for a lidar to have recorded a waveform."""

from .result import Retrieval as Retrieval
from .result import Step as Step
from .retrieval import retrieve as retrieve
from .unknowns import Unknown as Unknown
