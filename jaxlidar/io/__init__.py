"""Readers of recorded waveforms, voxel maps, point clouds and tree models."""

from .gedi import GediShot as GediShot
from .gedi import read_gedi_l1b as read_gedi_l1b
from .las import PointCloud as PointCloud
from .las import read_las as read_las
from .neon import NeonImpulse as NeonImpulse
from .neon import NeonRead as NeonRead
from .neon import NeonShot as NeonShot
from .neon import read_neon as read_neon
from .qsm import read_qsm as read_qsm
from .vox import read_vox as read_vox
from .whole import whole_file as whole_file
