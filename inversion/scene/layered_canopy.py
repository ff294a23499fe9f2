"""A canopy of layers over ground, as the scene of fits to single waveforms.

The canopy is horizontally uniform: `LAYERS` layers of equal thickness from a clearance above the ground to
the top. One waveform tells no more of a scene than heights and a profile.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxlidar as jl

LAYERS = 10
# Reflectance and transmittance of leaves, and reflectance of the ground.
_LEAF, GROUND = (0.45, 0.40), 0.20
# Spherically oriented leaves return two thirds of their reflectance: rho_v = 0.30. Over that of the ground
# this is the ratio of GEDI's level 2B algorithm, 0.6 / 0.4.
REFLECTANCE_RATIO = 2.0 / 3.0 * _LEAF[0] / GROUND
# G of spherically oriented leaves, by which extinction follows from plant area density.
_PROJECTION = 0.5
# Edge of the periodic scene in m: wider than a footprint.
_WIDTH = 50.0


class LayeredCanopy:
    """A horizontally uniform canopy: layers of equal thickness from `clearance` in m above the ground up.

    Its methods put unknowns into a scene, as `inversion.Unknown(apply=...)` needs them.
    """

    def __init__(self, clearance: float):
        self.clearance = clearance

    def put_ground(self, scene: Any, height: Float[Array, ""]) -> Any:
        """Move the ground to a height in m, and the canopy with it."""
        moved = jnp.asarray(scene.canopy.voxels.origin).at[2].set(height + self.clearance)
        return eqx.tree_at(lambda s: (s.ground.height, s.canopy.voxels.origin), scene, (height, moved))

    def put_height(self, scene: Any, height: Float[Array, ""]) -> Any:
        """Stretch the canopy to a top at `height` in m above the ground."""
        step = (height - self.clearance) / LAYERS
        size = jnp.asarray(scene.canopy.voxels.voxel_size).at[2].set(step)
        return eqx.tree_at(lambda s: s.canopy.voxels.voxel_size, scene, size)

    def put_density(self, scene: Any, log_density: Float[Array, " layers"]) -> Any:
        """Set the layers' plant area density, from below, by its logarithm in m2/m3."""
        extinction = _PROJECTION * jnp.exp(log_density).reshape(1, 1, LAYERS)
        return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, extinction)

    def scene(self, height: float, ground: float = 0.0, slope: float = 5.0) -> jl.Scene:
        """Return a scene to start a fit from: heights in m above the reference, slope in degrees."""
        voxels = jl.VoxelMap.from_lad(
            np.full((1, 1, LAYERS), 0.05),
            voxel_size=(_WIDTH, _WIDTH, (height - self.clearance) / LAYERS),
            origin=(-0.5 * _WIDTH, -0.5 * _WIDTH, ground + self.clearance),
        )
        return jl.Scene(
            canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(*_LEAF), sides="periodic", hotspot=True),
            ground=jl.Ground(height=ground, reflectance=GROUND, slope=slope),
        )
