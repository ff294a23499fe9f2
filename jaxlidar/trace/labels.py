"""What the deposits of photons are booked under: scattering histories, or places of entry.

Histories keep optics apart, so that one trace serves all of them. Where deposits are told apart by the place
at which light entered the scene, histories times places would be too many: there, optics are applied at every
scattering, for each wavelength.
"""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import Scalar
from jaxlidar.trace.photons import Photons, stop
from jaxlidar.trace.setting import Setting


class Label(eqx.Module):
    """What deposits are booked under.

    - `number`: of the history, or of the place of entry.
    - `tints`: for each wavelength, what optics have left of the weight; () where histories keep optics.
    - `entry`: where light entered, x and y, m from the aim point; None where no shots share it.
    """

    number: Int[Array, "*photons"]
    tints: tuple[Float[Array, "*photons"], ...]
    entry: tuple[Float[Array, "*photons"], Float[Array, "*photons"]] | None = None

    @staticmethod
    def of(p: Photons) -> "Label":
        """The label of photons."""
        return Label(p.history, p.tints, p.entry)

    def grown(self, setting: Setting, letter: Int[Array, "*photons"] | int) -> "Label":
        """The label after one more scattering; unchanged where the letter is -1."""
        if setting.optics is None:
            return Label(setting.grow(self.number, letter), (), self.entry)
        if isinstance(letter, int):
            if letter < 0:
                return self
            return self._tinted(setting.optics[letter])
        left = [jnp.where(letter >= 0, o[jnp.maximum(letter, 0)], 1.0) for o in setting.optics.T]
        return self._tinted(left)

    def grown_where(
        self, where: Bool[Array, "*photons"], setting: Setting, letter: Int[Array, "*photons"] | int
    ) -> "Label":
        """The label after one more scattering where `where` holds."""
        after = self.grown(setting, letter)
        number = self.number if setting.optics is not None else jnp.where(where, after.number, self.number)
        tints = tuple(jnp.where(where, a, t) for a, t in zip(after.tints, self.tints))
        return Label(number, tints, self.entry)

    def _tinted(self, optics: Iterable[Array]) -> "Label":
        return Label(self.number, tuple(t * o for t, o in zip(self.tints, optics)), self.entry)

    def slots(self, number: Int[Array, "..."] | None = None) -> list[tuple[Array, Scalar | None]]:
        """Where deposits are booked, and, if optics are applied, what these leave: for every wavelength.

        `number`: of what they are booked under in place of the label's own.
        """
        number = self.number if number is None else number
        if not self.tints:
            return [(number, None)]
        many = len(self.tints)
        return [(number * many + k, tint) for k, tint in enumerate(self.tints)]


def book(
    table: Float[Array, "*rows labels"], rows: tuple[Array | int, ...], label: Label, weight: Scalar
) -> Float[Array, "*rows labels"]:
    """The table with weights added under their labels, without derivatives."""
    for slot, tint in label.slots():
        held = weight if tint is None else weight * tint
        table = table.at[(*rows, slot)].add(stop(held))
    return table
