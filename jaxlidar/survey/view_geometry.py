"""Views of shared light: the paths that each shot sees if beams are oblique or have a field of view.

A path that enters the scene at a and ends at b, both projected along the beam onto the reference plane,
counts for the shots f with I_f(a) > 0 and V_f(b) > 0. To find them for millions of paths, the plane is
divided into cells with a list of candidates each: the shots whose axis is near enough to any point of the
cell. Cells are those of a or of b, whichever of beam and field of view is narrower. Lists have one length,
and the sizes of all groups of nodes are the same, so that one compiled program serves all.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from jaxlidar._fields.checks import concrete_number
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.sensors.lidar import tan_half
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.footprint_splines import BeamSection, section_of
from jaxlidar.survey.node_groups import NodeGroup
from jaxlidar.trace.first.shot_views import ShotViews

# Radius within which a field of view is followed, over its own; it sees 5e-5 of what lies beyond.
_VIEW_EXTENT = 1.2
# Cells along the distance within which a shot sees light.
_CELLS = 12
# A position, m, that no shot sees: that of the shots that fill up arrays.
_NOWHERE = 1e6


class ViewGeometry(NamedTuple):
    """Beams and fields of view of shots of one direction, and the sizes of arrays of all groups of nodes.

    - `beam`: of all shots. - `position`: of the shots, m.
    - `view_radius`: of fields of view, m across the beam; None without limit.
    - `max_shots`, `max_central`: largest number of a group's shots, and of those whose centre is in it.
    - `cell_shape`: (nx, ny, candidates), the shape of `candidates` in `trace.first.shot_views.ShotViews`.
    """

    beam: BeamSection
    position: Float[np.ndarray, "shots 2"]
    view_radius: float | None
    max_shots: int
    max_central: int
    cell_shape: tuple[int, int, int]

    @staticmethod
    def of(survey: Survey, groups: list[NodeGroup], spacing: float) -> "ViewGeometry":
        """Return the view geometry of a survey whose shots have one direction."""
        lidar, slant = survey.lidar, float(survey.slant_range[0])
        field = lidar.field_of_view
        geometry = ViewGeometry(
            beam=section_of(survey),
            position=survey.position,
            view_radius=None if field is None else slant * float(tan_half(concrete_number(field), np)),
            max_shots=size_bucket(max(len(group.shots) for group in groups), 4),
            max_central=size_bucket(max(int(group.has_centre.sum()) for group in groups), 4),
            cell_shape=(0, 0, 0),
        )
        # Sizes alone are stored: `views_of_group` makes the cells of a group again, in the task that needs
        # them.
        _, _, shapes, shots = zip(*(geometry._candidate_cells(group, spacing) for group in groups))
        nx, ny = (size_bucket(max(n), 4) for n in zip(*shapes))
        candidates = max(len(of_cell) for of_group in shots for of_cell in of_group)
        return geometry._replace(cell_shape=(nx, ny, size_bucket(candidates, 8)))

    @property
    def extent(self) -> float:
        """Largest distance from a shot's axis at which the entries, or the ends, of its paths lie.

        In m across the beam, for the narrower of beam and field of view.
        """
        entry = self.beam.extent
        return entry if self.view_radius is None else min(entry, _VIEW_EXTENT * self.view_radius)

    @property
    def by_path_end(self) -> bool:
        """True where fields of view are narrower than beams: cells are then those of ends."""
        return self.view_radius is not None and self.extent == _VIEW_EXTENT * self.view_radius

    @property
    def extra_path(self) -> float:
        """Length, m, two-way, by which a path may be longer for a shot than for one at the path's entry.

        The latter is a shot whose axis passes through the entry.
        """
        x, y, z = self.beam.axis
        return 2.0 * self.beam.extent * math.hypot(x, y) / -z

    def _across(self, position: Float[np.ndarray, "positions 2"]) -> Float[np.ndarray, "positions 2"]:
        """Project positions of the reference plane onto the plane across the beams, m."""
        x, y, z = self.beam.axis
        # The first axis is along the beam's horizontal direction, which the projection shortens by the
        # cosine.
        rotation = np.array([[x, -y], [y, x]]) / math.hypot(x, y) if self.beam.is_oblique else np.eye(2)
        return position @ rotation * np.array([-z, 1.0])

    def _candidate_cells(
        self, group: NodeGroup, spacing: float
    ) -> tuple[Float[np.ndarray, "2"], float, tuple[int, int], Any]:
        """Divide the surroundings of a group into cells, and list the shots that may see each.

        **Returns:** the corner of the cells, m from the group's aim point; their edge, m; their number along
        x and y; and of each the numbers within the group of the shots that may see its light.
        """
        shot_position = self.position[group.shots] - group.aim
        edge = self.extent / _CELLS
        if self.by_path_end:
            centres, margin = shot_position, self.extent / -self.beam.axis[2]
        else:
            # Light enters within two spacings of a node: half the width of a spline.
            centres, margin = group.node_position, 2.0 * spacing
        low, high = centres.min(axis=0) - margin, centres.max(axis=0) + margin
        x, y = (low[k] + edge * (np.arange(math.ceil((high[k] - low[k]) / edge)) + 0.5) for k in range(2))
        middle = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        # Half the diagonal of a cell: its corners are that much farther than its middle.
        distance = self.extent + edge * math.sqrt(0.5)
        tree = scipy.spatial.KDTree(self._across(shot_position))
        shots = tree.query_ball_point(self._across(middle), distance, return_sorted=True)
        return low, edge, (len(x), len(y)), shots

    def views_of_group(self, group: NodeGroup, spacing: float) -> ShotViews:
        """Return the arrays for the shots of a group, padded with the number of a shot that sees nothing.

        1. Candidates of each cell. 2. Positions of the shots from the aim point, and one that no light comes
        to. 3. Coefficients of the shots at nodes. 4. Shots whose centre is in the group.
        """
        low, edge, (nx, ny), shots = self._candidate_cells(group, spacing)
        no_shot, n_candidates = self.max_shots, self.cell_shape[2]
        rows = [[*row, *[no_shot] * (n_candidates - len(row))] for row in shots]
        candidates = np.full(self.cell_shape, no_shot, np.int32)
        candidates[:nx, :ny] = np.array(rows, np.int32).reshape(nx, ny, n_candidates)
        position = np.full((self.max_shots + 1, 2), _NOWHERE)
        position[: len(group.shots)] = self.position[group.shots] - group.aim
        coefficients = np.zeros((self.max_shots + 1, group.coefficients.shape[1]), np.float32)
        coefficients[: len(group.shots)] = group.coefficients
        central = np.full(self.max_central, no_shot, np.int32)
        central[: int(group.has_centre.sum())] = np.flatnonzero(group.has_centre)
        return ShotViews(
            position=jnp.asarray(position, float),
            radius=jnp.asarray(self.beam.radius, float),
            view_radius=None if self.view_radius is None else jnp.asarray(self.view_radius, float),
            # 1 / p, m2: the light that enters has the density p = 1 / spacing^2, as one node of the energy 1
            # has that area.
            area=jnp.asarray(spacing**2, float),
            cell_origin=jnp.asarray(low, float),
            cell_size=jnp.asarray(edge, float),
            candidates=jnp.asarray(candidates),
            node_coefficients=jnp.asarray(coefficients, float),
            first_order_shots=jnp.asarray(central),
            by_path_end=self.by_path_end,
            gaussian=self.beam.gaussian,
        )
