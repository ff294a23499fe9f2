"""A canopy of layers over ground, as the scene of fits to single waveforms.

The canopy is horizontally uniform: `LAYERS` layers of equal thickness from a clearance above the ground to
the top. One waveform tells no more of a scene than heights and a profile.

**Error of the top.** A record hardly tells an all but empty layer from none, and errors that are linear about
the minimum do not contain that such layers could go. So two standard errors of the top reach from it to the
underside of the uppermost layer that the record shows: whose density lies two of its standard errors above
zero.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxlidar as jl
from inversion.fit.result import Retrieval
from inversion.fit.uncertainty import correlation_of

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
# A layer whose density is smaller than this many of its standard errors may be empty.
_SHOWN_SIGMAS = 2.0


class CanopyEstimates(NamedTuple):
    """Estimates of a fit with their robust standard errors.

    - `top`: m over the height zero of the fit.
    - `pai`: plant area index of the layers.
    - `density`: (layers,) plant area density of the layers in m2/m3, from below.
    """

    top: float
    top_stderr: float
    pai: float
    pai_stderr: float
    density: Float[np.ndarray, " layers"]
    density_stderr: Float[np.ndarray, " layers"]


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

    def estimates(self, retrievals: Retrieval, number: int) -> CanopyEstimates:
        """Return what a fit of `inversion.retrieve_many`, by its number, says of the canopy.

        The unknowns are named "ground", "canopy height" and "log density". Errors of sums of unknowns are
        those of their joint covariance. With d the layers' densities and h the height of the canopy above its
        clearance, the plant area index is h mean(d), with the derivatives h d_k / (number of layers) by log
        d_k, and mean(d) by h. To the error of the top is added that its uppermost layers may be empty.
        """
        values = {name: np.asarray(value[number], float) for name, value in retrievals.values.items()}
        density = np.exp(values["log density"])
        density_stderr = density * np.asarray(retrievals.robust_stderr["log density"][number], float)
        depth = float(values["canopy height"]) - self.clearance
        by_top = {"ground": 1.0, "canopy height": 1.0}
        by_area = {"log density": depth * density / LAYERS, "canopy height": np.mean(density)}
        covariance = _robust_covariance(retrievals, number)
        linear_error = _propagated(by_top, covariance, values)
        return CanopyEstimates(
            top=float(values["ground"] + values["canopy height"]),
            top_stderr=float(np.hypot(linear_error, _top_error(density, density_stderr, depth / LAYERS))),
            pai=float(depth * np.mean(density)),
            pai_stderr=_propagated(by_area, covariance, values),
            density=density,
            density_stderr=density_stderr,
        )


def _top_error(
    density: Float[np.ndarray, " layers"], stderr: Float[np.ndarray, " layers"], thickness: float
) -> float:
    """Return half of the distance in m from the top to the underside of the uppermost layer that is shown.

    **Arguments:** `density`, `stderr`: of the layers from below. `thickness`: of a layer in m. Without any
    layer that is shown, the distance is that to the underside of all.
    """
    (shown,) = np.nonzero(density >= _SHOWN_SIGMAS * stderr)
    number_of_layers = density.size - (shown[-1] if shown.size else 0)
    return 0.5 * thickness * number_of_layers


def _robust_covariance(retrievals: Retrieval, number: int) -> Float[np.ndarray, "n n"]:
    """Return a covariance with the robust standard errors and the correlations of a fit."""
    stderr = np.concatenate([np.ravel(error[number]) for error in retrievals.robust_stderr.values()])
    return correlation_of(np.asarray(retrievals.covariance[number])) * np.outer(stderr, stderr)


def _propagated(
    derivatives: dict[str, Any], covariance: Float[np.ndarray, "n n"], values: dict[str, np.ndarray]
) -> float:
    """Return the standard error of a quantity, by its derivatives by some of the unknowns."""
    gradient = np.concatenate(
        [
            np.broadcast_to(derivatives.get(name, 0.0), np.shape(value)).ravel()
            for name, value in values.items()
        ]
    )
    # Unknowns that do not act are left out: their errors may be infinite.
    acts = gradient != 0
    return float(np.sqrt(gradient[acts] @ covariance[np.ix_(acts, acts)] @ gradient[acts]))
