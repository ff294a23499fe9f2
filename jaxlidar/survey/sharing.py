"""Whether shots can share light, and whether that pays."""

from typing import NamedTuple

import numpy as np

from jaxlidar._checks import concrete_number
from jaxlidar._summary import percent
from jaxlidar.instrument.survey import Survey
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.parallel_light import one_direction, parallel_light
from jaxlidar.planning.setup import Setup
from jaxlidar.survey.irradiance import Patches, patches
from jaxlidar.survey.tiles import Lit, Tile, lit, tiles
from jaxlidar.survey.views import Views

# Shares of the tolerance that parallel light and the grid of nodes may take.
_PARALLEL, _GRID = 0.5, 0.2
# The same for the finest grid, if it takes more.
_COARSE = 0.5
# Coefficients below this share of the tolerance, of the largest, do not count.
_FAINT = 0.01
# A shot of its own has so many times the photons in a batch, and the rays: here batches are many and small.
# Rays cost about as much as photons, and so few of them have a small part in the error.
_FEWER, _FEWER_RAYS = 4.0, 2.0
# Sharing pays where so many footprints overlap in the mean, and shots are so many.
_OVERLAP, _FEWEST = 1.3, 4
# Where shots see light each in its own way, batches cost something for each of them, photons cost more, and
# the grid serves only what becomes of the light.
_FEWER_VIEWED, _OVERLAP_VIEWED, _FATES = 1.0, 2.0, 0.01


class Sharing(NamedTuple):
    """Tiles of nodes that take the place of shots.

    - `spacing`: of the nodes, m.
    - `views`: how shots see the light of others; None where they see all of it, straight down.
    - `parallel`: bound on what parallel light changes, see `jaxlidar.planning.parallel_light`.
    """

    tiles: list[Tile]
    spacing: float
    views: Views | None
    parallel: float


def sharing(survey: Survey, setup: Setup, rtol: float, asked: bool | None) -> Sharing | None:
    """How the shots of a survey share light; None where they do not.

    `survey` and `setup` have the same origin of coordinates. `asked`: whether they shall; None: if it pays.

    **Raises:** ValueError where they shall and cannot.
    """
    if asked is False:
        return None
    reason = why_apart(survey, setup, rtol)
    if reason is not None:
        if asked:
            raise ValueError(f"shared = True, but {reason}; admissible is None or False")
        return None
    if asked is None and len(survey) < _FEWEST:
        return None
    viewed = _has_views(survey)
    found = patches(survey, max(_GRID * rtol, _FATES) if viewed else _GRID * rtol)
    if not viewed and found.misplaced > _COARSE * rtol:
        if asked:
            raise ValueError(
                f"shared = True, but the finest grid misplaces {percent(found.misplaced)} of the light, at "
                f"rtol = {rtol:g}; admissible is None or False"
            )
        return None
    nodes = lit(found, _FAINT * rtol)
    if asked is None and nodes.overlap < (_OVERLAP_VIEWED if viewed else _OVERLAP):
        return None
    of_nodes = _tiles(found, nodes, setup, _FEWER_VIEWED if viewed else _FEWER)
    views = Views.of(survey, of_nodes, found.spacing) if viewed else None
    return Sharing(of_nodes, found.spacing, views, _parallel(survey, setup))


def _has_views(survey: Survey) -> bool:
    """Whether shots see light each in its own way."""
    return survey.lidar.field_of_view is not None or bool(np.any(survey.zenith > 0))


def _parallel(survey: Survey, setup: Setup) -> float:
    return parallel_light(survey, setup.plan.limits.start_distance, setup.plan.scope.last_return)


def _tiles(found: Patches, nodes: Lit, setup: Setup, fewer: float) -> list[Tile]:
    plan = setup.plan
    whole = float(nodes.light.sum()) * nodes.overlap / len(found.first)
    photons = plan.n_photons / fewer / whole if plan.orders > 1 else 0.0
    return tiles(found, nodes, photons, plan.n_rays / _FEWER_RAYS / whole)


def why_apart(survey: Survey, setup: Setup, rtol: float) -> str | None:
    """Why the shots of a survey cannot share light; None where they can."""
    canopy, lidar = setup.scene.canopy, setup.lidar
    if not one_direction(survey):
        return "shots have more than one direction"
    if _has_views(survey) and setup.plan.orders == 1:
        return "one order is followed, which shots that lean or have a field of view do not share"
    if not setup.plan.is_random:
        return "nothing is random"
    if concrete_number(lidar.divergence) == 0:
        return "the beam has no width"
    if canopy is not None and canopy.is_straight:
        return "transmission = 'straight': light of every wavelength goes its own way"
    if any(isinstance(s.law, AbstractMirror) for s in setup.scene.surfaces):
        return "a surface is a mirror"
    bound = _parallel(survey, setup)
    if bound > _PARALLEL * rtol:
        return f"light that is not parallel changes up to {percent(bound)} of samples, at rtol = {rtol:g}"
    return None
