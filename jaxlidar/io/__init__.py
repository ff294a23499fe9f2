"""Readers of recorded waveforms, voxel maps, point clouds and tree models, and atomic file writes."""

from jaxlidar._files import atomic_write
from jaxlidar.io.case import Case, write_case
from jaxlidar.io.gedi import GediShot, read_gedi_l1b
from jaxlidar.io.las import PointCloud, read_las
from jaxlidar.io.neon import NeonImpulse, NeonRead, NeonShot, read_neon
from jaxlidar.io.netcdf import keep_as_netcdf, read_case, save
from jaxlidar.io.qsm import TreeRead, read_qsm
from jaxlidar.io.vox import VoxelsRead, read_vox

__all__ = [
    "Case",
    "GediShot",
    "NeonImpulse",
    "NeonRead",
    "NeonShot",
    "PointCloud",
    "TreeRead",
    "VoxelsRead",
    "atomic_write",
    "keep_as_netcdf",
    "read_case",
    "read_gedi_l1b",
    "read_las",
    "read_neon",
    "read_qsm",
    "read_vox",
    "save",
    "write_case",
]
