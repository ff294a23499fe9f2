"""What shots see of the light that they share, for each tile."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import spatial

from jaxlidar._checks import concrete_number
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.survey.irradiance import Section, section_of
from jaxlidar.survey.tiles import Tile
from jaxlidar.trace.shot_views import ShotViews

# A field of view is followed so far, in units of its radius; of what lies beyond it sees 5e-5.
_FIELD = 1.2
# Cells along the reach of a shot.
_CELLS = 12


class _Cells(NamedTuple):
    """Corner and edge of a tile's cells, m from its aim point, how many, and who may see what is there."""

    low: Float[np.ndarray, "2"]
    edge: float
    shape: tuple[int, int]
    near: Any


class Views(NamedTuple):
    """How shots of one direction see light, and the sizes of what tiles know of it, one for all.

    - `beam`: of all shots. - `position`: of the shots, m. - `view_radius`: of fields of view, m across it.
    - `shots`, `own`: at most in a tile, and those whose order one is traced there.
    - `cells`: (nx, ny, most), as in `ShotViews`.
    """

    beam: Section
    position: Float[np.ndarray, "shots 2"]
    view_radius: float | None
    shots: int
    own: int
    cells: tuple[int, int, int]

    @staticmethod
    def of(survey: Survey, tiles: list[Tile], spacing: float) -> "Views":
        """The views of a survey whose shots have one direction."""
        lidar, slant = survey.lidar, float(survey.slant_range[0])
        field = lidar.field_of_view
        field = None if field is None else 0.5e-3 * concrete_number(field) * slant
        found = Views(
            section_of(survey),
            survey.position,
            field,
            size_bucket(max(len(tile.shots) for tile in tiles), 4),
            size_bucket(max(int(tile.home.sum()) for tile in tiles), 4),
            (0, 0, 0),
        )
        cells = [found._cells(tile, spacing) for tile in tiles]
        nx, ny = (size_bucket(max(c.shape[k] for c in cells), 4) for k in range(2))
        most = max(len(shots) for c in cells for shots in c.near)
        return found._replace(cells=(nx, ny, size_bucket(most, 8)))

    @property
    def reach(self) -> float:
        """How far from the axis of a shot light may enter or end, whichever is nearer, m across the beam."""
        entry = self.beam.reach
        return entry if self.view_radius is None else min(entry, _FIELD * self.view_radius)

    @property
    def by_end(self) -> bool:
        """Whether fields of view are narrower than beams."""
        return self.view_radius is not None and self.reach == _FIELD * self.view_radius

    @property
    def slack(self) -> float:
        """How much longer than to where light enters the way of its shots may be, there and back, m."""
        x, y, z = self.beam.axis
        return 2.0 * self.beam.reach * math.hypot(x, y) / -z

    def _across(self, place: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, "places 2"]:
        """Places of the reference plane, seen along the beams, m."""
        x, y, z = self.beam.axis
        turn = np.array([[x, -y], [y, x]]) / math.hypot(x, y) if self.beam.leans else np.eye(2)
        return place @ turn * np.array([-z, 1.0])

    def _cells(self, tile: Tile, spacing: float) -> _Cells:
        """The cells of a tile, and which shots may see what is there."""
        place = self.position[tile.shots] - tile.aim
        edge = self.reach / _CELLS
        if self.by_end:
            about, more = place, self.reach / -self.beam.axis[2]
        else:
            about, more = tile.place, 2.0 * spacing
        low, high = about.min(axis=0) - more, about.max(axis=0) + more
        x, y = (low[k] + edge * (np.arange(math.ceil((high[k] - low[k]) / edge)) + 0.5) for k in range(2))
        middle = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        tree, far = spatial.KDTree(self._across(place)), self.reach + edge * math.sqrt(0.5)
        near = tree.query_ball_point(self._across(middle), far, return_sorted=True)
        return _Cells(low, edge, (len(x), len(y)), near)

    def at(self, tile: Tile, spacing: float) -> ShotViews:
        """What the shots of a tile see."""
        low, edge, (nx, ny), near = self._cells(tile, spacing)
        none, most = self.shots, self.cells[2]
        rows = [[*shots, *[none] * (most - len(shots))] for shots in near]
        candidates = np.full(self.cells, none, np.int32)
        candidates[:nx, :ny] = np.array(rows, np.int32).reshape(nx, ny, most)
        place = np.full((self.shots + 1, 2), 1e6)
        place[: len(tile.shots)] = self.position[tile.shots] - tile.aim
        part = np.zeros((self.shots + 1, tile.part.shape[1]), np.float32)
        part[: len(tile.shots)] = tile.part
        own = np.full(self.own, none, np.int32)
        own[: int(tile.home.sum())] = np.flatnonzero(tile.home)
        return ShotViews(
            jnp.asarray(place, float),
            jnp.asarray(self.beam.radius, float),
            None if self.view_radius is None else jnp.asarray(self.view_radius, float),
            jnp.asarray(spacing**2, float),
            jnp.asarray(low, float),
            jnp.asarray(edge, float),
            jnp.asarray(candidates),
            jnp.asarray(part, float),
            jnp.asarray(own),
            self.by_end,
            self.beam.gaussian,
        )
