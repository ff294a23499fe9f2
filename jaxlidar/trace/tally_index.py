"""Tally indices: the rows of a tally that a photon's deposits are added to.

Usually that is the photon's scattering history, which keeps optics apart, so that one trace serves all of
them. Where deposits are distinguished by the node at which light entered the scene, histories times nodes
would be too many: there, optics are applied at every scattering, and a photon has one optical weight per
wavelength. The tally then has n_wavelengths rows for each node (or shot),

    row = node * n_wavelengths + wavelength.
"""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import Scalar
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.photons.photons import Photons, detach


class TallyIndex(eqx.Module):
    """The rows of a tally to which deposits of photons are added.

    - `number`: index of the scattering history, or of the entry node.
    - `optical_weights`: for each wavelength, the product of optics along the path; () where histories keep
      optics.
    - `entry_point`: where light entered, x and y, m from the aim point; None where no shots share it.
    """

    number: Int[Array, "*photons"]
    optical_weights: tuple[Float[Array, "*photons"], ...]
    entry_point: tuple[Float[Array, "*photons"], Float[Array, "*photons"]] | None = None

    @staticmethod
    def of(p: Photons) -> "TallyIndex":
        """Return the tally index of photons."""
        return TallyIndex(p.history, p.optical_weights, p.entry_point)

    def after(self, scene: DeviceScene, channel: Int[Array, "*photons"] | int) -> "TallyIndex":
        """Return the index after one more scattering; unchanged where the channel is -1."""
        if scene.optics is None:
            return TallyIndex(scene.history_after(self.number, channel), (), self.entry_point)
        # A channel that is known when the program is compiled needs no look-up, and -1 no operation.
        if isinstance(channel, int):
            if channel < 0:
                return self
            return self._multiplied_by(scene.optics[channel])
        factors = [jnp.where(channel >= 0, o[jnp.maximum(channel, 0)], 1.0) for o in scene.optics.T]
        return self._multiplied_by(factors)

    def times(self, weight: Scalar) -> "TallyIndex":
        """Return the index with optical weights that are multiplied by `weight`."""
        return self._multiplied_by([weight for _ in self.optical_weights])

    def after_where(
        self, where: Bool[Array, "*photons"], scene: DeviceScene, channel: Int[Array, "*photons"] | int
    ) -> "TallyIndex":
        """Return the index after one more scattering where `where` holds."""
        after = self.after(scene, channel)
        # With optics applied the number is that of the entry node, which scattering does not change.
        number = self.number if scene.optics is not None else jnp.where(where, after.number, self.number)
        weights = tuple(
            jnp.where(where, new, old) for new, old in zip(after.optical_weights, self.optical_weights)
        )
        return TallyIndex(number, weights, self.entry_point)

    def _multiplied_by(self, factors: Iterable[Array]) -> "TallyIndex":
        weights = tuple(weight * factor for weight, factor in zip(self.optical_weights, factors))
        return TallyIndex(self.number, weights, self.entry_point)

    def rows(self, number: Int[Array, "..."] | None = None) -> list[tuple[Array, Scalar | None]]:
        """Return pairs of the row of a tally, and the factor of the weight that is added there.

        There is one pair for every wavelength where optics are applied, else one with the factor None.

        `number`: shots to use in place of the index's own number. Default None.
        """
        number = self.number if number is None else number
        if not self.optical_weights:
            return [(number, None)]
        # Wavelengths lie innermost: the rows of one shot or node are neighbours in memory.
        n_wavelengths = len(self.optical_weights)
        return [(number * n_wavelengths + k, weight) for k, weight in enumerate(self.optical_weights)]


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
    for row, factor in index.rows():
        term = weight if factor is None else weight * factor
        tally = tally.at[(*material, row)].add(detach(term))
    return tally
