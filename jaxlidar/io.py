"""Files: recorded waveforms, voxel maps, points, tree models, meshes and terrain; cases and results."""

from jaxlidar.formats.airborne import (
    AirborneShot,
    Segment,
    stack_shots,
)
from jaxlidar.formats.checks import FileWarning
from jaxlidar.formats.dem import read_dem
from jaxlidar.formats.files import atomic_write
from jaxlidar.formats.gedi import GediShot, read_gedi_l1b
from jaxlidar.formats.gedi_level2 import read_gedi_l2a, read_gedi_l2b
from jaxlidar.formats.icesat2 import read_atl03, read_atl08
from jaxlidar.formats.inventory import read_inventory
from jaxlidar.formats.las import LasWriter, read_las, write_las
from jaxlidar.formats.las_waveforms import read_las_waveforms, write_las_waveforms
from jaxlidar.formats.lvis import read_lvis_l1b, read_lvis_l2
from jaxlidar.formats.meshes import read_mesh
from jaxlidar.formats.neon import read_neon
from jaxlidar.formats.projection import to_crs
from jaxlidar.formats.pulsewaves import read_pulsewaves
from jaxlidar.formats.qsm import read_qsm
from jaxlidar.formats.rasters import write_raster
from jaxlidar.formats.tables import Column, ShotTable
from jaxlidar.formats.trajectory import read_trajectory
from jaxlidar.formats.vox import read_vox
from jaxlidar.plants.point_cloud import PointCloud
from jaxlidar.results.case import Case, write_case
from jaxlidar.results.datasets import keep_as_netcdf
from jaxlidar.results.gedi_writer import write_gedi_l1b
from jaxlidar.results.netcdf import read_case, save

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
    "read_mesh",
    "read_neon",
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
