"""Voxel maps: where leaf and bark are, as extinction coefficients on a regular grid."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._checks import as_array, check_range
from jaxlidar.optics.leaf_angles import LeafAngles

# Optical depth of one edge of a voxel in which a ray surely meets material (p = 1): exp(-40) = 4e-18.
SOLID_OPTICAL_DEPTH = 40.0


# Numbers, arrays or nested sequences of numbers.
Numbers = ArrayLike | Sequence


def _as_triple(x: Numbers) -> Float[Array, "3"]:
    a = as_array(x)
    return jnp.broadcast_to(a, (3,)) if a.ndim == 0 else a


class VoxelMap(eqx.Module):
    """Leaf and bark in a box of equal voxels, x east, y north, z up.

    Made by `VoxelMap.from_probability`, `VoxelMap.from_extinction` or `VoxelMap.from_lad`. Within a
    voxel the material is spread evenly: what a ray meets depends on the length of its chord, not on how
    the chord is divided.

    **Arguments:**

    - `leaf`: (nx, ny, nz) extinction coefficient of leaf in 1/m for the projection function G = 1/2, that
      is half the leaf area density; or None where there is no leaf.
    - `bark`: the same for bark, whose facets are taken as spherically oriented; or None.
    - `voxel_size`: (3,) edges in m.
    - `origin`: (3,) lower south-west corner in m.
    - `leaf_angles`: distribution of leaf inclination; None is spherical.

    **Raises:** ValueError for negative, infinite or NaN extinction, sizes that are not positive, shapes
    that differ, or a map with neither leaf nor bark.
    """

    # Their shapes are compared below, so that the error can name both.
    leaf: Float[Array, "..."] | None
    bark: Float[Array, "..."] | None
    voxel_size: Float[Array, "3"] = eqx.field(converter=_as_triple)
    origin: Float[Array, "3"] = eqx.field(converter=_as_triple)
    leaf_angles: LeafAngles | None = None

    def __check_init__(self):
        if self.leaf is None and self.bark is None:
            raise ValueError("leaf and bark are both None; a voxel map holds at least one of them")
        shapes = {a.shape for a in (self.leaf, self.bark) if a is not None}
        if len(shapes) > 1:
            raise ValueError(f"leaf and bark have the shapes {sorted(shapes)}; they must agree")
        (shape,) = shapes
        if len(shape) != 3 or 0 in shape:
            raise ValueError(
                f"leaf or bark has the shape {shape}; admissible is (nx, ny, nz), each at least 1"
            )
        for name, value in (("leaf", self.leaf), ("bark", self.bark)):
            if value is not None:
                check_range(f"{name} extinction", value, 0.0)
        check_range("voxel_size", self.voxel_size, 0.0, low_open=True)
        check_range("origin", self.origin)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        some = self.leaf if self.leaf is not None else self.bark
        assert some is not None
        nx, ny, nz = some.shape
        return nx, ny, nz

    @property
    def top(self) -> Float[Array, "3"]:
        """Upper north-east corner in m."""
        return self.origin + self.voxel_size * jnp.asarray(self.shape, self.origin.dtype)

    @staticmethod
    def from_extinction(
        leaf: Numbers | None = None,
        bark: Numbers | None = None,
        *,
        voxel_size: Numbers,
        origin: Numbers = (0.0, 0.0, 0.0),
    ) -> "VoxelMap":
        """From extinction coefficients in 1/m, the same for every direction. Arrays are (nx, ny, nz)."""
        return VoxelMap(_volume(leaf), _volume(bark), voxel_size, origin)

    @staticmethod
    def from_probability(
        leaf: Numbers | None = None,
        bark: Numbers | None = None,
        *,
        voxel_size: Numbers,
        origin: Numbers = (0.0, 0.0, 0.0),
    ) -> "VoxelMap":
        """From the probability that a ray crossing one edge length of a voxel meets leaf, or bark.

        The extinction coefficient is -log1p(-p)/edge, the edge being the vertical one where voxels are
        not cubes. p = 1, a solid trunk, is legal and taken as an optical depth of 40 per edge, with no
        derivative with respect to p there.

        **Raises:** ValueError where a probability lies outside [0, 1].
        """
        size = _as_triple(voxel_size)

        def extinction(name: str, p: Numbers | None) -> Array | None:
            if p is None:
                return None
            check_range(name, p, 0.0, 1.0)
            p = as_array(p)
            open_ = p < 1.0
            depth = jnp.where(open_, -jnp.log1p(-jnp.where(open_, p, 0.0)), SOLID_OPTICAL_DEPTH)
            return depth / size[2]

        return VoxelMap(extinction("leaf", leaf), extinction("bark", bark), size, origin)

    @staticmethod
    def from_lad(
        lad: Numbers,
        *,
        voxel_size: Numbers,
        origin: Numbers = (0.0, 0.0, 0.0),
        leaf_angles: str | LeafAngles = "spherical",
        bark: Numbers | None = None,
    ) -> "VoxelMap":
        """From leaf area density in m2/m3, (nx, ny, nz); the extinction coefficient is G(direction) * LAD.

        `leaf_angles` is "spherical", "planophile", "erectophile", "plagiophile", "extremophile", "uniform"
        or a `LeafAngles`; `bark` is an extinction coefficient in 1/m.
        """
        check_range("lad", lad, 0.0)
        angles = LeafAngles.named(leaf_angles) if isinstance(leaf_angles, str) else leaf_angles
        spherical = isinstance(leaf_angles, str) and leaf_angles == "spherical"
        return VoxelMap(0.5 * as_array(lad), _volume(bark), voxel_size, origin, None if spherical else angles)

    def mean_extinction(self) -> Float[np.ndarray, "nx ny nz"]:
        """Extinction coefficient of leaf (at G = 1/2) and bark together, 1/m, as a NumPy array."""
        return np.sum([np.asarray(a) for a in (self.leaf, self.bark) if a is not None], axis=0)


def _volume(x: Numbers | None) -> Float[Array, "..."] | None:
    return None if x is None else as_array(x)
