"""Light that enters all over a scene, about the nodes of a grid, and is told apart by the node.

Light falls about every node with the density of a cubic B-spline, four spacings wide. The sum over nodes of
coefficients times responses is then the response to light whose irradiance is the spline of these
coefficients: one trace serves every footprint that is near to such a spline.

Photons of two nodes are independent, so that variances of sums over nodes are sums of variances.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from jaxlidar._vectors import Scalar, along, dot
from jaxlidar.trace.photons import Photons
from jaxlidar.trace.random_numbers import lattices, words
from jaxlidar.trace.setting import Setting, unscattered

# Rays of order one that are traced together.
RAYS = 8
# Steps of the spline's integral over its width.
_STEPS = 512


def spline(x: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """The cubic B-spline: its integral is one, and from -2 and 2 on it is zero."""
    x = np.abs(x)
    return np.where(x < 1.0, 2.0 / 3.0 - x * x + 0.5 * x**3, np.maximum(2.0 - x, 0.0) ** 3 / 6.0)


_PLACES = np.linspace(-2.0, 2.0, _STEPS + 1)
_SHARES = np.append(0.0, np.cumsum(spline(0.5 * (_PLACES[1:] + _PLACES[:-1]))))


class Nodes(eqx.Module):
    """Nodes of a grid, and which photons and rays enter about which.

    - `place`: of the nodes, m from the aim point.
    - `spacing`: of the grid, m.
    - `node`, `turn`: of every photon its node, and its number among the photons of this node.
    - `share`: of every photon in the light of its node; 0 for photons to spare.
    - `ray_node`, `ray_turn`, `ray_share`: the same for groups of `RAYS` rays of order one; `ray_turn` is the
      number of the first, and `ray_share` that of each.
    """

    place: Float[Array, "nodes 2"]
    spacing: Float[Array, ""]
    node: Int[Array, "photons"]
    turn: Int[Array, "photons"]
    share: Float[Array, "photons"]
    ray_node: Int[Array, "groups"]
    ray_turn: Int[Array, "groups"]
    ray_share: Float[Array, "groups"]

    @property
    def photons(self) -> int:
        """Number of photons."""
        return self.node.size

    def start(
        self, setting: Setting, lane: UInt32[Array, "photons"], key: PRNGKeyArray
    ) -> tuple[UInt32[Array, "photons"], Photons]:
        """Photons about to enter, and numbers for their lattices."""
        assert setting.optics is not None
        at = jnp.minimum(lane, self.photons - 1)
        node, share = self.node[at], self.share[at]
        number, across = self._entries(node, self.turn[at], key)
        point, w, excess = setting.beam.ray(across)
        up = jnp.asarray(-setting.plan.upstream, excess.dtype)
        inside = (lane < self.photons) & (share > 0)
        # Times of light that shots see are relative to where it enters.
        later = 0.0 if setting.viewing is None else 2.0 * dot(point, w)
        return number, Photons(
            along(point, w, up),
            w,
            excess + up - later,
            jnp.where(inside, share, 0.0),
            node,
            jnp.full(lane.shape, -1, jnp.int32),
            setting.kept(unscattered(excess)),
            inside,
            tuple(jnp.ones_like(excess) for _ in range(setting.optics.shape[1])),
            None if setting.viewing is None else across,
        )

    def rays(self, key: PRNGKeyArray) -> tuple[Float[Array, "groups rays"], Float[Array, "groups rays"]]:
        """Where rays of order one enter, x and y, m from the aim point."""
        turn = self.ray_turn[:, None] + jnp.arange(RAYS)[None, :]
        return self._entries(jnp.broadcast_to(self.ray_node[:, None], turn.shape), turn, key)[1]

    def _entries(
        self, node: Int[Array, "*s"], turn: Int[Array, "*s"], key: PRNGKeyArray
    ) -> tuple[UInt32[Array, "*s"], tuple[Scalar, Scalar]]:
        """Numbers, which of two nodes differ at random, and places of entry, one lattice for each node."""
        drawn = words(key, 5)
        stride = drawn[0] | jnp.uint32(1)
        number = turn.astype(jnp.uint32) + node.astype(jnp.uint32) * stride
        shares, places = (jnp.asarray(a, float) for a in (_SHARES / _SHARES[-1], _PLACES))
        off = [jnp.interp(u, shares, places) for u in lattices(drawn[1:], 1, 2)(number, jnp.asarray(0))]
        x, y = (self.place[node, k] + self.spacing * off[k] for k in range(2))
        return number, (x, y)
