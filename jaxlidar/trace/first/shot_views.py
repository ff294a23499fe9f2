r"""Views of shots in shared illumination: shots of one direction each see a fraction of every path.

Light enters all over the scene with the density p(a) (`trace.photons.entry_nodes`). A path that enters at
the point a of the reference plane and ends at the point b contributes to shot f the fraction

    I_f(a) / p(a) * V_f(b)

of its weight: I_f is the irradiance of the shot's own beam, V_f the fraction that its receiver sees. Neither
is approximated but for parallel light: beams and fields of view have the width that they have at the aim
point at every height. What shots share is the path.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._vectors import Scalar, Vec
from jaxlidar.sensors.field_of_view import visible_fraction

PlanePoint = tuple[Scalar, Scalar]


class ShotViews(eqx.Module):
    """Shots, and a grid of cells that says which of them may see a path, by where it enters or ends.

    - `position`: where the beam axes meet the reference plane, m from the aim point. The last is a dummy
      shot.
    - `radius`, `view_radius`: of footprints and of fields of view, m across the beam.
    - `area`: m2 of the reference plane over which light of the energy 1 is spread.
    - `cell_origin`, `cell_size`: corner and edge of the cells, m.
    - `candidates`: shots that may see paths of each cell, filled up with the dummy.
    - `node_coefficients`: coefficients of shots at nodes, for quantities that are tallied by node alone.
    - `first_order_shots`: shots whose order one is traced together with these nodes, filled up with the
      dummy.
    - `by_path_end`: True if cells are those of path ends, False if those of entries. `gaussian`: profile of
      the beam.
    """

    position: Float[Array, "shots 2"]
    radius: Float[Array, ""]
    view_radius: Float[Array, ""] | None
    area: Float[Array, ""]
    cell_origin: Float[Array, "2"]
    cell_size: Float[Array, ""]
    candidates: Int[Array, "nx ny candidates"]
    node_coefficients: Float[Array, "shots nodes"]
    first_order_shots: Int[Array, "first_order_shots"]
    by_path_end: bool = eqx.field(static=True)
    gaussian: bool = eqx.field(static=True)

    @property
    def n_shots(self) -> int:
        """Number of shots, with the dummy."""
        return len(self.position)

    def seen_by_shots(
        self, axis: Vec, entry: PlanePoint, x: Vec
    ) -> tuple[
        Int[Array, "photons candidates"],
        Float[Array, "photons candidates"],
        Float[Array, "photons candidates"],
    ]:
        """Return the shots that may see paths, the fraction of each, and the delay of its light, ns.

        Paths enter at `entry` of the reference plane and end at `x`, m from the aim point. The delay is
        relative to a shot whose axis goes through the entry.

        1. Project the end of the path along the axis onto the reference plane.
        2. Look up the candidates, by that point or by the entry.
        3. I_f / p, by the distance of the entry from the axis of each candidate.
        4. V_f, by the distance of the end from it.
        5. The delay, by how far the entry lies along the axis.
        """
        # The end is projected along the axis onto the reference plane, where positions of shots are known.
        end = x[0] - x[2] * (axis[0] / axis[2]), x[1] - x[2] * (axis[1] / axis[2])
        # Cells of entries or of ends, whichever leaves fewer candidates: a path is seen by few shots of a
        # survey.
        shots = self._candidates_at(end if self.by_path_end else entry)
        shot_x, shot_y = (self.position[:, i].at[shots].get(mode="promise_in_bounds") for i in range(2))
        advance, entry_distance2 = _beam_coordinates(
            axis, (entry[0][:, None] - shot_x, entry[1][:, None] - shot_y)
        )
        # Entries have the density p = 1/area on the reference plane, which is tilted against the beam: hence
        # the cosine, -axis[2].
        fraction = self._irradiance(entry_distance2) * (self.area * -axis[2])
        if self.view_radius is not None:
            _, end_distance2 = _beam_coordinates(axis, (end[0][:, None] - shot_x, end[1][:, None] - shot_y))
            fraction = fraction * visible_fraction(jnp.sqrt(end_distance2) / self.view_radius)
        return shots, fraction, 2.0 / SPEED_OF_LIGHT * advance

    def _candidates_at(self, point: PlanePoint) -> Int[Array, "photons candidates"]:
        nx, ny, n_candidates = self.candidates.shape
        # Paths that enter or end outside the grid take the cell at its edge; their irradiance or view factor
        # is zero anyway.
        i, j = (
            jnp.clip((a - low) / self.cell_size, 0.0, n - 1.0).astype(jnp.int32)
            for a, low, n in zip(point, self.cell_origin, (nx, ny))
        )
        return self.candidates.reshape(-1, n_candidates).at[i * ny + j].get(mode="promise_in_bounds")

    def _irradiance(self, squared_distance: Scalar) -> Scalar:
        """Fraction of the energy per m2 across the beam, at the squared distance from the axis."""
        radius2 = self.radius**2
        if self.gaussian:
            # Capped before the exponential underflows to a denormal, which processors are slow at.
            return 2.0 / (np.pi * radius2) * jnp.exp(-jnp.minimum(2.0 / radius2 * squared_distance, 80.0))
        return jnp.where(squared_distance <= radius2, 1.0 / (np.pi * radius2), 0.0)


def _beam_coordinates(axis: Vec, offset: PlanePoint) -> tuple[Scalar, Scalar]:
    """Return how far points of the reference plane lie along the axis, and their squared distance from it."""
    # Shots with parallel axes lie at different ranges of a common wave front: the advance is the delay.
    advance = offset[0] * axis[0] + offset[1] * axis[1]
    return advance, jnp.maximum(offset[0] ** 2 + offset[1] ** 2 - advance**2, 0.0)
