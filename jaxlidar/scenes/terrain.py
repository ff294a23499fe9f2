"""Terrain: a ground of measured or modelled heights.

Heights h_ij are given at the nodes of a regular grid and are bilinear in between (`jaxlidar.scenes.raster`);
rays are intersected with them as `jaxlidar.scenes.height_field` describes. Without relief the ground is the
plane of best fit, which minimises the sum of (h_ij - mean - e X_i - n Y_j)^2. With X and Y measured from the
middle of the grid, where their means are zero, the normal equations are diagonal:

    mean = <h>,   e = <h X> / <X^2>,   n = <h Y> / <Y^2>.

A periodic terrain has e = n = 0.
"""

import dataclasses
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import (
    as_array,
    as_numpy,
    check_choice,
    check_flag,
    check_kind,
    check_numbers,
    check_range,
    check_shape,
    concrete,
    concrete_array,
    coordinates,
)
from jaxlidar._fields.crs import crs_name
from jaxlidar._fields.ranges import FRACTION, POSITIVE, check_ranges, quantity
from jaxlidar._vectors import normalise
from jaxlidar.optics.laws import AbstractLaw, AbstractMirror, Lambertian
from jaxlidar.optics.spectra import Spectrum
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.scenes.raster import Raster
from jaxlidar.scenes.shapes import AbstractShape, Plane
from jaxlidar.scenes.surfaces import AbstractGround, Ground, Reflectance, as_reflectance, check_reflectance

# Heights are taken as a plane if they deviate from it by less than this fraction of the spacing, plus this
# fraction of the largest height for rounding.
_PLANE_TOLERANCE = 1e-5
_ROUNDING = 4 * float(np.finfo(np.float32).eps)


def _as_pair(x: Any, field: str = "spacing") -> Float[Array, "2"]:
    """Convert a field that is two numbers, or one number for both."""
    a = as_array(x, field)
    check_shape(field, a, (), (2,))
    return jnp.broadcast_to(a, (2,))


@final
class Terrain(AbstractGround):
    """Terrain: an opaque ground whose height is given at the nodes of a grid, and bilinear in between.

    It takes the place of `Ground` in a `Scene`. Light that one slope scatters can meet another slope, and
    slopes hide other slopes from the sensor. Heights that lie in a plane are traced as an infinite plane; for
    derivatives with respect to such heights, make the plan with effects={"relief": True}. In scattering of
    order two and above, derivatives with respect to heights leave out that slopes begin or cease to hide one
    another; cells are saddles, which may hide their own diagonals.

    **Arguments:**

    - `heights`: (nx, ny) heights of the nodes, m, x east along the first axis and y north along the second;
      at least 2 x 2.
    - `spacing`: (2,) distances between nodes along x and y, m, positive; or one number for both.
    - `origin`: (2,) position (x, y) of the south-west node, m. It is kept in double precision. Default (0,
      0).
    - `reflectance`: one number, one per wavelength, a `Spectrum`, or a raster: (nx, ny) values at the nodes,
      bilinear in between, for all wavelengths. In [0, 1]. Default 0.3.
    - `law`: the scattering law: `Lambertian()`, `EqualAngle()` or another `AbstractLaw`, but no mirror.
      Default `Lambertian()`.
    - `sides`: "open": there is no ground beyond the outermost nodes, and footprints must lie within them.
      "periodic": the terrain repeats without end, node nx being node 0 again; a canopy with periodic sides
      above it must have the same period. Default "open".
    - `relief`: False for the plane of best fit in place of the heights. Default True.
    - `crs`: coordinate reference system of the map, in metres, such as "EPSG:32633", or its EPSG number;
      `jaxlidar.io.read_dem` gives it. Default None: not known.

    **Raises:** ValueError for fewer nodes than 2 x 2, a spacing that is not positive, a reflectance outside
    [0, 1], a raster of another shape than the heights, values that are not finite, and a mirror; TypeError
    for an object of the wrong type.

    **Example:** the waveform of a ridge, met at its top.

    >>> import jax, jaxlidar as jl
    >>> ridge = jl.Terrain([[0.0, 0.0], [2.0, 2.0], [0.0, 0.0]], spacing=4.0, origin=(-4.0, -2.0))
    >>> float(ridge.height_at(1.0, 0.0))
    1.5
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=ridge), key=jax.random.key(0), max_orders=1)
    >>> print(f"{float(wave.reflectance.sum()):.3f}, of {0.3 * 2 / 5**0.5:.3f}")
    0.268, of 0.268
    """

    heights: Float[Array, "..."] = quantity(unit="m", converter=as_array)
    spacing: Float[Array, "2"] = quantity(unit="m", range=POSITIVE, converter=_as_pair)
    origin: Float[Array | np.ndarray, "2"] = quantity(unit="m", converter=coordinates(2), default=(0.0, 0.0))
    reflectance: Reflectance | Float[Array, "nx ny"] = quantity(
        range=FRACTION, converter=as_reflectance, default=0.3
    )
    law: AbstractLaw = Lambertian()
    sides: str = eqx.field(static=True, default="open")
    relief: bool = eqx.field(static=True, default=True)
    crs: str | None = eqx.field(static=True, converter=crs_name, default=None)

    def __check_init__(self):
        check_choice("sides", self.sides, ("open", "periodic"))
        check_flag("relief", self.relief)
        check_kind("law", self.law, AbstractLaw, "a law of reflection, such as Lambertian()")
        if isinstance(self.law, AbstractMirror):
            raise ValueError(
                "law is a mirror; admissible on terrain is another law (a Ground may be a mirror)"
            )
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise ValueError(
                f"heights has shape {self.heights.shape}; admissible is (nx, ny), each at least 2"
            )
        check_ranges(self)
        raster = self._reflectance_at_nodes
        if raster is None:
            check_reflectance("reflectance", self.reflectance)
        elif raster.shape != self.heights.shape:
            raise ValueError(
                f"reflectance has shape {raster.shape}; admissible is one number, one per "
                f"wavelength, a Spectrum, or one per node: {self.heights.shape}"
            )

    @property
    def _reflectance_at_nodes(self) -> Float[Array, "nx ny"] | None:
        """The reflectance if it is given by node, otherwise None."""
        reflectance = self.reflectance
        return None if isinstance(reflectance, Spectrum) or reflectance.ndim != 2 else reflectance

    def _raster(self, values: Float[Array, "nx ny"]) -> Raster:
        return Raster.of(values, self.spacing, jnp.asarray(self.origin, float), self.sides == "periodic")

    @property
    def name(self) -> str:
        return "ground"

    @property
    def shape(self) -> AbstractShape:
        return HeightField.of(self._raster(self.heights)) if self.relief else self._plane()

    @property
    def pattern(self) -> Raster | None:
        if (raster := self._reflectance_at_nodes) is None:
            return None
        largest = jnp.max(raster)
        return self._raster(raster / jnp.where(largest > 0, largest, 1.0))

    @property
    def brightest(self) -> Reflectance:
        raster = self._reflectance_at_nodes
        return self.reflectance if raster is None else jnp.max(raster)

    def moved(self, by: Float[np.ndarray, "2"]) -> "Terrain":
        origin, by = concrete(self.origin), as_numpy(by, "by")
        # The sum in double precision, if possible.
        origin = self.origin + jnp.asarray(by, float) if origin is None else jnp.asarray(origin + by, float)
        return eqx.tree_at(lambda s: s.origin, self, origin)

    @property
    def end(self) -> Float[np.ndarray, "2"]:
        """(2,) position of the north-east node, m; in a periodic terrain, of the repetition of node 0."""
        cells = np.asarray(self.heights.shape) - (self.sides == "open")
        return concrete_array(self.origin) + concrete_array(self.spacing) * cells

    def height_at(self, x: ArrayLike, y: ArrayLike) -> Float[Array, "..."]:
        """Interpolate the height of the terrain, or of its plane of best fit without relief.

        **Arguments:**

        - `x`, `y`: positions, m, of one shape. They are taken relative to the origin, in double precision
          where both are concrete.

        **Returns:** heights, m, shaped as `x` and `y`.

        **Raises:** ValueError for positions off a terrain with open sides, and for two shapes.
        """
        check_numbers("x", x)
        check_numbers("y", y)
        if np.ndim(x) and np.ndim(y):
            check_shape("y", y, np.shape(x))
        values, origin = [concrete(v) for v in (x, y)], concrete(self.origin)
        if origin is None or values[0] is None or values[1] is None:
            terrain, east, north = self, jnp.asarray(x), jnp.asarray(y)
        else:
            terrain = eqx.tree_at(lambda s: s.origin, self, jnp.zeros(2))
            east, north = (as_array(v - o) for v, o in zip(values, origin))
            if self.sides == "open" and self.relief:
                for axis, v, low, high in zip("xy", values, origin, self.end):
                    check_range(axis, v, low, high)
        return _height(terrain.shape, east, north)

    def is_plane(self) -> bool:
        """Return True if all heights lie in one plane, which must be level where the sides are periodic.

        **Raises:** ValueError where JAX is tracing the heights.
        """
        heights, spacing = concrete_array(self.heights), concrete_array(self.spacing)
        slope, mean = self._best_fit(heights, spacing)
        x, y = (d * n for d, n in zip(spacing, _nodes_from_middle(heights.shape)))
        deviation = np.abs(heights - mean - slope[0] * x[:, None] - slope[1] * y)
        tolerance = _PLANE_TOLERANCE * float(spacing.min()) + _ROUNDING * float(np.abs(heights).max())
        return bool(deviation.max() <= tolerance)

    def without_relief(self) -> "Ground | Terrain":
        """Make the plane of best fit: a `Ground`, unless heights are traced or the reflectance varies."""
        varies = self._reflectance_at_nodes is not None
        if varies or concrete(self.heights) is None or concrete(self.origin) is None:
            return dataclasses.replace(self, relief=False)
        heights, spacing = concrete_array(self.heights), concrete_array(self.spacing)
        (east, north), mean = self._best_fit(heights, spacing)
        x, y = concrete_array(self.origin) + 0.5 * spacing * (np.asarray(heights.shape) - 1.0)
        slope = np.rad2deg(np.arctan(np.hypot(east, north)))
        aspect = np.rad2deg(np.arctan2(-east, -north)) if slope > 0 else 0.0
        # The height at x = y = 0, which is near the beam once the scene has been moved to the local origin.
        return Ground(
            height=mean - east * x - north * y,
            reflectance=self.reflectance,
            slope=slope,
            aspect=aspect,
            law=self.law,
        )

    def _plane(self) -> Plane:
        (east, north), mean = self._best_fit(self.heights, self.spacing)
        half = 0.5 * (np.asarray(self.heights.shape) - 1.0)
        middle = jnp.asarray(self.origin, float) + self.spacing * half
        upward = normalise((-east, -north, jnp.ones_like(mean)))
        return Plane(jnp.stack(upward), (middle[0], middle[1], mean))

    def _best_fit(self, heights: Any, spacing: Any) -> tuple[tuple[Any, Any], Any]:
        """Fit a plane by least squares: its rise per m to the east and to the north, and its mean height."""
        mean = heights.mean()
        if self.sides == "periodic":
            return (0.0 * mean, 0.0 * mean), mean
        x, y = _nodes_from_middle(heights.shape)
        east = (heights * x[:, None]).mean() / (x * x).mean() / spacing[0]
        return (east, (heights * y[None, :]).mean() / (y * y).mean() / spacing[1]), mean


@eqx.filter_jit
def _height(shape: AbstractShape, x: Array, y: Array) -> Float[Array, "..."]:
    """Height of a terrain's shape, m, at positions relative to its origin, m."""
    if isinstance(shape, HeightField):
        return shape.heights.value((x, y))
    normal, offset = shape.tangent((x, y, jnp.zeros_like(x)))
    return (offset - normal[0] * x - normal[1] * y) / normal[2]


def _nodes_from_middle(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of nodes along x and y, in units of the spacing, from the middle."""
    nx, ny = shape
    return np.arange(nx) - 0.5 * (nx - 1), np.arange(ny) - 0.5 * (ny - 1)
