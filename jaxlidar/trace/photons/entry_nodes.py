r"""Entry nodes of shared illumination: light that enters all over a scene, tallied by entry node.

Light falls about every node n of a grid with the density of a cubic B-spline B_n(a), four spacings wide. The
response to an irradiance sum_n c_n B_n(a) is sum_n c_n response_n, so that one trace, tallied by node, serves
every footprint that is near to such a spline. Photons of two nodes are nearly independent, so that variances
add with the squares of c_n.

Histories times nodes would be too many; optics are applied while light is traced. The response of a node has
one trace for each wavelength, with one history.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from jaxlidar._vectors import Scalar
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.photons.photon_step import start_photons
from jaxlidar.trace.photons.photons import Photons
from jaxlidar.trace.photons.random_numbers import random_words, shifted_lattices

# Rays of order one that are traced together.
RAYS_PER_GROUP = 8
# Steps of the table of the spline's integral.
_TABLE_STEPS = 512


def cubic_bspline(x: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """Evaluate the cubic B-spline: its integral is one, and it is zero from -2 and 2 on."""
    x = np.abs(x)
    return np.where(x < 1.0, 2.0 / 3.0 - x * x + 0.5 * x**3, np.maximum(2.0 - x, 0.0) ** 3 / 6.0)


# The spline's distribution function: points of entry are drawn by its inverse.
_POSITIONS = np.linspace(-2.0, 2.0, _TABLE_STEPS + 1)
_CUMULATIVE = np.append(0.0, np.cumsum(cubic_bspline(0.5 * (_POSITIONS[1:] + _POSITIONS[:-1]))))


class EntryNodes(eqx.Module):
    """Nodes of a grid, and the photons and rays that enter about each.

    - `position`: of the nodes, m from the aim point. `spacing`: of the grid, m.
    - `photon_node`, `photon_rank`: of every photon its node, and its rank among the photons of this node.
    - `photon_fraction`: of every photon in the light of its node; 0 for spare photons.
    - `group_node`, `group_rank`, `group_fraction`: the same for groups of `RAYS_PER_GROUP` rays of order one;
      `group_rank` is the number of the first ray, and `group_fraction` that of each.
    """

    position: Float[Array, "nodes 2"]
    spacing: Float[Array, ""]
    photon_node: Int[Array, "photons"]
    photon_rank: Int[Array, "photons"]
    photon_fraction: Float[Array, "photons"]
    group_node: Int[Array, "groups"]
    group_rank: Int[Array, "groups"]
    group_fraction: Float[Array, "groups"]

    @property
    def n_photons(self) -> int:
        """Number of photons."""
        return self.photon_node.size

    def send_photons(
        self, scene: DeviceScene, lane: UInt32[Array, "photons"], key: PRNGKeyArray
    ) -> tuple[UInt32[Array, "photons"], Photons]:
        """Send photons into the scene; also return their numbers in the lattices of later random numbers.

        `lane`: number of the photon in the batch; lanes beyond the last photon are padding.

        1. The node and the rank of each photon.
        2. Its point of entry, with the density of the node's spline.
        3. Its start above the scene, on the ray through that point.
        4. Its weight, the fraction of the node's light; zero for padding. The index of the node takes the
           place of the history.
        """
        # Lanes beyond the last photon fill up the last chunk, with the weight zero.
        photon = jnp.minimum(lane, self.n_photons - 1)
        node, fraction = self.photon_node[photon], self.photon_fraction[photon]
        number, entry = self._sample_entries(node, self.photon_rank[photon], key)
        is_real = (lane < self.n_photons) & (fraction > 0)
        return number, start_photons(scene, entry, jnp.where(is_real, fraction, 0.0), node, is_real)

    def ray_entries(
        self, key: PRNGKeyArray
    ) -> tuple[Float[Array, "groups rays"], Float[Array, "groups rays"]]:
        """Sample where rays of order one enter, x and y, m from the aim point."""
        rank = self.group_rank[:, None] + jnp.arange(RAYS_PER_GROUP)[None, :]
        node = jnp.broadcast_to(self.group_node[:, None], rank.shape)
        return self._sample_entries(node, rank, key)[1]

    def _sample_entries(
        self, node: Int[Array, "*s"], rank: Int[Array, "*s"], key: PRNGKeyArray
    ) -> tuple[UInt32[Array, "*s"], tuple[Scalar, Scalar]]:
        """Sample points of entry about nodes: one lattice per node, at random offsets."""
        # Node n takes a stretch of the lattice that starts n strides on. The stride is random, so that the
        # entries of two nodes are nearly independent.
        words = random_words(key, 5)
        stride = words[0] | jnp.uint32(1)
        number = rank.astype(jnp.uint32) + node.astype(jnp.uint32) * stride
        cumulative = jnp.asarray(_CUMULATIVE / _CUMULATIVE[-1], float)
        positions = jnp.asarray(_POSITIONS, float)
        uniform = shifted_lattices(words[1:], 1, 2)(number, jnp.asarray(0))
        # Linear interpolation of the inverse distribution: exact enough, as the density is smooth over the
        # table's steps.
        offset = [jnp.interp(u, cumulative, positions) for u in uniform]
        x, y = (self.position[node, k] + self.spacing * offset[k] for k in range(2))
        return number, (x, y)
