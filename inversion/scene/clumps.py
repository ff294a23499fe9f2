r"""Clumped leaves: a two-phase random field as prior of leaf area density in voxels.

Wide footprints see light through the gaps between crowns. They determine the mean of exp(-optical depth)
over a footprint, and that is the same for few leaves spread evenly and for more leaves in clumps. A prior
has to say which: the density inside clumps, and their size. With independent standard normal numbers w in
all voxels, which are the unknown,

    u = A w + 2 A_z l - 1,      leaf area density = density / (1 + exp(-u / 0.1)).

A smooths along each axis by a Gaussian kernel and keeps the variance of one; l is the sum of w over a layer,
over the square root of the number of its voxels, and smoothed along z. It leaves the vertical profile free.
The density is high where the field u is above zero and low elsewhere, with a soft edge (a truncated Gaussian
field; Matheron et al. 1987). Clumps of a field of the correlation exp(-d^2 / (2 s^2)) have the mean chord
2 pi s Phi(-1) exp(1/2) = 1.6 s at the level of -1, and ellipsoids 2/3 of their diameter: s = 0.4 diameters.

**The fit** starts from one draw w_0 of the prior, and w_0 is also the mean of its prior: the objective is
half of chi-squared plus |w - w_0|^2 / 2 (randomised maximum likelihood; Oliver, He and Reynolds 1996, without
their noise on the records). It changes what the records determine, and leaves the rest at the draw, so that
detail that no footprint resolves stays as clumped as the prior says. The most probable w would be zero there,
which is leaves spread evenly. Fits from several draws show how much the records leave open.

**Source:** Matheron, Beucher, de Fouquet, Galli, Guerillot and Ravenne (1987), SPE 16753; Oliver, He and
Reynolds (1996), 5th European Conference on the Mathematics of Oil Recovery; clumping of leaves: Nilson
(1971), Agric. Meteorol. 8, 25.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from inversion.fit.unknowns import Unknown
from jaxlidar import Scene
from jaxlidar.extend import as_numpy, check_key, check_kind, check_number, check_range, tensordot

# Standard deviation of the field along an axis, over the diameter of clumps.
_WIDTH = 0.4
# Field: mean, amplitude of the variation between layers, and the width of the edge of a clump.
_LEVEL, _LAYERS, _EDGE = -1.0, 2.0, 0.1
# Standard normal numbers of all voxels of a map lie within.
_BOUND = 8.0


def clumped_leaves(
    scene: Scene, *, density: ArrayLike, size: ArrayLike | Sequence, key: PRNGKeyArray, name: str = "clumps"
) -> Unknown:
    """Return the leaves of a voxel map as an unknown, with the prior that they are in clumps, such as crowns.

    For `retrieve_scene`, where footprints are wider than crowns. A `MarkovField` spreads leaves evenly within
    a footprint, and the retrieved leaf area is then too small. How much more there is in clumps follows from
    what is stated here, not from the records: a `density` or a height that is too low gives too little leaf
    area. Take them from the crowns of a stand, such as by an airborne cloud. The result has half or more of
    the leaf area that a `MarkovField` misses, and not all of it: lower leaves are hidden, and crowns are no
    Gaussian field.

    The unknown is a standard normal number for each voxel; the retrieved extinction is that of the scene,
    `fit.scene.canopy.voxels.leaf`. The draw of the prior takes the place of early stopping: fit all shots
    (`held_out=0.0`), with some 100 steps. The result is one draw out of many that fit the records as well:
    retrieve with several keys here, and compare. Standard errors are those of the normal numbers.

    **Arguments:**

    - `scene`: with a canopy whose voxel map has leaf; its values do not matter.
    - `density`: leaf area density within clumps, m2/m3, positive.
    - `size`: (2,) diameter and height of clumps, m, positive.
    - `key`: a JAX random key, of the draw of the prior from which the fit starts.
    - `name`: of the unknown. Default "clumps".

    **Returns:** an `Unknown`.

    **Raises:** ValueError for a scene without leaf and for numbers out of range; TypeError for arguments of
    another kind.

    **Source:** the module `inversion.scene.clumps`.

    **Example:** crowns of 3 m, of which the records say where they are, on the average over a footprint.

    >>> import jax, numpy as np, jaxlidar as jl, inversion
    >>> voxels = jl.VoxelMap.from_lad(np.zeros((20, 20, 8)), voxel_size=1.0)
    >>> scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4)), ground=jl.Ground())
    >>> crowns = inversion.clumped_leaves(scene, density=0.6, size=(3.0, 4.0), key=jax.random.key(0))
    >>> lad = 2.0 * crowns.apply(scene, crowns.start).canopy.voxels.leaf
    >>> print(f"mean {float(lad.mean()):.2f}, largest {float(lad.max()):.2f} m2/m3")
    mean 0.10, largest 0.60 m2/m3
    """
    check_kind("scene", scene, Scene, "a Scene")
    check_key(key)
    if scene.canopy is None or scene.canopy.voxels.leaf is None:
        raise ValueError("scene has no canopy with leaf; admissible is one whose voxel map has leaf")
    check_number("density", density, 0.0, low_open=True)
    extents = as_numpy(size, "size")
    if extents.shape != (2,):
        raise ValueError(f"size has the shape {extents.shape}; admissible is (2,), diameter and height")
    check_range("size", extents, 0.0, low_open=True)
    voxels = scene.canopy.voxels
    diameters = np.array([extents[0], extents[0], extents[1]])
    widths = tuple(float(w) for w in _WIDTH * diameters / np.asarray(voxels.voxel_size, float))
    draw = np.asarray(jax.random.normal(key, voxels.shape), float)
    # The profile starts level: drawn layers of no leaves would hide from the fit what lies in them.
    draw = np.clip(draw - draw.mean(axis=(0, 1)), -0.9 * _BOUND, 0.9 * _BOUND)
    put = _PutClumps(float(np.asarray(density)), widths)
    return Unknown(apply=put, name=name, bounds=(-_BOUND, _BOUND), start=draw, prior=(draw, 1.0))


@dataclasses.dataclass(frozen=True)
class _PutClumps:
    """Put the leaves of a field into a scene: hashable, so that equal priors share compiled programs.

    - `density`: within clumps, m2/m3. - `widths`: standard deviations of the field along the axes, in voxels.
    """

    density: float
    widths: tuple[float, ...]

    def __call__(self, scene: Scene, value: Float[Array, "nx ny nz"]) -> Scene:
        assert scene.canopy is not None
        smooth = [jnp.asarray(_smoothing(n, w), value.dtype) for n, w in zip(value.shape, self.widths)]
        # Unit variance each, as the numbers of a layer are independent.
        layers = jnp.sum(value, axis=(0, 1)) / np.sqrt(value.shape[0] * value.shape[1])
        field = value
        for axis, matrix in enumerate(smooth):
            field = jnp.moveaxis(tensordot(matrix, field, ((1,), (axis,))), 0, axis)
        field += _LAYERS * tensordot(smooth[2], layers, ((1,), (0,)))[None, None, :] + _LEVEL
        # A voxel map stores half of the leaf area density, as `VoxelMap.from_lad` does.
        leaf = 0.5 * self.density * jax.nn.sigmoid(field / _EDGE)
        return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, leaf)


def _smoothing(n: int, width: float) -> Float[np.ndarray, "n n"]:
    """Return a matrix that gives white noise the correlation exp(-d^2 / (2 width^2)), and unit variance."""
    distance = np.subtract.outer(np.arange(n), np.arange(n)) / width
    # The correlation of the smoothed noise is the kernel convolved with itself, wider by the root of two.
    kernel = np.exp(-(distance**2))
    return kernel / np.sqrt(np.sum(kernel**2, axis=1, keepdims=True))
