r"""Vertical profiles: layers of plants above the ground, and what a fit tells of their heights.

The credible band is that of a normal posterior about the fit, cut at the bounds. With whitened Jacobian J and
prior precision P at the fit, the averaging kernel

    A = d estimate / d truth = (J^T J + P)^-1 J^T J

is the identity where the data tell all and zero where they tell nothing. It is that of the posterior without
bounds.

**Source:** Rodgers (2000), Inverse Methods for Atmospheric Sounding, chapters 2 and 3; resolution as spacing
over diagonal: Purser and Huang (1993), J. Appl. Meteorol. 32, 1211.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special

from jaxlidar import Plane, Scene, VoxelMap
from jaxlidar.extend import check_kind, check_range, concrete


def put_profile(scene: Scene, density: Float[Array, " layers"]) -> Scene:
    """The scene with leaves in layers above its ground, the same everywhere: an `apply` for `Unknown`.

    Layers are as thick as the voxels are high, the first lies on the ground, and all follow its slope: each
    column of voxels is lifted by the ground's height below its middle. Differentiable in the density and the
    ground's height, slope and aspect, which may be unknowns listed before it. On a slope, columns should be
    so narrow that the ground rises by about a layer or less from one to the next; level ground needs one.

    **Arguments:**

    - `scene`: with a canopy whose voxel map has leaf and reaches from the lowest ground to the highest
      plants. With a plane as ground, or none: then layers begin at z = 0.
    - `density`: (layers,) leaf area density in m2/m3, from the lowest layer up.

    **Returns:** a `Scene`.

    **Raises:** ValueError for a scene without leaf or with a ground that is no plane, and for plants that
    reach out of the voxel map; of values that a JAX transformation is tracing, these are left out.

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
    x = (origin[0] + size[0] * (jnp.arange(nx) + 0.5))[:, None]
    y = (origin[1] + size[1] * (jnp.arange(ny) + 0.5))[None, :]
    ground = jnp.zeros((nx, ny), size.dtype)
    if scene.ground is not None:
        plane = scene.ground.shape
        if not isinstance(plane, Plane):
            raise ValueError("the scene's ground is no plane; admissible are planes: see VoxelMap.above")
        east, north, up = plane.upward
        ground = plane.foot[2] - (east * (x - plane.foot[0]) + north * (y - plane.foot[1])) / up
    # Voxel k spans the layers from t to t + 1, most of two of them.
    t = jnp.arange(nz)[None, None, :] - ((ground - origin[2]) / size[2])[..., None]
    first = jnp.floor(t)
    share = t - first
    layers = jnp.pad(jnp.asarray(density), 1)

    def at(number: Array) -> Array:
        return layers[jnp.clip(number.astype(int) + 1, 0, layers.size - 1)]

    leaf = 0.5 * ((1.0 - share) * at(first) + share * at(first + 1.0))
    _refuse_plants_outside(voxels, layers, ground, leaf)
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, leaf)


def _refuse_plants_outside(
    voxels: VoxelMap,
    layers: Float[Array, "padded"],
    ground: Float[Array, "nx ny"],
    leaf: Float[Array, "x y z"],
) -> None:
    known = [concrete(a) for a in (layers, ground, leaf, voxels.voxel_size)]
    if any(a is None for a in known):
        return
    density, feet, held, size = (np.asarray(a, float) for a in known)
    there = np.flatnonzero(density[1:-1])
    if np.all(2.0 * held.sum(axis=-1) >= 0.999 * density.sum()) or not there.size:
        return
    low, high = feet.min() + size[2] * there[0], feet.max() + size[2] * (there[-1] + 1)
    bottom = float(voxels.origin[2])
    raise ValueError(
        f"density has plants from {low:g} m to {high:g} m, but the voxel map reaches from {bottom:g} m to "
        f"{bottom + size[2] * held.shape[2]:g} m; admissible is a map that holds all of them"
    )


class AveragingKernel(NamedTuple):
    """How the estimate of a profile follows the truth.

    - `matrix`: (..., layers, layers) derivatives of the estimated values (rows) in the true ones (columns).
    - `degrees_of_freedom`: (...) how many numbers the data tell of the profile: the trace.
    - `resolution`: (..., layers) height that one number from the data stands for, in the unit of the spacing:
      spacing over diagonal; infinite where the data tell nothing.

    **Example:** data that tell every second layer.

    >>> import inversion, numpy as np
    >>> kernel = inversion.AveragingKernel(0.5 * np.eye(4), np.array(2.0), np.full(4, 1.5 / 0.5))
    >>> kernel.resolution.tolist()
    [3.0, 3.0, 3.0, 3.0]
    """

    matrix: Float[np.ndarray, "... layers layers"]
    degrees_of_freedom: Float[np.ndarray, "..."]
    resolution: Float[np.ndarray, "... layers"]


def averaging_kernel_of(fit: "AbstractFitted", name: str, spacing: float) -> AveragingKernel:
    """The averaging kernel of an unknown of a fit, or of each of many."""
    check_range("spacing", spacing, 0.0, low_open=True)
    place = _place(fit, name)
    matrix = np.asarray(fit.averaging, float)[..., place, place]
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    told = np.where(diagonal > 0.0, diagonal, 1.0)
    resolution = np.where(diagonal > 0.0, float(spacing) / told, np.inf)
    return AveragingKernel(matrix, np.sum(diagonal, axis=-1), resolution)


def band_of(fit: "AbstractFitted", name: str, level: float, robust: bool) -> tuple[Any, Any]:
    """The credible band of an unknown of a fit, or of each of many."""
    check_range("level", level, 0.0, 1.0, low_open=True, high_open=True)
    check_kind("robust", robust, bool, "True or False")
    _place(fit, name)
    values = np.asarray(fit.values[name], float)
    stderr = np.asarray((fit.robust_stderr if robust else fit.stderr)[name], float)
    low, high = (np.broadcast_to(b, values.shape) for b in np.asarray(fit.bounds[name], float))
    known = np.isfinite(stderr)
    reach = special.ndtri(0.5 + 0.5 * level) * np.where(known, stderr, 0.0)
    below, above = np.maximum(values - reach, low), np.minimum(values + reach, high)
    return np.where(known, below, low), np.where(known, above, high)


class AbstractFitted(eqx.Module):
    """What a fit, and each of many, tells of its unknowns as profiles."""

    values: eqx.AbstractVar[dict[str, Any]]
    stderr: eqx.AbstractVar[dict[str, Any]]
    robust_stderr: eqx.AbstractVar[dict[str, Any]]
    averaging: eqx.AbstractVar[Any]
    bounds: eqx.AbstractVar[dict[str, Any]]

    def band(self, name: str, level: float = 0.95, *, robust: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Credible band of an unknown, within its bounds: see `inversion.profiles`.

        **Arguments:**

        - `name`: of the unknown.
        - `level`: probability, in (0, 1). Default 0.95.
        - `robust`: with `robust_stderr` in place of `stderr`. Default False.

        **Returns:** (low, high), each of the shape of the values; the bounds, where the standard error is
        infinite.

        **Raises:** ValueError for a name that the fit has not, and a `level` outside (0, 1).
        """
        return band_of(self, name, level, robust)

    def averaging_kernel(self, name: str, spacing: float = 1.0) -> AveragingKernel:
        """How the estimate of a profile follows the truth, and its height resolution.

        Other unknowns are taken as fitted along, and strengths of smoothness priors as known.

        **Arguments:**

        - `name`: of the unknown.
        - `spacing`: distance between layers, positive, such as in m. Default 1: the resolution is in layers.

        **Returns:** an `AveragingKernel`, of NumPy arrays.

        **Raises:** ValueError for a name that the fit has not, and a `spacing` that is not positive.
        """
        return averaging_kernel_of(self, name, spacing)


def _place(fit: Any, name: str) -> slice:
    """Where an unknown is among all. **Raises:** ValueError for a name that the fit has not."""
    if name not in fit.values:
        raise ValueError(f"name = {name!r}; admissible are {', '.join(map(repr, fit.values))}")
    begin = 0
    for other, bounds in fit.bounds.items():
        size = int(np.size(bounds)) // 2
        if other == name:
            return slice(begin, begin + size)
        begin += size
    raise AssertionError(name)
