"""The irradiance of footprints as cubic B-splines on a grid that all footprints share.

The irradiance I_f(a) of footprint f at the position a of the reference plane (1/m2, integral one) is fitted
by

    I_f(a) ~ 1 / d^2  sum over nodes n of  c_fn B(a_x / d - n_x) B(a_y / d - n_y)

with the cubic B-spline B of integral one and the grid's spacing d, so that the coefficients of a footprint
add up to its energy, 1. They minimise the squared error at _FINE^2 points of each cell between nodes. Since B
is separable, the coefficients are d^2 P I P^T with the pseudoinverse P of the matrix of B at the points,
scaled so that they add up to one.

The error of the grid is the energy that the spline puts at the wrong place. A cell has a net surplus or
deficit, and energy that is moved within it. What is moved is missing at one point and in excess at another,
so that half of it counts:

    m_f,cell = |sum of e| + 1/2 (sum of |e| - |sum of e|),    e = (spline - irradiance) x area of a point
             = 1/2 (|sum of e| + sum of |e|)

If places one cell apart return independent waveforms, which vary by as much as their mean, the relative error
of f's waveform is the root of the sum of m_f,cell^2 over cells. The grid is the coarsest one that keeps this
below a tolerance.

This is an estimate of the worst case, not a standard deviation. Crowns and ground are wider than a cell:
neighbouring cells return nearly the same, surplus and deficit cancel, and the error is smaller, the more so
the less returns vary. It is larger only where a few cells return nearly all light. Returns of single nodes do
not tell by how much: they are means over four spacings, and the error is what the grid does not resolve of
the scene.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar.sensors.survey import Survey
from jaxlidar.trace.photons.entry_nodes import cubic_bspline

# Radius within which a Gaussian beam is followed, over its 1/e^2 radius; 4e-6 of its energy lies beyond.
GAUSSIAN_EXTENT = 2.5
# Points along each side of a cell at which irradiances are evaluated.
_FINE = 4
# Candidates of the grid's spacing over the beam's radius, the coarsest first.
_SPACINGS = (0.5, 0.35, 0.25, 0.18, 0.125, 0.09, 0.0625, 0.045, 0.03)
# Footprints that are evaluated together.
_BLOCK = 128


class BeamSection(NamedTuple):
    """The cross-section of a beam.

    - `radius`: m across the beam, at 1/e^2 of a Gaussian, or of the edge of a top hat.
    - `gaussian`: True for a Gaussian, False for a top hat. - `axis`: unit vector along which light travels.
    """

    radius: float
    gaussian: bool
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0)

    @property
    def extent(self) -> float:
        """Radius within which the beam is followed, m across it."""
        return self.radius * (GAUSSIAN_EXTENT if self.gaussian else 1.0)

    @property
    def is_oblique(self) -> bool:
        """True unless the beam points straight down."""
        return self.axis[2] != -1.0


def section_of(survey: Survey) -> BeamSection:
    """Return the cross-section of the beams of a survey whose shots have one direction."""
    x, y, z = (float(a) for a in survey.direction[0])
    return BeamSection(float(survey.footprint_radius[0]), survey.lidar.profile == "gaussian", (x, y, z))


class FootprintSplines(NamedTuple):
    """Coefficients of footprints at the nodes of a grid; those of a footprint add up to 1.

    - `first_node`: (shots, 2) numbers along x and y of the first node of each; node 0 is at x = y = 0.
    - `coefficients`: (shots, nodes, nodes), along x and y.
    - `misplaced_energy`: (shots, nodes, nodes) energy that the spline puts at the wrong place, by node.
    - `spacing`: of the grid, m.
    """

    first_node: Int[np.ndarray, "shots 2"]
    coefficients: Float[np.ndarray, "shots nodes nodes"]
    misplaced_energy: Float[np.ndarray, "shots nodes nodes"]
    spacing: float

    @property
    def error(self) -> float:
        """Relative error that the grid causes in the worst footprint."""
        return float(np.sqrt((self.misplaced_energy**2).sum(axis=(1, 2)).max()))


def fit_footprints(survey: Survey, tolerance: float) -> FootprintSplines:
    """Fit footprints of one direction on the coarsest grid whose error is at most `tolerance`.

    Where none is that good, the finest grid is taken: see `FootprintSplines.error`.
    """
    # Footprints of one direction differ in their position relative to the grid alone: some eight tell the
    # error.
    beam, sample = section_of(survey), survey.position[:: max(len(survey) // 8, 1)]
    spacing = beam.radius
    # Where no candidate meets the tolerance, the finest one is used: the caller judges its error.
    for candidate in _SPACINGS:
        spacing = beam.radius * candidate
        if max(spline_error(position, beam, spacing) for position in sample) <= tolerance:
            break
    first_node, coefficients = _fit(survey.position, beam, spacing)
    by_node = np.empty_like(coefficients)
    for start in range(0, len(first_node), _BLOCK):
        block = slice(start, start + _BLOCK)
        by_cell = _misplaced_by_cell(
            first_node[block], coefficients[block], survey.position[block], beam, spacing
        )
        # Each cell counts a quarter in each of its nodes, by its square: the sum of squares stays.
        squares = np.pad(by_cell**2, ((0, 0), (1, 1), (1, 1)))
        squares = squares[:, :-1, :-1] + squares[:, 1:, :-1] + squares[:, :-1, 1:] + squares[:, 1:, 1:]
        by_node[block] = 0.5 * np.sqrt(squares)
    return FootprintSplines(first_node, coefficients, by_node, spacing)


def spline_error(position: Float[np.ndarray, "2"], beam: BeamSection, spacing: float) -> float:
    """Return the relative error that the grid causes in a footprint, by the squared energies of all cells."""
    first_node, coefficients = _fit(position[None], beam, spacing)
    by_cell = _misplaced_by_cell(first_node, coefficients, position[None], beam, spacing)
    return float(np.sqrt(np.sum(by_cell**2)))


def _misplaced_by_cell(
    first_node: Int[np.ndarray, "shots 2"],
    coefficients: Float[np.ndarray, "shots nodes nodes"],
    position: Float[np.ndarray, "shots 2"],
    beam: BeamSection,
    spacing: float,
) -> Float[np.ndarray, "shots cells cells"]:
    """Return the energy that splines misplace, m_f,cell of the module's docstring."""
    nodes = coefficients.shape[1]
    x, y = (_points(first_node[:, k], nodes, spacing) - position[:, k, None] for k in range(2))
    irradiance = _irradiance(x, y, beam)
    basis = _basis(nodes)
    fitted = basis @ coefficients @ basis.T / spacing**2
    cells = irradiance.shape[1] // _FINE
    # Points lie between nodes, so that their blocks of _FINE x _FINE are the cells.
    error = (fitted - irradiance).reshape(-1, cells, _FINE, cells, _FINE)
    net, absolute = np.abs(error.sum(axis=(2, 4))), np.abs(error).sum(axis=(2, 4))
    return 0.5 * (net + absolute) * (spacing / _FINE) ** 2


def _fit(
    position: Float[np.ndarray, "shots 2"], beam: BeamSection, spacing: float
) -> tuple[Int[np.ndarray, "shots 2"], Float[np.ndarray, "shots nodes nodes"]]:
    """Return the first nodes and the least-squares coefficients of footprints, d^2 P I P^T of the module.

    1. The patch of nodes around each footprint, which is of one shape.
    2. The irradiance I at the patch's points; of a round Gaussian, its factors along x and y.
    3. The product with the pseudoinverse P, scaled to the sum one.
    """
    extent = beam.extent / -beam.axis[2]
    # Splines are four spacings wide: two nodes more on the low side and, with rounding, on the high side.
    first_node = np.floor((position - extent) / spacing).astype(int) - 2
    nodes = int(np.ceil(2.0 * extent / spacing)) + 6
    inverse = np.linalg.pinv(_basis(nodes))
    # In single precision: millions of footprints have some hundred coefficients each.
    coefficients = np.empty((len(position), nodes, nodes), np.float32)
    for start in range(0, len(position), _BLOCK):
        block = slice(start, start + _BLOCK)
        x, y = (_points(first_node[block, k], nodes, spacing) - position[block, k, None] for k in range(2))
        if beam.gaussian and not beam.is_oblique:
            # A round Gaussian is a product of functions of x and of y: two fits in one dimension.
            w = beam.radius
            along_x, along_y = (
                np.sqrt(2.0 / np.pi) / w * np.exp(-2.0 * (v / w) ** 2) @ inverse.T for v in (x, y)
            )
            fitted = along_x[:, :, None] * along_y[:, None, :]
        else:
            fitted = inverse @ _irradiance(x, y, beam) @ inverse.T
        coefficients[block] = fitted * spacing**2
    # Least squares keep the energy only nearly.
    coefficients /= coefficients.sum(axis=(1, 2), keepdims=True)
    return first_node, coefficients


def _points(
    first_node: Int[np.ndarray, " shots"], nodes: int, spacing: float
) -> Float[np.ndarray, "shots points"]:
    """Return positions along an axis, m: `_FINE` in each cell between the nodes of a footprint."""
    return (first_node[:, None] + _points_in_spacings(nodes)) * spacing


def _basis(nodes: int) -> Float[np.ndarray, "points nodes"]:
    """Return the spline of every node at the points of a footprint."""
    return cubic_bspline(_points_in_spacings(nodes)[:, None] - np.arange(nodes))


def _points_in_spacings(nodes: int) -> Float[np.ndarray, " points"]:
    """Return the points along an axis, in spacings from the first node."""
    return (np.arange((nodes - 1) * _FINE) + 0.5) / _FINE


def _irradiance(
    x: Float[np.ndarray, "shots points"], y: Float[np.ndarray, "shots points"], beam: BeamSection
) -> Float[np.ndarray, "shots points points"]:
    """Return the irradiance on the reference plane, 1/m2, at positions relative to the beam's axis, m."""
    x, y = x[:, :, None], y[:, None, :]
    w2, cosine = beam.radius**2, -beam.axis[2]
    # Squared distance from the axis, across the beam, over the squared radius. An oblique beam lights an area
    # of the plane that is larger by 1 / cosine: hence the cosine in the irradiance.
    r2 = (x**2 + y**2 - (x * beam.axis[0] + y * beam.axis[1]) ** 2) / w2
    if beam.gaussian:
        return 2.0 * cosine / (np.pi * w2) * np.exp(-2.0 * r2)
    # The rim of a top hat is a ramp as wide as the distance between points: areas at the rim are lit in part.
    points_per_radius = beam.radius / np.diff(x[0, :2, 0])[0]
    lit_fraction = np.clip(0.5 + (1.0 - np.sqrt(r2)) * points_per_radius, 0.0, 1.0)
    return lit_fraction * (cosine / (np.pi * w2))
