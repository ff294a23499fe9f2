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

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxlidar import Plane, Scene, VoxelMap
from jaxlidar.extend import as_array, check_kind, check_range, concrete


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


class AbstractPosterior(eqx.Module):
    """Normal posterior of the unknowns of a fit, or of each of many fits."""

    values: eqx.AbstractVar[dict[str, Any]]
    stderr: eqx.AbstractVar[dict[str, Any]]
    robust_stderr: eqx.AbstractVar[dict[str, Any]]
    averaging: eqx.AbstractVar[Any]
    bounds: eqx.AbstractVar[dict[str, Any]]

    def band(self, name: str, level: float = 0.95, *, robust: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Credible band of an unknown, within its bounds: see `inversion.fit.profiles`.

        **Arguments:**

        - `name`: of the unknown.
        - `level`: probability, in (0, 1). Default 0.95.
        - `robust`: use `robust_stderr` in place of `stderr`. Default False.

        **Returns:** (low, high), each of the shape of the values; the bounds for an infinite standard error.

        **Raises:** ValueError for a name that the fit does not have, and a `level` outside (0, 1).
        """
        check_range("level", level, 0.0, 1.0, low_open=True, high_open=True)
        check_kind("robust", robust, bool, "True or False")
        self._rows_of(name)
        values = np.asarray(self.values[name], float)
        stderr = np.asarray((self.robust_stderr if robust else self.stderr)[name], float)
        low, high = (np.broadcast_to(b, values.shape) for b in np.asarray(self.bounds[name], float))
        is_determined = np.isfinite(stderr)
        half_width = scipy.special.ndtri(0.5 + 0.5 * level) * np.where(is_determined, stderr, 0.0)
        lower, upper = np.maximum(values - half_width, low), np.minimum(values + half_width, high)
        return np.where(is_determined, lower, low), np.where(is_determined, upper, high)

    def averaging_kernel(self, name: str, spacing: float = 1.0) -> AveragingKernel:
        """Response of the estimate of a profile to the true profile, and its height resolution.

        The other unknowns are fitted as well; strengths of smoothness priors are taken as known.

        **Arguments:**

        - `name`: of the unknown.
        - `spacing`: distance between layers, positive, such as in m. Default 1: the resolution is in layers.

        **Returns:** an `AveragingKernel`, of NumPy arrays.

        **Raises:** ValueError for a name that the fit does not have, and a `spacing` that is not positive.
        """
        check_range("spacing", spacing, 0.0, low_open=True)
        rows = self._rows_of(name)
        matrix = np.asarray(self.averaging, float)[..., rows, rows]
        diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
        # The inner where keeps the division finite.
        positive = np.where(diagonal > 0.0, diagonal, 1.0)
        resolution = np.where(diagonal > 0.0, float(spacing) / positive, np.inf)
        return AveragingKernel(matrix, np.sum(diagonal, axis=-1), resolution)

    def _rows_of(self, name: str) -> slice:
        """Return the rows of an unknown among the flattened ones. **Raises:** ValueError for another name."""
        if name not in self.values:
            raise ValueError(f"name = {name!r}; admissible are {', '.join(map(repr, self.values))}")
        first = 0
        for other_name, bounds in self.bounds.items():
            # Bounds have the shape (2, ...).
            size = int(np.size(bounds)) // 2
            if other_name == name:
                return slice(first, first + size)
            first += size
        raise AssertionError(name)
