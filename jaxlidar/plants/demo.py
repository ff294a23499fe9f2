"""Scene and lidar of `jaxlidar demo`: a tree 15 m tall on bare soil, under one large footprint."""

from jaxlidar._fields.checks import check_number
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import spectrum
from jaxlidar.plants.habits import grow
from jaxlidar.plants.voxelise import voxelise
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import Ground
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.pulse import GaussianPulse

# Height of the tree, m; one-sided area of all its leaves, m2; wavelengths of its lidar, nm.
HEIGHT = 15.0
LEAF_AREA = 250.0
WAVELENGTHS = (532.0, 1064.0, 1550.0)


def demo_lidar(wavelength: float | tuple[float, ...] = 1064.0) -> Lidar:
    """Return the lidar of the demonstration: 1000 m above the ground, with a footprint 6 m across.

    The footprint covers much of the crown. The pulse is 6 ns long, the sampling interval 1 ns, the aperture
    0.2 m, and the field of view 8 m across.

    **Arguments:**

    - `wavelength`: nm, one number or several. Default 1064.

    **Returns:** a `Lidar`.

    **Raises:** ValueError for an inadmissible wavelength.

    **Example:**

    >>> from jaxlidar.plants.demo import demo_lidar
    >>> float(demo_lidar().altitude)
    1000.0
    """
    return Lidar(
        wavelength=wavelength,
        altitude=1000.0,
        divergence=6.0,
        pulse=GaussianPulse(fwhm=6.0),
        aperture=0.2,
        field_of_view=8.0,
    )


def demo_scene(voxel_size: float = 0.25, *, seed: int = 0) -> Scene:
    """Return the scene of the demonstration: one tree on soil of medium brightness, at z = 0.

    Leaf reflectance and transmittance are those of PROSPECT-D. The reflectance of the bark is measured.

    **Arguments:**

    - `voxel_size`: voxel edge in m, above 0 and at most 1. Default 0.25.
    - `seed`: random seed of the tree's growth. Default 0.

    **Returns:** a `Scene`.

    **Raises:** ValueError for a voxel size outside (0, 1].
    """
    check_number("voxel_size", voxel_size, 0.0, 1.0, low_open=True)
    tree = grow(seed=seed)
    return Scene(
        canopy=Canopy(
            voxelise(tree, voxel_size, leaf_area=LEAF_AREA / len(tree.bud_position), wood="surface"),
            leaf=Prospect(N=1.6, Cab=45.0, Car=10.0, Cw=0.012, Cm=0.008),
            bark=spectrum("bark-oak"),
        ),
        ground=Ground(height=0.0, reflectance=spectrum("soil-medium")),
    )
