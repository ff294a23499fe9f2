"""The state of photons and of their collisions, and attached likelihood ratios.

Derivatives use detached sampling with likelihood ratios: random decisions are drawn from a density f whose
derivative is not followed (`detach`), and the weight is multiplied by

    f / detach(f),

which is one, but has the derivative of ln f. The expected value of the derivative of the weight is then the
derivative of the expected value, as long as the support of f does not move (the score-function or
likelihood-ratio estimator; Zeltner et al. 2021, ACM Trans. Graph. 40, 78). This is called the attached ratio
of f here: the density stays attached to its parameters. The sample itself does not, so that it is not the
"attached sampling" of that paper.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import Scalar, Vec, with_derivative_of

detach = lax.stop_gradient

# Outcomes of a photon's encounter with a plate in its path: it flies through a gap, is scattered, or is
# transmitted straight on.
GAP, STOPPED, TRANSMITTED = 0, 1, 2


class LastScattering(eqx.Module):
    """The law that sent a photon on, its incident direction and its normal; derivatives alone need it.

    `law` is an index into `DeviceScene.laws`.
    """

    law: Int[Array, "photons"]
    incident: Vec
    normal: Vec


class Photons(eqx.Module):
    """The state of a chunk of photons.

    - `x`, `w`: position, m from the aim point, and direction.
    - `path`: path length since the sensor, m, less the range of the reference plane.
    - `weight`: geometric weight of the path; where optics are applied, that since the last scattering.
    - `history`: index of the scattering history; or of the entry node (see `trace.tally_index`).
    - `surface`: index of the surface from which the photon starts, or -1.
    - `last_scattering`: None where no derivatives are taken.
    - `alive`: False for photons that left the scene, flew too far to be recorded, or ended by roulette, and
      for padding.
    - `optical_weights`: for each wavelength, the product of optics along the path and of geometric weights up
      to the last scattering, where optics are applied while light is traced; otherwise None.
    - `entry_point`: x and y of where light entered the scene, m, where shots share it; otherwise None. Then
      `path` is relative to a shot whose axis goes through that point.
    - `score`: derivatives of the log path probability (see `trace.derivatives.score_functions`), or None.
    """

    x: Vec
    w: Vec
    path: Float[Array, "photons"]
    weight: Float[Array, "photons"]
    history: Int[Array, "photons"]
    surface: Int[Array, "photons"]
    last_scattering: LastScattering | None
    alive: Bool[Array, "photons"]
    optical_weights: Float[Array, "photons wavelengths"] | None = None
    entry_point: tuple[Float[Array, "photons"], Float[Array, "photons"]] | None = None
    score: Float[Array, "photons parameters"] | None = None


class Collision(eqx.Module):
    """A collision of each photon, and how it scatters.

    - `material`: index of the material that was hit.
    - `channel`: scatterer channel by which the photon goes on.
    - `weight`: importance weight of the collision with its attached ratio, for returns as well as for going
      on: 1/q at a plate that transmits straight on, |n.w| / G where normals are drawn from g, else one.
    - `onward_weight`: factor of the weight of going on along `w`, with the attached ratio of its density.
    - `w`: direction onward.
    - `surface`: index of the surface that was hit, or -1 within a voxel.
    - `reflection`, `transmission`: channels (indices) of light that returns to the sensor from here, or -1.
    - `normal`: normal of the facet, or of the lit side of the surface.
    - `last_scattering`: how the photon was sent on.
    """

    material: Int[Array, "photons"]
    channel: Int[Array, "photons"]
    weight: Float[Array, "photons"]
    onward_weight: Float[Array, "photons"]
    w: Vec
    surface: Int[Array, "photons"]
    reflection: Int[Array, "photons"]
    transmission: Int[Array, "photons"]
    normal: Vec
    last_scattering: LastScattering


class CollisionForReturn(eqx.Module):
    """The fields of a `Collision` on which the light that returns from it to the sensor depends.

    `normal` is None without meshes where facets have no preferred direction: it does not matter then.
    """

    material: Int[Array, "photons"]
    surface: Int[Array, "photons"]
    reflection: Int[Array, "photons"]
    transmission: Int[Array, "photons"]
    normal: Vec | None


def select_collision(where: Bool[Array, "photons"], a: Collision, b: Collision) -> Collision:
    """Return `a` where `where` holds, else `b`."""
    return jax.tree.map(lambda p, q: jnp.where(where, p, q), a, b)


def attached_ratio(density: Scalar) -> Scalar:
    """Return density / detach(density): one, with the derivative of the logarithm of a density.

    Without derivative where the density is zero: such outcomes are never drawn. A constant factor of the
    density does not matter.
    """
    detached = detach(density)
    # Inside both branches the quotient must be finite: the derivative of `where` multiplies the unused one by
    # zero, and zero times infinity is NaN.
    safe = jnp.where(detached == 0, 1.0, detached)
    return with_derivative_of(jnp.ones_like(detached), jnp.where(detached == 0, 1.0, density / safe))
