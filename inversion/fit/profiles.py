r"""Vertical profiles: layers of plants above the ground, credible bands and averaging kernels.

The likelihood profile of one unknown is another thing: `inversion.fit.identifiability`.

The posterior of a fit is taken as normal, with the standard errors of the fit: those of
H^-1 (J^T W J + P) H^-1 and the simulation's noise (`inversion.fit.uncertainty`), H = J^T J + P, with whitened
Jacobian J and prior precision P. The credible band is cut at the bounds. The averaging kernel

    A = d estimate / d truth = (J^T J + P)^-1 J^T J

is the identity for unknowns that the data determine fully, and zero for those they do not constrain. An
estimate at a bound is held there: its row is zero, and J and P are those of the others. The trace is the
number of degrees of freedom for signal: how many numbers the data determine.

**Source:** Rodgers (2000), Inverse Methods for Atmospheric Sounding, chapters 2 and 3; resolution as spacing
over diagonal: Purser and Huang (1993), J. Appl. Meteorol. 32, 1211.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar import Plane, Scene, VoxelMap
from jaxlidar.extend import as_array, concrete


def put_profile(scene: Scene, density: Float[Array, " layers"]) -> Scene:
    """Put horizontally uniform layers of leaves above the scene's ground: an `apply` for `Unknown`.

    Layers are as thick as the voxels are high, the first lies on the ground, and all follow its slope: each
    column of voxels is raised by the height of the ground below its middle. The result is differentiable in
    the density and in the ground's height, slope and aspect, which may be unknowns listed before it. On a
    slope, choose columns so narrow that the ground rises by about a layer or less from one to the next; level
    ground needs one.

    **Arguments:**

    - `scene`: with a canopy whose voxel map has leaf and extends from the lowest ground to the highest
      plants. Its ground is a plane; without ground, layers begin at z = 0.
    - `density`: (layers,) leaf area density in m2/m3, from the lowest layer up.

    **Returns:** a `Scene`.

    **Raises:** ValueError for a scene without leaf or with a ground that is no plane, and for plants outside
    the voxel map; the latter is not checked for values that a JAX transformation is tracing.

    **Example:** two layers of 2 m on a slope that falls to the east.

    >>> import jaxlidar as jl, jax.numpy as jnp
    >>> import inversion
    >>> voxels = jl.VoxelMap.from_lad(jnp.zeros((2, 1, 4)), voxel_size=2.0, origin=(-2.0, -1.0, -2.0))
    >>> canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4))
    >>> scene = jl.Scene(canopy=canopy, ground=jl.Ground(slope=45.0, aspect=90.0))
    >>> scene = inversion.put_profile(scene, jnp.array([0.4, 0.2]))
    >>> (20.0 * scene.canopy.voxels.leaf[:, 0]).round().tolist()
    [[0.0, 2.0, 3.0, 1.0], [2.0, 3.0, 1.0, 0.0]]
    """
    if scene.canopy is None or scene.canopy.voxels.leaf is None:
        raise ValueError("scene has no canopy with leaf; admissible is one whose voxel map has leaf")
    voxels = scene.canopy.voxels
    nx, ny, nz = voxels.shape
    size, origin = voxels.voxel_size, jnp.asarray(voxels.origin)
    x = (origin[0] + size[0] * (jnp.arange(nx, dtype=size.dtype) + 0.5))[:, None]
    y = (origin[1] + size[1] * (jnp.arange(ny, dtype=size.dtype) + 0.5))[None, :]
    ground = jnp.zeros((nx, ny), size.dtype)
    if scene.ground is not None:
        plane = scene.ground.shape
        if not isinstance(plane, Plane):
            raise ValueError("the scene's ground is no plane; admissible are planes: see VoxelMap.above")
        east, north, up = plane.upward
        ground = plane.foot[2] - (east * (x - plane.foot[0]) + north * (y - plane.foot[1])) / up
    # Height of a voxel's lower face above the ground, t, in layers: the voxel extends from t to t + 1 and
    # overlaps the layers floor(t) and floor(t) + 1, the first with the fraction 1 - (t - floor(t)).
    lower_face = jnp.arange(nz, dtype=size.dtype)[None, None, :] - ((ground - origin[2]) / size[2])[..., None]
    lower_layer = jnp.floor(lower_face)
    upper_fraction = lower_face - lower_layer
    # An empty layer on either side stands for all layers outside.
    padded = jnp.pad(as_array(density, "density"), 1)

    def density_of(layer: Array) -> Array:
        return padded[jnp.clip(layer.astype(int) + 1, 0, padded.size - 1)]

    # A voxel map stores half of the leaf area density, as `VoxelMap.from_lad` does.
    extinction = 0.5 * (
        (1.0 - upper_fraction) * density_of(lower_layer) + upper_fraction * density_of(lower_layer + 1.0)
    )
    _check_plants_inside(voxels, padded, ground, extinction)
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, extinction)


def _check_plants_inside(
    voxels: VoxelMap,
    padded: Float[Array, "padded"],
    ground: Float[Array, "nx ny"],
    extinction: Float[Array, "x y z"],
) -> None:
    """Refuse plants outside of the voxel map, unless JAX is tracing. **Raises:** ValueError."""
    arrays = [concrete(a) for a in (padded, ground, extinction, voxels.voxel_size)]
    if any(a is None for a in arrays):
        return
    density, ground_height, leaf_extinction, size = (np.asarray(a, float) for a in arrays)
    planted = np.flatnonzero(density[1:-1])
    # Twice the extinction of each column adds up to all layers, up to single precision's rounding.
    if np.all(2.0 * leaf_extinction.sum(axis=-1) >= 0.999 * density.sum()) or not planted.size:
        return
    low = ground_height.min() + size[2] * planted[0]
    high = ground_height.max() + size[2] * (planted[-1] + 1)
    bottom = float(voxels.origin[2])
    raise ValueError(
        f"density has plants from {low:g} m to {high:g} m, but the voxel map reaches from {bottom:g} m to "
        f"{bottom + size[2] * leaf_extinction.shape[2]:g} m; admissible is a map that holds all of them"
    )


class AveragingKernel(NamedTuple):
    """Response of the estimate of a profile to the true profile.

    - `matrix`: (..., layers, layers) derivatives of the estimated values (rows) in the true ones (columns).
      Rows of layers at one of their bounds are zero: a small change of the truth leaves them there.
    - `degrees_of_freedom`: (...) degrees of freedom for signal, the number of independent numbers that the
      data determine: the trace.
    - `resolution`: (..., layers) height per number that the data determine, in the unit of the spacing:
      spacing over diagonal; infinite for layers that the data do not constrain, and for those at a bound.

    **Example:** a diagonal of one half: two layers for each number from the data.

    >>> import inversion, numpy as np
    >>> from inversion.fit.profiles import AveragingKernel
    >>> kernel = AveragingKernel(0.5 * np.eye(4), np.array(2.0), np.full(4, 1.5 / 0.5))
    >>> kernel.resolution.tolist()
    [3.0, 3.0, 3.0, 3.0]
    """

    matrix: Float[np.ndarray, "... layers layers"]
    degrees_of_freedom: Float[np.ndarray, "..."]
    resolution: Float[np.ndarray, "... layers"]
