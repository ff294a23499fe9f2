"""Shots of one direction that share light, each of which has a part of every path of it.

Light enters all over the scene (see `jaxlidar.trace.nodes`). A shot's part of a path is the irradiance of its
own beam where the path enters, times what its receiver sees of where the path ends. Neither is approximated:
what is shared is the path.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._vectors import Scalar, Vec
from jaxlidar.instrument.field_of_view import visible_fraction

Plane = tuple[Scalar, Scalar]


class Viewing(eqx.Module):
    """Shots, and which of them may see a path, by the cell in which it enters or ends.

    - `place`: where the beam axes meet the reference plane, m from the aim point. The last is no shot.
    - `radius`, `view_radius`: of footprints and of fields of view, m across the beam.
    - `area`: m2 of the reference plane to which light of the energy 1 comes.
    - `low`, `edge`: corner and edge of the cells, m. `candidates`: shots of each, filled up with the last.
    - `part`: coefficients of shots at nodes, for what is known by node alone.
    - `own`: shots whose order one is traced together with these nodes; filled up with the last.
    - `by_end`: whether cells are those of ends, in place of entries. `gaussian`: profile of the beam.
    """

    place: Float[Array, "shots 2"]
    radius: Float[Array, ""]
    view_radius: Float[Array, ""] | None
    area: Float[Array, ""]
    low: Float[Array, "2"]
    edge: Float[Array, ""]
    candidates: Int[Array, "nx ny most"]
    part: Float[Array, "shots nodes"]
    own: Int[Array, "own"]
    by_end: bool = eqx.field(static=True)
    gaussian: bool = eqx.field(static=True)

    @property
    def shots(self) -> int:
        """Number of shots, with that which is none."""
        return len(self.place)

    def parts(
        self, axis: Vec, entry: Plane, x: Vec
    ) -> tuple[Int[Array, "photons most"], Float[Array, "photons most"], Float[Array, "photons most"]]:
        """Shots that may see paths, their parts of each, and by how much light comes later to them, ns.

        Paths enter at `entry` of the reference plane and end at `x`, m from the aim point. Later: than if the
        axis went through the entry.
        """
        end = x[0] - x[2] * (axis[0] / axis[2]), x[1] - x[2] * (axis[1] / axis[2])
        shots = self._near(end if self.by_end else entry)
        px, py = (self.place[:, i].at[shots].get(mode="promise_in_bounds") for i in range(2))
        along, square = _across(axis, (entry[0][:, None] - px, entry[1][:, None] - py))
        part = self._irradiance(square) * (self.area * -axis[2])
        if self.view_radius is not None:
            _, square = _across(axis, (end[0][:, None] - px, end[1][:, None] - py))
            part = part * visible_fraction(jnp.sqrt(square) / self.view_radius)
        return shots, part, 2.0 / SPEED_OF_LIGHT * along

    def _near(self, at: Plane) -> Int[Array, "photons most"]:
        nx, ny, most = self.candidates.shape
        i, j = (
            jnp.clip((a - low) / self.edge, 0.0, n - 1.0).astype(jnp.int32)
            for a, low, n in zip(at, self.low, (nx, ny))
        )
        return self.candidates.reshape(-1, most).at[i * ny + j].get(mode="promise_in_bounds")

    def _irradiance(self, square: Scalar) -> Scalar:
        """Share of the energy per m2 across the beam, at the squared distance from the axis."""
        w2 = self.radius**2
        if self.gaussian:
            return 2.0 / (np.pi * w2) * jnp.exp(-jnp.minimum(2.0 / w2 * square, 80.0))
        return jnp.where(square <= w2, 1.0 / (np.pi * w2), 0.0)


def _across(axis: Vec, off: Plane) -> tuple[Scalar, Scalar]:
    """Of places in the reference plane: how far along the axis, and the squared distance from it."""
    along = off[0] * axis[0] + off[1] * axis[1]
    return along, jnp.maximum(off[0] ** 2 + off[1] ** 2 - along**2, 0.0)
