"""The cross-section of the beam as a set of rays, and the geometry between rays and sensor.

Positions are relative to where the beam axis meets the reference plane, and path lengths to the slant range
of that point: no number grows with the altitude, so single precision is enough at 400 km.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._vectors import FAR, Scalar, Vec, add, dot, from_frame, normalise, scale, vec
from jaxlidar.instrument.field_of_view import visible_fraction
from jaxlidar.instrument.lidar import Lidar

GOLDEN = (np.sqrt(5.0) - 1) / 2


class Beam(eqx.Module):
    """Axis, slant range and receiver of a lidar, as the tracer needs them.

    `parallel`: whether all rays are parallel to the axis, and the receiver is as far away as it is wide.
    """

    axis: Vec
    slant_range: Float[Array, ""]
    radius: Float[Array, ""]
    half_angle: Float[Array, ""]
    view_radius: Float[Array, ""] | None
    gaussian: bool = eqx.field(static=True)
    parallel: bool = eqx.field(static=True, default=False)

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
        """Distance from the sensor minus the slant range, m, computed without cancellation."""
        if self.parallel:
            # The front of a beam is curved: light of the footprint comes later by this in the mean.
            return dot(point, self.axis) + 0.25 * self.radius**2 / self.slant_range
        r = self.slant_range
        x = 2.0 * dot(point, self.axis) + dot(point, point) / r
        return x / (1.0 + jnp.sqrt(jnp.maximum(1.0 + x / r, 1e-12)))

    def view(self, point: Vec) -> Vec:
        """Unit vector from `point` to the sensor."""
        if self.parallel:
            return vec(jnp.broadcast_to(-c, point[0].shape) for c in self.axis)
        return normalise(add(scale(self.axis, -self.slant_range), scale(point, jnp.asarray(-1.0))))

    def budget(self, x: Vec, w: Vec, left: Scalar) -> Scalar:
        """How far, m, light may fly from `x` along `w` and be back at the sensor within `left` m.

        `left` is relative to the slant range. The way back begins on an ellipsoid about `x` and the sensor.
        """
        r, out = self.slant_range, self.excess(x)
        if self.parallel:
            # Near zero only for light that is on its way back, which may fly on.
            flight = (left - out) / jnp.maximum(1.0 + dot(self.axis, w), 1e-9)
            return jnp.where(left < out, 0.0, jnp.minimum(flight, FAR))
        divisor = r * (1.0 + dot(self.axis, w)) + left + dot(x, w)
        flight = 0.5 * (left - out) * (2.0 * r + left + out) / jnp.where(divisor > 0, divisor, 1.0)
        return jnp.where(left < out, 0.0, jnp.where(divisor > 0, jnp.minimum(flight, FAR), FAR))

    def in_view(self, point: Vec) -> Scalar:
        """Share of the light from `point` that the receiver sees, 0..1: its field of view has a soft edge."""
        if self.view_radius is None:
            return jnp.ones_like(point[0])
        along = dot(point, self.axis)
        off2 = dot(point, point) - along * along
        # The field widens with distance from the sensor.
        edge = self.view_radius * (1.0 + along / self.slant_range)
        off = jnp.sqrt(jnp.maximum(off2, 1e-12 * edge * edge))
        return visible_fraction(off / edge)

    def irradiance(self, across: tuple[Scalar, Scalar]) -> Scalar:
        """Share of the pulse's energy per m2 across the beam."""
        r2 = across[0] ** 2 + across[1] ** 2
        w2 = jnp.maximum(self.radius, 1e-6) ** 2
        if self.gaussian:
            return 2.0 / (np.pi * w2) * jnp.exp(-jnp.minimum(2.0 * r2 / w2, 80.0))
        return jnp.where(r2 <= w2, 1.0 / (np.pi * w2), 0.0)


def beam_of(lidar: Lidar) -> Beam:
    """The beam of a lidar."""
    slant = lidar.range_to_reference
    view = None if lidar.field_of_view is None else slant * lidar.field_of_view * 0.5e-3
    return Beam(
        vec(lidar.direction),
        slant,
        lidar.footprint_radius,
        lidar.aperture_half_angle,
        view,
        lidar.profile == "gaussian",
    )


def parallel_beam(lidar: Lidar) -> Beam:
    """Parallel light from where the lidar is. Rays may be anywhere across it; all of the scene is seen."""
    beam = beam_of(lidar)
    return dataclasses.replace(beam, view_radius=None, gaussian=False, parallel=True)


def disc(radius: Scalar, turn: Scalar) -> tuple[Scalar, Scalar]:
    """Coordinates of the point at `radius` in the direction `turn`, in turns."""
    return radius * jnp.cos(2 * np.pi * turn), radius * jnp.sin(2 * np.pi * turn)


def across_beam(beam: Beam, share: Scalar, turn: Scalar) -> tuple[Scalar, Scalar]:
    """The point, m, in the direction `turn`, whose radius encloses the share `share` of the energy."""
    share = jnp.clip(share, 0.0, 1.0 - 1e-7)
    return disc(beam.radius * jnp.sqrt(-0.5 * jnp.log1p(-share) if beam.gaussian else share), turn)


class Slice(NamedTuple):
    """Which part of a footprint's rays: number `number`, from 0, of `count` parts of one size."""

    number: Int[Array, ""] | int = 0
    count: Int[Array, ""] | int = 1


# All rays are one part.
WHOLE = Slice()


def lattice(
    beam: Beam, count: int, shift: Float[Array, "2"], part: Slice = WHOLE
) -> tuple[tuple[Scalar, Scalar], Float[Array, "rays"]]:
    """A Fibonacci disc of rays of equal energy; `shift` in [0, 1) moves it along both coordinates.

    It has `count` rays in each of its parts. Those of `part` carry all energy, so that the mean of all parts
    is what the disc gives.
    """
    before = jnp.asarray(part.number * count)
    u = (before + jnp.arange(count) + shift[0]) / (count * part.count)
    # Whole numbers overflow as turns do, and lose nothing where there are many rays.
    turned = (before.astype(jnp.uint32) * np.uint32(round(GOLDEN * 2**32))).astype(u.dtype) * 2.0**-32
    turn = jnp.asarray((np.arange(count) * GOLDEN) % 1.0, u.dtype) + turned + shift[1]
    return across_beam(beam, u, turn), jnp.full((count,), 1.0 / count, u.dtype)


def scattered(
    beam: Beam, count: int, key: PRNGKeyArray
) -> tuple[tuple[Scalar, Scalar], Float[Array, "rays"]]:
    """`count` rays of equal energy at independent places."""
    u, turn = jax.random.uniform(key, (2, count))
    return across_beam(beam, u, turn), jnp.full((count,), 1.0 / count, u.dtype)


def product_rule(
    beam: Beam, radial: int = 12, angular: int = 32
) -> tuple[tuple[Scalar, Scalar], Float[Array, "rays"]]:
    """Gauss rule in radius times equal steps in azimuth: spectrally accurate where the integrand is smooth.

    It is Gauss-Laguerre in 2 r^2 / w^2 for the Gaussian beam, and Gauss-Legendre in r^2 for the top-hat. At
    the edge of a field of view the integrand is not smooth: there, pieces of a Gauss-Legendre rule in r end
    at the edge.
    """
    if beam.view_radius is not None:
        r, weight = _rule_with_edge(beam, beam.view_radius)
    elif beam.gaussian:
        x, weight = np.polynomial.laguerre.laggauss(radial)
        r, weight = beam.radius * jnp.sqrt(jnp.asarray(x / 2)), jnp.asarray(weight)
    else:
        x, weight = np.polynomial.legendre.leggauss(radial)
        r, weight = beam.radius * jnp.sqrt(jnp.asarray((x + 1) / 2)), jnp.asarray(weight / 2)
    a = 2 * np.pi * (np.arange(angular) + 0.5) / angular
    x, y = (jnp.outer(r, jnp.asarray(f(a))).reshape(-1) for f in (np.cos, np.sin))
    return (x, y), jnp.repeat(weight / angular, angular)


def _rule_with_edge(
    beam: Beam, edge: Float[Array, ""], order: int = 16
) -> tuple[Float[Array, "radii"], Float[Array, "radii"]]:
    """Radii and shares of the energy: Gauss-Legendre in r on pieces that resolve a soft edge of 2 %."""
    # In units of the beam's radius; beyond four of them a Gaussian beam has 1e-14 of its energy.
    end = jnp.asarray(4.0 if beam.gaussian else 1.0, edge.dtype)
    at = edge / jnp.maximum(beam.radius, 1e-9)
    ends = jnp.stack([0.0 * end, *(jnp.minimum(f * at, end) for f in (0.8, 1.0, 1.2)), end])
    node, weight = (jnp.asarray(v, edge.dtype)[None, :] for v in np.polynomial.legendre.leggauss(order))
    half = 0.5 * jnp.diff(ends)[:, None]
    r = (ends[:-1, None] + half * (1.0 + node)).reshape(-1)
    density = 4.0 * r * jnp.exp(-2.0 * r * r) if beam.gaussian else 2.0 * r
    return beam.radius * r, (half * weight).reshape(-1) * density
