"""The scene that `jaxlidar demo` shows: a tree 15 m tall on bare soil, under one large footprint.

The crown is an ellipsoid of leaves in clumps round a trunk that tapers upward; it is built without a
growth model, so its branches are not resolved.
"""

import numpy as np
from jaxtyping import Float

from .lidar import Lidar
from .prospect import Prospect
from .pulse import GaussianPulse
from .scene import Canopy, Ground, Scene
from .spectra import spectrum
from .voxels import VoxelMap

HEIGHT = 15.0
TRUNK_DIAMETER = 0.89
CROWN_BASE = 4.0
CROWN_RADIUS = 3.5
LEAF_AREA_INDEX = 3.5
WAVELENGTHS = (532.0, 1064.0, 1550.0)


def demo_lidar(wavelength: float | tuple[float, ...] = 1064.0) -> Lidar:
    """A lidar 1000 m above the ground whose footprint, 6 m across, covers much of the crown.

    Pulse 6 ns, sampling interval 1 ns, aperture 0.2 m, field of view 8 m across. `wavelength` is in nm.
    Default 1064.
    """
    return Lidar(
        wavelength=wavelength,
        altitude=1000.0,
        divergence=6.0,
        pulse=GaussianPulse(fwhm=6.0),
        aperture=0.2,
        field_of_view=8.0,
    )


def demo_scene(voxel_size: float = 0.25, *, seed: int = 3) -> Scene:
    """The tree on soil of medium brightness, at z = 0. The leaf is PROSPECT-D's; the bark is measured.

    **Arguments:**

    - `voxel_size`: edge in m, above 0 and at most 1. Default 0.25.
    - `seed`: of the clumps. Default 3.

    **Raises:** ValueError for a size outside (0, 1].
    """
    if not 0 < voxel_size <= 1:
        raise ValueError(f"voxel_size = {voxel_size:g} is outside the admissible range (0, 1]")
    return Scene(
        canopy=Canopy(
            tree(voxel_size, seed=seed),
            leaf=Prospect(N=1.6, Cab=45.0, Car=10.0, Cw=0.012, Cm=0.008),
            bark=spectrum("bark-oak"),
        ),
        ground=Ground(height=0.0, reflectance=spectrum("soil-medium")),
    )


def tree(voxel_size: float, *, seed: int) -> VoxelMap:
    """Crown and trunk as extinction, in voxels of the edge `voxel_size` (m) round x = y = 0.

    The leaf area index below the crown's outline is 3.5, the trunk 0.89 m thick at the base and a tenth of
    that at its top, 2 m below the tree's. Bark is spread over the voxels that it shares.
    """
    half = round(np.ceil((CROWN_RADIUS + 0.25) / voxel_size))
    levels = round(np.ceil(HEIGHT / voxel_size))
    x = (np.arange(2 * half) + 0.5 - half) * voxel_size
    z = (np.arange(levels) + 0.5) * voxel_size
    lad = _crown(x, z, seed)
    return VoxelMap.from_extinction(
        leaf=0.5 * lad,
        bark=_trunk(x, z, voxel_size),
        voxel_size=voxel_size,
        origin=(-half * voxel_size, -half * voxel_size, 0.0),
    )


def _crown(x: Float[np.ndarray, " n"], z: Float[np.ndarray, " m"], seed: int) -> Float[np.ndarray, "n n m"]:
    """Leaf area density, m2/m3: clumps about 1 m wide, with gaps, denser towards the outside."""
    half_height = 0.5 * (HEIGHT - CROWN_BASE)
    px, py, pz = np.meshgrid(x, x, z, indexing="ij")
    level = (pz - CROWN_BASE - half_height) / half_height
    radius = np.sqrt((px**2 + py**2) / CROWN_RADIUS**2 + level**2)
    rng = np.random.default_rng(seed)
    clumps = np.zeros_like(radius)
    # Points evenly within the ellipsoid, of which each is a clump: the field does not depend on the voxels.
    direction = rng.normal(size=(220, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centres = direction * rng.uniform(size=(220, 1)) ** 0.3
    for cx, cy, cz in centres * [CROWN_RADIUS, CROWN_RADIUS, half_height]:
        away = (px - cx) ** 2 + (py - cy) ** 2 + (pz - cz - CROWN_BASE - half_height) ** 2
        clumps += np.exp(-0.5 * away / 0.45**2)
    density = np.where(radius < 1, (0.05 + clumps) * (0.3 + 0.7 * np.minimum(radius, 1)), 0.0)
    leaf_area = LEAF_AREA_INDEX * np.pi * CROWN_RADIUS**2
    volume = (x[1] - x[0]) ** 2 * (z[1] - z[0])
    return density * leaf_area / (density.sum() * volume)


def _trunk(
    x: Float[np.ndarray, " n"], z: Float[np.ndarray, " m"], voxel_size: float
) -> Float[np.ndarray, "n n m"]:
    """Extinction of bark, 1/m. A cylinder's outline, averaged over directions, is a quarter of its surface,
    so that 1/(2 r) is its extinction per volume.
    """
    share = np.clip(z / (HEIGHT - 2.0), 0, None)
    r = np.where(share < 1, 0.5 * TRUNK_DIAMETER * (1 - 0.9 * share), 0.0)
    parts = 8
    fine = (x[:, None] + voxel_size * ((np.arange(parts) + 0.5) / parts - 0.5)).ravel()
    away = np.hypot(fine[:, None], fine)
    inside = away[..., None] < r
    n, m = x.size, z.size
    within = inside.reshape(n, parts, n, parts, m).mean(axis=(1, 3))
    volume = within.sum(axis=(0, 1)) * voxel_size**2
    surface = 2 * np.pi * r
    return within * np.where(volume > 0, surface / (4 * np.maximum(volume, 1e-9)), 0.0)
