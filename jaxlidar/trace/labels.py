"""What the deposits of photons are booked under: scattering histories, or places of entry.

Histories keep optics apart, so that one trace serves all of them. Where deposits are told apart by the place
at which light entered the scene, histories times places would be too many: there, optics are applied at every
scattering, for each wavelength.
"""

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
    """

    number: Int[Array, "*photons"]
    tints: tuple[Float[Array, "*photons"], ...]

    @staticmethod
    def of(p: Photons) -> "Label":
        """The label of photons."""
        return Label(p.history, p.tints)

    def grown(self, setting: Setting, letter: Int[Array, "*photons"] | int) -> "Label":
        """The label after one more scattering; unchanged where the letter is -1."""
        if setting.optics is None:
            return Label(setting.grow(self.number, letter), ())
        if isinstance(letter, int):
            if letter < 0:
                return self
            return Label(self.number, tuple(t * o for t, o in zip(self.tints, setting.optics[letter])))
        left = [jnp.where(letter >= 0, o[jnp.maximum(letter, 0)], 1.0) for o in setting.optics.T]
        return Label(self.number, tuple(t * o for t, o in zip(self.tints, left)))

    def grown_where(
        self, where: Bool[Array, "*photons"], setting: Setting, letter: Int[Array, "*photons"] | int
    ) -> "Label":
        """The label after one more scattering where `where` holds."""
        after = self.grown(setting, letter)
        number = self.number if setting.optics is not None else jnp.where(where, after.number, self.number)
        return Label(number, tuple(jnp.where(where, a, t) for a, t in zip(after.tints, self.tints)))

    def slots(self) -> list[tuple[Int[Array, "*photons"], Scalar | None]]:
        """Where deposits are booked, and, if optics are applied, what these leave: for every wavelength."""
        if not self.tints:
            return [(self.number, None)]
        many = len(self.tints)
        return [(self.number * many + k, tint) for k, tint in enumerate(self.tints)]


def book(
    table: Float[Array, "*rows labels"], rows: tuple[Array | int, ...], label: Label, weight: Scalar
) -> Float[Array, "*rows labels"]:
    """The table with weights added under their labels, without derivatives."""
    for slot, tint in label.slots():
        held = weight if tint is None else weight * tint
        table = table.at[(*rows, slot)].add(stop(held))
    return table
