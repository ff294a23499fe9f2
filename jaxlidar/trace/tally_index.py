"""Tally indices: the rows of a tally that a photon's deposits are added to.

Usually that is the photon's scattering history, which keeps optics apart, so that one trace serves all of
them. Where deposits are distinguished by the node at which light entered the scene, histories times nodes
would be too many: there, optics are applied at every scattering, and a photon has one optical weight per
wavelength. The tally then has n_wavelengths rows for each node (or shot),

    row = node * n_wavelengths + wavelength.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import Scalar
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.photons.photons import Photons, detach


class TallyIndex(eqx.Module):
    """The rows of a tally to which deposits of photons are added.

    - `number`: index of the scattering history, or of the entry node.
    - `optical_weights`: the product of optics along the path, for each wavelength; None where histories keep
      optics.
    - `entry_point`: where light entered, x and y, m from the aim point; None where no shots share it.
    """

    number: Int[Array, "*photons"]
    optical_weights: Float[Array, "*photons wavelengths"] | None
    entry_point: tuple[Float[Array, "*photons"], Float[Array, "*photons"]] | None = None

    @staticmethod
    def of(p: Photons) -> "TallyIndex":
        """Return the tally index of photons."""
        return TallyIndex(p.history, p.optical_weights, p.entry_point)

    def after(self, scene: DeviceScene, channel: Int[Array, "*photons"] | int) -> "TallyIndex":
        """Return the index after one more scattering; unchanged where the channel is -1."""
        if self.optical_weights is None:
            return TallyIndex(scene.history_after(self.number, channel), None, self.entry_point)
        assert scene.optics is not None
        # A channel that is known when the program is compiled needs no look-up, and -1 no operation.
        if isinstance(channel, int):
            if channel < 0:
                return self
            factor = jnp.broadcast_to(scene.optics[channel], self.optical_weights.shape)
            return self._with_weights(self.optical_weights * factor)
        factor = scene.optics.at[jnp.maximum(channel, 0)].get(mode="promise_in_bounds")
        return self._with_weights(self.optical_weights * jnp.where(channel[..., None] >= 0, factor, 1.0))

    def times(self, weight: Scalar) -> "TallyIndex":
        """Return the index with optical weights that are multiplied by `weight`."""
        return self._with_weights(self.by_wavelength(weight))

    def after_where(
        self, where: Bool[Array, "*photons"], scene: DeviceScene, channel: Int[Array, "*photons"] | int
    ) -> "TallyIndex":
        """Return the index after one more scattering where `where` holds."""
        after = self.after(scene, channel)
        if after.optical_weights is None or self.optical_weights is None:
            return TallyIndex(jnp.where(where, after.number, self.number), None, self.entry_point)
        # The number is that of the entry node, which scattering does not change.
        return self._with_weights(jnp.where(where[..., None], after.optical_weights, self.optical_weights))

    def by_wavelength(self, weight: Scalar) -> Float[Array, "*photons wavelengths"]:
        """Return a weight times the optical weights."""
        assert self.optical_weights is not None
        return weight[..., None] * self.optical_weights

    def _with_weights(self, optical_weights: Float[Array, "*photons wavelengths"]) -> "TallyIndex":
        return TallyIndex(self.number, optical_weights, self.entry_point)


def add_to_tally(
    tally: Float[Array, "*materials entries"],
    material: tuple[Array | int, ...],
    index: TallyIndex,
    weight: Scalar,
) -> Float[Array, "*materials entries"]:
    """Return a tally of the energy budget with weights added, without derivatives.

    `material`: the material, (number,), or () where the tally has no axis of materials.
    """
    # A budget is a diagnostic: its derivatives would double the work of every order.
    if index.optical_weights is None:
        return tally.at[(*material, index.number)].add(detach(weight))
    # Wavelengths lie innermost: those of one node are added in one run.
    weights = detach(index.by_wavelength(weight))
    by_node = tally.reshape(*tally.shape[:-1], -1, weights.shape[-1])
    return by_node.at[(*material, index.number)].add(weights).reshape(tally.shape)
