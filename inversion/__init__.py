"""Retrievals: what a scene must be like for a lidar to have recorded a waveform."""

from .batch import Progress as Progress
from .batch import Retrievals as Retrievals
from .batch import retrieve_many as retrieve_many
from .decomposition import Echoes as Echoes
from .decomposition import find_ground as find_ground
from .decomposition import gap_probability as gap_probability
from .decomposition import gaussian_decomposition as gaussian_decomposition
from .decomposition import plant_area_index as plant_area_index
from .decomposition import relative_heights as relative_heights
from .decomposition import richardson_lucy as richardson_lucy
from .decomposition import wiener as wiener
from .identifiability import CramerRao as CramerRao
from .identifiability import Profile as Profile
from .identifiability import cramer_rao as cramer_rao
from .identifiability import profile_likelihood as profile_likelihood
from .leaves import LeafFit as LeafFit
from .leaves import invert_leaves as invert_leaves
from .result import Retrieval as Retrieval
from .result import Step as Step
from .retrieval import retrieve as retrieve
from .unknowns import LogNormal as LogNormal
from .unknowns import Unknown as Unknown
