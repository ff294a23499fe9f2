"""A differentiable simulator of full-waveform lidar.

optics and geometry -> scene -> plan -> trace -> response -> waveform; fits are in the package `inversion`.
"""

from ._coefficients import load_coefficients as load_coefficients
from .atmosphere import Atmosphere as Atmosphere
from .leaf import LeafOptics as LeafOptics
from .lidar import Lidar as Lidar
from .materials import EqualAngle as EqualAngle
from .materials import Isotropic as Isotropic
from .materials import Lambertian as Lambertian
from .materials import LeafAngles as LeafAngles
from .materials import Specular as Specular
from .plan import Effect as Effect
from .plan import Plan as Plan
from .plan import plan as plan
from .plates import plate_model as plate_model
from .prospect import Prospect as Prospect
from .prospect import prospect_jacobian as prospect_jacobian
from .prospect import prospect_spectra as prospect_spectra
from .pulse import AbstractPulse as AbstractPulse
from .pulse import ExponentiallyModifiedGaussianPulse as ExponentiallyModifiedGaussianPulse
from .pulse import GaussianPulse as GaussianPulse
from .pulse import RectangularPulse as RectangularPulse
from .pulse import SampledPulse as SampledPulse
from .receiver import Receiver as Receiver
from .receiver import first_return_window as first_return_window
from .receiver import record as record
from .scene import Canopy as Canopy
from .scene import Ground as Ground
from .scene import Plate as Plate
from .scene import Scene as Scene
from .simulate import Progress as Progress
from .simulate import simulate as simulate
from .spectra import Spectrum as Spectrum
from .spectra import read_spectrum_csv as read_spectrum_csv
from .spectra import spectra as spectra
from .spectra import spectrum as spectrum
from .trace import Response as Response
from .trace import trace as trace
from .voxels import VoxelMap as VoxelMap
from .waveform import Waveform as Waveform
from .waveform import waveform as waveform
