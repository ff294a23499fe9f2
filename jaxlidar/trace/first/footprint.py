"""The cross-section of the beam as a set of rays, and the geometry between rays and sensor.

Positions are relative to the aim point, where the beam axis a meets the reference plane, and path lengths to
the slant range R of that point: no number grows with the altitude, so that single precision is enough at 400
km. The distance of a point x from the sensor at -R a is |x + R a| = R + excess(x), computed without
cancellation as

    excess = q / (1 + sqrt(1 + q / R)),   q = 2 x.a + |x|^2 / R.

A lidar that is placed by its sensor (`Lidar(sensor=...)`) has its aim point R = 1 m ahead of that. Path
lengths are then those from the sensor itself: "excess" is all of |x + R a|, which single precision resolves
to 6e-5 m at 1 km.

The circle of radius r encloses the fraction 1 - exp(-2 r^2 / w0^2) of the energy of a Gaussian beam with the
radius w0 (at 1/e^2), and r^2 / w0^2 of that of a top-hat. Rays lie on a Fibonacci disc (Vogel's spiral):
enclosed fractions in equal steps, so that rays carry equal energies, and directions that turn by the golden
angle. For smooth integrands, a product rule of unequal weights is more accurate (`product_rule`).
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlidar._vectors import FAR, Scalar, Vec, add, cross, dot, from_frame, normalise, scale, to_frame, vec
from jaxlidar.sensors.field_of_view import visible_fraction
from jaxlidar.sensors.lidar import Lidar

GOLDEN = (np.sqrt(5.0) - 1) / 2
# Points nearer to the sensor than this, m, count as so far away.
_LEAST_DISTANCE = 1e-6
# Half of the angle, rad, that the sun subtends.
SOLAR_HALF_ANGLE = 4.65e-3


class Beam(eqx.Module):
    """Axis, slant range and receiver of a lidar, as the tracer needs them.

    - `axis`: direction of the beam. `slant_range`: from the sensor to the aim point, m.
    - `radius`: of the footprint at 1/e^2 or of the top-hat, m across the beam at the aim point; the longer
      one of an ellipse.
    - `half_angle`: that the aperture subtends at the aim point, rad.
    - `view_radius`: of the field of view at the aim point, m across the beam; None where everything is seen.
    - `from_sensor`: True if path lengths count from the sensor, and not from the aim point.
    - `gaussian`: True for a Gaussian profile. `parallel`: True if all rays are parallel to the axis, as for
      light that shots share; the receiver then sees all of the scene.
    - `return_direction`: unit vector towards the receiver of parallel light where that is not back along the
      axis; else None. `rectangle`: corner and size, m, of the area of the reference plane over which parallel
      light enters evenly; None for a disc.
    - `ellipse`: unit vector of an axis of an elliptical footprint in the frame of the beam axis, as x and y,
      and the semi-axes along it and across it over the radius; None for a round one.
    """

    axis: Vec
    slant_range: Float[Array, ""]
    radius: Float[Array, ""]
    half_angle: Float[Array, ""]
    view_radius: Float[Array, ""] | None
    gaussian: bool = eqx.field(static=True)
    parallel: bool = eqx.field(static=True, default=False)
    from_sensor: bool = eqx.field(static=True, default=False)
    return_direction: Vec | None = None
    rectangle: tuple[Float[Array, "2"], Float[Array, "2"]] | None = None
    ellipse: tuple[Scalar, Scalar, Scalar, Scalar] | None = None

    @property
    def range_at_time_zero(self) -> Scalar:
        """Distance from the sensor, m, from which path lengths count: the slant range, or zero."""
        return jnp.zeros_like(self.slant_range) if self.from_sensor else self.slant_range

    def _offset(self, point: Vec) -> Vec:
        """Vector from the sensor to `point`, m."""
        return add(scale(self.axis, self.slant_range), point)

    def ray(self, across: tuple[Scalar, Scalar]) -> tuple[Vec, Vec, Scalar]:
        """Point, direction and relative distance from the sensor of the ray through `across` (m).

        `across` are coordinates in the plane through the aim point perpendicular to the axis; of parallel
        light, horizontal ones.
        """
        if self.parallel:
            point = (*across, jnp.zeros_like(across[0]))
            return point, vec(jnp.broadcast_to(c, across[0].shape) for c in self.axis), self.excess(point)
        point = from_frame(self.axis, (across[0], across[1], jnp.zeros_like(across[0])))
        direction = normalise(add(scale(self.axis, self.slant_range), point))
        return point, direction, self.excess(point)

    def excess(self, point: Vec) -> Scalar:
        """Distance from the sensor minus the range at time zero, m, computed without cancellation."""
        if self.from_sensor:
            offset = self._offset(point)
            # The floor keeps the derivative of the root finite at the sensor itself.
            return jnp.sqrt(jnp.maximum(dot(offset, offset), _LEAST_DISTANCE**2))
        if self.parallel:
            # A beam's wave front is curved: its light arrives later by w0^2 / (4 R) in the mean over the
            # footprint.
            return dot(point, self.axis) + 0.25 * self.radius**2 / self.slant_range
        r = self.slant_range
        # |x + R a|^2 = R^2 (1 + q / R): the leading R is taken out before the root.
        q = 2.0 * dot(point, self.axis) + dot(point, point) / r
        return q / (1.0 + jnp.sqrt(jnp.maximum(1.0 + q / r, 1e-12)))

    def view(self, point: Vec) -> Vec:
        """Unit vector from `point` to the sensor; zero at a sensor within the scene."""
        if self.return_direction is not None:
            return vec(jnp.broadcast_to(c, point[0].shape) for c in self.return_direction)
        if self.parallel:
            return vec(jnp.broadcast_to(-c, point[0].shape) for c in self.axis)
        to_sensor = scale(self._offset(point), jnp.asarray(-1.0))
        # Photons that meet nothing may stay where they start. `excess` has a floor.
        return scale(to_sensor, 1.0 / self.excess(point)) if self.from_sensor else normalise(to_sensor)

    def longest_flight(self, x: Vec, w: Vec, max_path: Scalar) -> Scalar:
        """Return how far, m, light may fly from `x` along `w` so that it can be back within `max_path` m.

        `max_path` is the length of flight and return path, less the slant range. The points from which light
        returns in time form an ellipsoid with foci `x` and the sensor; the flight may reach its surface.
        """
        r, zero, out = self.slant_range, self.range_at_time_zero, self.excess(x)
        if self.parallel:
            # The divisor is near zero only for light that flies back to the sensor, which may fly on.
            flight = (max_path - out) / jnp.maximum(1.0 + dot(self.axis, w), 1e-9)
            return jnp.where(max_path < out, 0.0, jnp.minimum(flight, FAR))
        # An ellipse in polar form about the focus `x`; where the divisor is not positive, the flight never
        # leaves it.
        divisor = r * (1.0 + dot(self.axis, w)) + max_path + dot(x, w)
        if self.from_sensor:
            divisor = divisor - r
        flight = 0.5 * (max_path - out) * (2.0 * zero + max_path + out) / jnp.where(divisor > 0, divisor, 1.0)
        return jnp.where(max_path < out, 0.0, jnp.where(divisor > 0, jnp.minimum(flight, FAR), FAR))

    def in_view(self, point: Vec) -> Scalar:
        """Fraction of the light from `point` that the receiver sees; the field of view has a soft edge."""
        if self.from_sensor:
            return self._in_view_of_aperture(point)
        if self.view_radius is None:
            return jnp.ones_like(point[0])
        beyond_aim = dot(point, self.axis)
        off_axis2 = dot(point, point) - beyond_aim * beyond_aim
        # The field widens with distance from the sensor.
        edge = self.view_radius * (1.0 + beyond_aim / self.slant_range)
        # The floor keeps the derivative of the root finite on the axis.
        off_axis = jnp.sqrt(jnp.maximum(off_axis2, 1e-12 * edge * edge))
        return visible_fraction(off_axis / edge)

    def _in_view_of_aperture(self, point: Vec) -> Scalar:
        """Fraction of the light from `point` that a flat aperture at the sensor sees: none from behind it.

        A flat aperture presents its area times the cosine of the angle from the axis. Within the few mrad of
        a beam that is 1; multiple scattering comes from all directions. It is zero at right angles, so that
        nothing jumps where a point passes behind the sensor.
        """
        ahead, distance = dot(self._offset(point), self.axis), self.excess(point)
        cosine = jnp.maximum(ahead, 0.0) / distance
        if self.view_radius is None:
            return cosine
        ahead = jnp.maximum(ahead, _LEAST_DISTANCE)
        off_axis = jnp.sqrt(jnp.maximum(distance * distance - ahead * ahead, 1e-12 * ahead * ahead))
        return cosine * visible_fraction(off_axis / ahead / (self.view_radius / self.slant_range))

    def distance_to_sensor(self, point: Vec) -> Scalar | None:
        """Distance, m, at which return paths from `point` end; None for a sensor above all of the scene."""
        return self.excess(point) if self.from_sensor else None

    def aperture_half_angle(self, point: Vec) -> Scalar:
        """Half-angle, rad, of the aperture as seen from `point`; from far above, that at the aim point."""
        if not self.from_sensor:
            return self.half_angle
        radius = self.half_angle * self.slant_range
        return jnp.arctan2(radius, self.excess(point))

    def range_factor(self, path: Scalar, out: Scalar) -> Scalar:
        """Squared ratio of the range for which light is recorded to that from which it came.

        Apparent reflectance refers to the range that the time of arrival stands for: light of a long path is
        recorded at a longer range than that from which it came. `path` is the length flown, `out` the excess
        of the last scattering. Near the sensor no more light enters the aperture than all of it.
        """
        recorded, distance = self.range_at_time_zero + 0.5 * (path + out), self.range_at_time_zero + out
        if self.from_sensor:
            distance = jnp.maximum(distance, self.half_angle * self.slant_range)
        return (recorded / distance) ** 2

    def irradiance(self, across: tuple[Scalar, Scalar]) -> Scalar:
        """Fraction of the pulse's energy per m2 across the beam, at x and y across it, m."""
        radius2 = jnp.maximum(self.radius, 1e-6) ** 2
        if self.ellipse is None:
            r2 = across[0] ** 2 + across[1] ** 2
        else:
            x, y, a, b = self.ellipse
            along, aside = across[0] * x + across[1] * y, across[1] * x - across[0] * y
            r2, radius2 = ((along / a) ** 2 + (aside / b) ** 2) * (a * b), radius2 * (a * b)
        if self.gaussian:
            return 2.0 / (np.pi * radius2) * jnp.exp(-jnp.minimum(2.0 * r2 / radius2, 80.0))
        return jnp.where(r2 <= radius2, 1.0 / (np.pi * radius2), 0.0)


def make_beam(lidar: Lidar) -> Beam:
    """Make the beam of a lidar."""
    slant, axis, ellipse = lidar.range_to_reference, vec(lidar.direction), None
    if lidar.ellipse is not None:
        assert lidar.ellipse_turn is not None
        # Unless the ellipse is turned, its level axis is (cos, -sin, 0) of the azimuth.
        azimuth, turn = jnp.deg2rad(lidar.azimuth), jnp.deg2rad(lidar.ellipse_turn)
        level = vec([jnp.cos(azimuth), -jnp.sin(azimuth), jnp.zeros_like(azimuth)])
        turned = add(scale(level, jnp.cos(turn)), scale(cross(axis, level), jnp.sin(turn)))
        x, y, _ = to_frame(axis, turned)
        in_plane, level = lidar.ellipse
        ellipse = (x, y, level, in_plane)
    return Beam(
        axis,
        slant,
        lidar.footprint_radius,
        lidar.aperture_half_angle,
        lidar.view_radius,
        lidar.profile == "gaussian",
        from_sensor=lidar.has_sensor_position,
        ellipse=ellipse,
    )


def parallel_beam(lidar: Lidar) -> Beam:
    """Make a beam of parallel light in the lidar's direction, for a receiver that sees everything."""
    beam = make_beam(lidar)
    return dataclasses.replace(beam, view_radius=None, gaussian=False, parallel=True, ellipse=None)


def bistatic_beam(
    lidar: Lidar, direction: Vec | None, corner: Float[Array, "2"], size: Float[Array, "2"]
) -> Beam:
    """Make a beam of parallel light over a rectangle of the reference plane.

    Light returns towards `direction`, or along the axis where that is None, to a receiver that is so far away
    that ranges do not matter.
    """
    beam = parallel_beam(lidar)
    # Far enough for single precision to see no difference, also in squares of path lengths over the range.
    far = jnp.full_like(beam.slant_range, 1e9)
    return dataclasses.replace(
        beam,
        slant_range=far,
        radius=jnp.zeros_like(far),
        half_angle=jnp.full_like(far, SOLAR_HALF_ANGLE),
        return_direction=direction,
        rectangle=(corner, size),
    )


def from_polar(radius: Scalar, turn: Scalar) -> tuple[Scalar, Scalar]:
    """Return x and y of the point at `radius` in the direction `turn`, in whole turns."""
    return radius * jnp.cos(2 * np.pi * turn), radius * jnp.sin(2 * np.pi * turn)


def _stretched(beam: Beam, point: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
    """Return a point of a round footprint, moved to where it lies in an elliptical one."""
    if beam.ellipse is None:
        return point
    x, y, a, b = beam.ellipse
    along, aside = a * point[0], b * point[1]
    return x * along - y * aside, y * along + x * aside


def across_beam(beam: Beam, energy_fraction: Scalar, turn: Scalar) -> tuple[Scalar, Scalar]:
    """Return the point across the beam, m, whose circle encloses `energy_fraction`, or of a rectangle."""
    if beam.rectangle is not None:
        # Steps in one coordinate and turns by the golden section in the other: a lattice of rank one.
        corner, size = beam.rectangle
        return corner[0] + size[0] * energy_fraction, corner[1] + size[1] * (turn - jnp.floor(turn))
    # All of a Gaussian beam's energy is within an infinite circle.
    enclosed = jnp.clip(energy_fraction, 0.0, 1.0 - 1e-7)
    radius = beam.radius * jnp.sqrt(-0.5 * jnp.log1p(-enclosed) if beam.gaussian else enclosed)
    return _stretched(beam, from_polar(radius, turn))


class RaySlice(NamedTuple):
    """A slice of a footprint's rays: number `number`, from 0, of `count` slices of one size."""

    number: Int[Array, ""] | int = 0
    count: Int[Array, ""] | int = 1


ALL_RAYS = RaySlice()


def fibonacci_disc(
    beam: Beam, count: int, shift: Float[Array, "2"], ray_slice: RaySlice = ALL_RAYS
) -> tuple[tuple[Scalar, Scalar], Float[Array, "rays"]]:
    """Return a Fibonacci disc of rays of equal energy; `shift` in [0, 1) moves it along both coordinates.

    The disc has `count` rays in each of its slices. Those of `ray_slice` carry all energy, so that the mean
    over slices is the result of the whole disc.

    **Returns:** x and y across the beam, m, and fractions of the energy.
    """
    before = jnp.asarray(ray_slice.number * count)
    number = (before + jnp.arange(count, dtype=before.dtype)).astype(shift.dtype)
    u = (number + shift[0]) / jnp.asarray(count * ray_slice.count, shift.dtype)
    # The golden angle in units of 2^-32 turns: integers overflow as turns do, and lose no digits where there
    # are many rays.
    turned = (before.astype(jnp.uint32) * np.uint32(round(GOLDEN * 2**32))).astype(u.dtype) * 2.0**-32
    turn = jnp.asarray((np.arange(count) * GOLDEN) % 1.0, u.dtype) + turned + shift[1]
    return across_beam(beam, u, turn), jnp.full((count,), 1.0 / count, u.dtype)


class FootprintStrips(NamedTuple):
    """Strips of a Gaussian footprint between lines across each axis, from its low end on.

    `rays`, `energy`: fractions of all rays, and of the energy, before the strip begins. `stretch`: its energy
    over its rays. `weight`: of each of its rays, which is one in all strips where rays are not spread.
    """

    rays: Float[Array, "axes strips"]
    energy: Float[Array, "axes strips"]
    stretch: Float[Array, "axes strips"]
    weight: Float[Array, "axes strips"]


def spread_over_strips(
    beam: Beam, across: tuple[Scalar, Scalar], energy: Scalar, strips: FootprintStrips
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Move rays of equal energies so that every strip gets its fraction of them, and weight them.

    Along each axis the energy is normally distributed. The quantile at the fraction t of the rays, which is
    that of the energy before, moves to the quantile at a fraction of the energy that is linear in t within
    each strip.
    """
    width, moved = np.sqrt(0.5) * beam.radius, []
    for x, *of_axis in zip(across, *strips):
        t, fraction, weight = 0.5 + 0.5 * jax.lax.erf(x / width), jnp.zeros_like(x), jnp.ones_like(x)
        for rays, start, stretch, strip_weight in zip(*of_axis):
            is_beyond = t >= rays
            fraction = jnp.where(is_beyond, start + (t - rays) * stretch, fraction)
            weight = jnp.where(is_beyond, strip_weight, weight)
        # As far out as rays lie before.
        quantile = width * jax.lax.erf_inv(jnp.clip(2.0 * fraction - 1.0, -1.0 + 2e-7, 1.0 - 2e-7))
        # Of an axis without spread rays, they stay to the last digit.
        moved.append(jnp.where(jnp.all(of_axis[3] == 1.0), x, quantile))
        energy = energy * weight
    return (moved[0], moved[1]), energy


def interleaving_shifts(shift: Float[Array, "2"], count: int) -> Float[Array, "lattices 2"]:
    """Return shifts of `count` Fibonacci discs that make up one disc of `count` times as many rays.

    Ray k of each, k = 0, 1, ..., becomes number count k + j of the dense disc, which turns from ray to ray by
    the angle a with count a = golden angle, in whole turns and a fraction. It is the angle
    among those that fulfil this whose multiples stay farthest from whole turns. If `shift` is uniform in
    [0, 1), so is every shift: each disc is an unbiased estimate on its own, and their scatter an upper bound
    of the variance of their mean, which lacks the gaps that discs shifted independently would leave (see
    `jaxlidar.survey.per_shot`).
    """
    angles = (GOLDEN + np.arange(count)) / count
    multiples = np.arange(1, 8 * count)
    distance = np.abs((m := np.outer(angles, multiples)) - np.round(m))
    angle = angles[np.argmax(np.min(multiples * distance, axis=1))]
    number = jnp.arange(count, dtype=shift.dtype)
    radial = shift[0] + number / count
    # A disc that is shifted by a whole ray continues with its next one, which has turned by the golden angle.
    n_rays = jnp.floor(radial)
    turn = shift[1] + number * angle - n_rays * GOLDEN
    return jnp.stack([radial - n_rays, turn - jnp.floor(turn)], axis=1)


def product_rule(
    beam: Beam, radial: int = 12, angular: int = 32
) -> tuple[tuple[Scalar, Scalar], Float[Array, "rays"]]:
    """Return a Gauss rule in radius times equal steps in azimuth: spectrally accurate for smooth integrands.

    It is Gauss-Laguerre in 2 r^2 / w0^2 for the Gaussian beam, and Gauss-Legendre in r^2 for the top-hat. At
    the edge of a field of view the integrand is not smooth: there, panels of a Gauss-Legendre rule in r end
    at the edge. Plans do not use it where the footprint is an ellipse, which meets that edge at many r.

    **Returns:** as `fibonacci_disc`.
    """
    if beam.view_radius is not None:
        r, weight = _rule_with_edge(beam, beam.view_radius)
    elif beam.gaussian:
        x, weight = np.polynomial.laguerre.laggauss(radial)
        r, weight = beam.radius * jnp.sqrt(jnp.asarray(x / 2)), jnp.asarray(weight)
    else:
        # The fraction of energy is r^2 / w0^2, from 0 to 1.
        x, weight = np.polynomial.legendre.leggauss(radial)
        r, weight = beam.radius * jnp.sqrt(jnp.asarray((x + 1) / 2)), jnp.asarray(weight / 2)
    a = 2 * np.pi * (np.arange(angular) + 0.5) / angular
    x, y = (jnp.outer(r, jnp.asarray(f(a))).reshape(-1) for f in (np.cos, np.sin))
    return _stretched(beam, (x, y)), jnp.repeat(weight / angular, angular)


def _rule_with_edge(
    beam: Beam, edge: Float[Array, ""], order: int = 16
) -> tuple[Float[Array, "radii"], Float[Array, "radii"]]:
    """Return radii and energy fractions: Gauss-Legendre panels that resolve a soft edge of 2 %.

    Panels end at 0.8, 1 and 1.2 times the radius of the edge, and at the end of the beam.
    """
    # In units of the beam's radius; beyond four of them a Gaussian beam has 1e-14 of its energy.
    end = jnp.asarray(4.0 if beam.gaussian else 1.0, edge.dtype)
    edge_in_radii = edge / jnp.maximum(beam.radius, 1e-9)
    ends = jnp.stack([0.0 * end, *(jnp.minimum(f * edge_in_radii, end) for f in (0.8, 1.0, 1.2)), end])
    node, weight = (jnp.asarray(v, edge.dtype)[None, :] for v in np.polynomial.legendre.leggauss(order))
    half = 0.5 * jnp.diff(ends)[:, None]
    r = (ends[:-1, None] + half * (1.0 + node)).reshape(-1)
    density = 4.0 * r * jnp.exp(-2.0 * r * r) if beam.gaussian else 2.0 * r
    return beam.radius * r, (half * weight).reshape(-1) * density
