"""The irradiance of footprints as splines: coefficients at the nodes of a grid that all footprints share."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar.instrument.survey import Survey
from jaxlidar.trace.entry_nodes import cubic_bspline

# How far a Gaussian beam is followed, in units of its radius; 4e-6 of its energy lies beyond.
REACH = 2.5
# Points along each side of a cell at which irradiances are looked at.
_FINE = 4
# Spacings of the grid, in units of the radius, from which the widest that serves is taken.
_SPACINGS = (0.5, 0.35, 0.25, 0.18, 0.125, 0.09, 0.0625, 0.045, 0.03)
# Footprints that are looked at together.
_TOGETHER = 128


class Section(NamedTuple):
    """The cross-section of a beam: its radius, m, whether it is a Gaussian, and the direction of its axis."""

    radius: float
    gaussian: bool
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0)

    @property
    def reach(self) -> float:
        """How far the beam is followed, m across it."""
        return self.radius * (REACH if self.gaussian else 1.0)

    @property
    def leans(self) -> bool:
        """Whether the beam does not point straight down."""
        return self.axis[2] != -1.0


def section_of(survey: Survey) -> Section:
    """The cross-section of the beams of a survey whose shots have one direction."""
    x, y, z = (float(a) for a in survey.direction[0])
    return Section(float(survey.footprint_radius[0]), survey.lidar.profile == "gaussian", (x, y, z))


class Patches(NamedTuple):
    """Coefficients of footprints at nodes; their sum is the footprint's energy, 1.

    - `first`: (shots, 2) numbers along x and y of the first node of each; node 0 is at x = y = 0.
    - `coefficients`: (shots, nodes, nodes), along x and y.
    - `astray`: (shots, nodes, nodes) energy that the splines put elsewhere, by cells about each node.
    - `spacing`: of the grid, m.
    """

    first: Int[np.ndarray, "shots 2"]
    coefficients: Float[np.ndarray, "shots nodes nodes"]
    astray: Float[np.ndarray, "shots nodes nodes"]
    spacing: float

    @property
    def misplaced(self) -> float:
        """The root of the sum of squares of what goes astray, for the worst footprint, see `misplaced`."""
        return float(np.sqrt((self.astray**2).sum(axis=(1, 2)).max()))


def patches(survey: Survey, tolerance: float) -> Patches:
    """The footprints of a survey of one direction, on a grid as wide as the tolerance allows."""
    beam, some = section_of(survey), survey.position[:: max(len(survey) // 8, 1)]
    spacing = beam.radius
    for share in _SPACINGS:
        spacing = beam.radius * share
        if max(misplaced(place, beam, spacing) for place in some) <= tolerance:
            break
    first, coefficients = _fitted(survey.position, beam, spacing)
    astray = np.empty_like(coefficients)
    for start in range(0, len(first), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        off = _off(first[part], coefficients[part], survey.position[part], beam, spacing)
        # Each cell counts a quarter in each of its nodes, by its square.
        around = np.pad(off**2, ((0, 0), (1, 1), (1, 1)))
        squares = around[:, :-1, :-1] + around[:, 1:, :-1] + around[:, :-1, 1:] + around[:, 1:, 1:]
        astray[part] = 0.5 * np.sqrt(squares)
    return Patches(first, coefficients, astray, spacing)


def misplaced(place: Float[np.ndarray, "2"], beam: Section, spacing: float) -> float:
    """The root of the sum over cells of the squared energy that a spline puts elsewhere.

    It is the relative error of a waveform where places a cell apart return independent waveforms.
    """
    first, coefficients = _fitted(place[None], beam, spacing)
    return float(np.sqrt(np.sum(_off(first, coefficients, place[None], beam, spacing) ** 2)))


def _off(
    first: Int[np.ndarray, "shots 2"],
    coefficients: Float[np.ndarray, "shots nodes nodes"],
    place: Float[np.ndarray, "shots 2"],
    beam: Section,
    spacing: float,
) -> Float[np.ndarray, "shots cells cells"]:
    """Energy that splines put elsewhere, within each cell or out of it."""
    x, y = (_points(first[:, k], coefficients.shape[1], spacing) - place[:, k, None] for k in range(2))
    asked = _irradiance(x, y, beam)
    basis = _basis(coefficients.shape[1])
    given = basis @ coefficients @ basis.T / spacing**2
    cells = asked.shape[1] // _FINE
    off = (given - asked).reshape(-1, cells, _FINE, cells, _FINE)
    # What a cell has too much or too little, and half of what is elsewhere within it: it counts twice there.
    net, whole = np.abs(off.sum(axis=(2, 4))), np.abs(off).sum(axis=(2, 4))
    return 0.5 * (net + whole) * (spacing / _FINE) ** 2


def _fitted(
    place: Float[np.ndarray, "shots 2"], beam: Section, spacing: float
) -> tuple[Int[np.ndarray, "shots 2"], Float[np.ndarray, "shots nodes nodes"]]:
    """First nodes and coefficients: of all splines those nearest to the irradiance, by least squares."""
    reach = beam.reach / -beam.axis[2]
    first = np.floor((place - reach) / spacing).astype(int) - 2
    nodes = int(np.ceil(2.0 * reach / spacing)) + 6
    inverse = np.linalg.pinv(_basis(nodes))
    found = np.empty((len(place), nodes, nodes), np.float32)
    for start in range(0, len(place), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        x, y = (_points(first[part, k], nodes, spacing) - place[part, k, None] for k in range(2))
        if beam.gaussian and not beam.leans:
            w = beam.radius
            along = [np.sqrt(2.0 / np.pi) / w * np.exp(-2.0 * (v / w) ** 2) @ inverse.T for v in (x, y)]
            fitted = along[0][:, :, None] * along[1][:, None, :]
        else:
            fitted = inverse @ _irradiance(x, y, beam) @ inverse.T
        found[part] = fitted * spacing**2
    found /= found.sum(axis=(1, 2), keepdims=True)
    return first, found


def _points(
    first: Int[np.ndarray, " shots"], nodes: int, spacing: float
) -> Float[np.ndarray, "shots points"]:
    """Places along an axis, m: `_FINE` in each cell between the nodes of a patch."""
    within = (np.arange((nodes - 1) * _FINE) + 0.5) / _FINE
    return (first[:, None] + within) * spacing


def _basis(nodes: int) -> Float[np.ndarray, "points nodes"]:
    """The spline of every node at the points of a patch."""
    within = (np.arange((nodes - 1) * _FINE) + 0.5) / _FINE
    return cubic_bspline(within[:, None] - np.arange(nodes))


def _irradiance(
    x: Float[np.ndarray, "shots points"], y: Float[np.ndarray, "shots points"], beam: Section
) -> Float[np.ndarray, "shots points points"]:
    """Share of the energy per m2 of the reference plane, at places relative to the axis."""
    x, y = x[:, :, None], y[:, None, :]
    w2, steep = beam.radius**2, -beam.axis[2]
    r2 = (x**2 + y**2 - (x * beam.axis[0] + y * beam.axis[1]) ** 2) / w2
    if beam.gaussian:
        return 2.0 * steep / (np.pi * w2) * np.exp(-2.0 * r2)
    # A cell at the rim is lit in part.
    soft = beam.radius / np.diff(x[0, :2, 0])[0]
    return np.clip(0.5 + (1.0 - np.sqrt(r2)) * soft, 0.0, 1.0) * (steep / (np.pi * w2))
