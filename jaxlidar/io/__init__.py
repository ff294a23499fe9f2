"""Files: recorded waveforms, voxel maps, points, tree models, meshes and terrain; cases and results."""

from jaxlidar.io.airborne import (
    AirborneShot,
    Segment,
    stack_shots,
)
from jaxlidar.io.case import Case, write_case
from jaxlidar.io.checks import FileWarning
from jaxlidar.io.datasets import keep_as_netcdf
from jaxlidar.io.dem import read_dem
from jaxlidar.io.files import atomic_write
from jaxlidar.io.gedi import GediShot, read_gedi_l1b
from jaxlidar.io.gedi_level2 import read_gedi_l2a, read_gedi_l2b
from jaxlidar.io.gedi_writer import write_gedi_l1b
from jaxlidar.io.icesat2 import read_atl03, read_atl08
from jaxlidar.io.inventory import read_inventory
from jaxlidar.io.las import LasWriter, read_las, write_las
from jaxlidar.io.las_waveforms import read_las_waveforms, write_las_waveforms
from jaxlidar.io.lvis import read_lvis_l1b, read_lvis_l2
from jaxlidar.io.meshes import read_mesh
from jaxlidar.io.neon import read_neon
from jaxlidar.io.netcdf import read_case, save
from jaxlidar.io.projection import to_crs
from jaxlidar.io.pulsewaves import read_pulsewaves
from jaxlidar.io.qsm import read_qsm
from jaxlidar.io.rasters import write_raster
from jaxlidar.io.tables import Column, ShotTable
from jaxlidar.io.trajectory import read_trajectory
from jaxlidar.io.vox import read_vox
from jaxlidar.plants.point_cloud import PointCloud

__all__ = [
    "AirborneShot",
    "Case",
    "Column",
    "FileWarning",
    "GediShot",
    "LasWriter",
    "PointCloud",
    "Segment",
    "ShotTable",
    "atomic_write",
    "keep_as_netcdf",
    "read_atl03",
    "read_atl08",
    "read_case",
    "read_dem",
    "read_gedi_l1b",
    "read_gedi_l2a",
    "read_gedi_l2b",
    "read_inventory",
    "read_las",
    "read_las_waveforms",
    "read_lvis_l1b",
    "read_lvis_l2",
    "read_neon",
    "read_mesh",
    "read_pulsewaves",
    "read_qsm",
    "read_trajectory",
    "read_vox",
    "save",
    "stack_shots",
    "to_crs",
    "write_case",
    "write_gedi_l1b",
    "write_las",
    "write_las_waveforms",
    "write_raster",
]
