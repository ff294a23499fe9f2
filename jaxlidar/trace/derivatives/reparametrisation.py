r"""Reparametrised rays and photons: they move with the geometry, so that derivatives of jumps are unbiased.

Let f jump at places that depend on a parameter theta. Under the integral over fixed sample points the
derivative of the jumps is lost. With points x = T(u, theta) that move with the jumps,

    integral of f(x) p(x) dx = integral of f(T(u, theta)) p(T(u, theta)) |dT/du| du,

f(T(u, theta)) does not jump in theta, and automatic differentiation of the right-hand side is unbiased
(Loubet et al. 2019, ACM Trans. Graph. 38, 228). T is the identity in value: values do not change, only
derivatives, and the factor p(T) |dT/du| is one in value, the attached ratio.

The optical depth of a ray jumps where it crosses from one column of voxels to the next, the normal of terrain
where its landing point crosses from one cell to the next. Therefore the rays of the footprint land at the
same places among columns and cells (`rays_with_grids`), and so do photons of higher orders that land on a
surface (`move_landings`).

Points must move with **every** border at which the integrand jumps, those of the domain of integration
included; where they do not, the integrand must be continuous. For higher orders these are:

- Collisions in the medium keep their direction, and the fraction at which they lie between the ends of the
  chord through their voxel, or surfaces that cut it (`trace.march.flight`). Where a path comes to enter a
  voxel its chord grows from zero, so that nothing jumps there.
- Faces of columns and edges of terrain cells, for landings: points there move with them. The sides of a voxel
  map and the edges of terrain are such faces, too.
- The longest flight: beyond it nothing is recorded, and the response has fallen to zero before. Photons that
  end in the medium must not take part in the motion of landings: they would carry a response that is not
  zero across this border, and across the direction in which a surface ends.
- The horizon of a surface: the density of landings, proportional to the cosine, falls to zero there. That of
  a law such as `EqualAngle` does not: derivatives by the tilt of its surface lack the motion of the horizon.
- The outlines of shapes and of meshes, and ridges that hide what lies behind them: not covered in higher
  orders; derivatives lack the light that appears and disappears there.

Points between two faces move as linear interpolation between the motions of these, whichever grids they
belong to: with the faces at a and b and the fraction t = (u - a) / (b - a) held fixed,

    T(u) = a + t (b - a),   |dT/du| = (b - a) / detach(b - a).

Where faces of two grids coincide, and one grid moves sideways and the other does not, no such points exist:
the expected value itself has a kink there, and derivatives are those of both grids moving together.

The return also jumps at the outlines of shapes, where rays meet or miss them. Let d(u, theta) be the signed
distance of the ray through u from an outline, n its gradient by u over the square of that gradient, and d_0,
n_0 their detached values. Points that move as

    T(u) = u - (d - d_0) n_0,   |dT/du| = 1 - grad(d - d_0) . n_0 - (d - d_0) div(n_0)   (to first order)

keep their distance from that outline. Motions V_i with the outlines and with the grids are blended,

    T(u) = u + sum_i phi_i V_i,   |dT/du| = 1 + sum_i (phi_i div(V_i) + grad(phi_i) . V_i),

with weights phi_i, proportional to the inverse square of the distance from what the motion belongs to, that
add up to one: at each outline, and at each face, points move with it alone (as the harmonic weights of
Bangaru et al. 2020, ACM Trans. Graph. 39, 245).
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxlidar._vectors import (
    FAR,
    Scalar,
    Vec,
    along,
    dot,
    scale,
    to_frame,
    vec,
    with_derivative_of,
)
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.scenes.shapes import AbstractShape
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.first.footprint import Beam
from jaxlidar.trace.march.flight import Flight, SurfaceEncounters
from jaxlidar.trace.march.surfaces import TracedSurface
from jaxlidar.trace.photons.photons import Photons, attached_ratio, detach

# Widths of columns or cells, and the position of one of their corners, m.
Grid = tuple[Float[Array, "2"], Float[Array, "2"]]
# A surface, as its shape or as the tangent plane of each photon, and True for the photons that land on it.
Target = tuple[AbstractShape | tuple[Vec, Scalar], Bool[Array, "photons"]]

# Faces of two grids that are nearer than this fraction of a cell are taken as one: the density of points
# between them would change by its inverse.
_COINCIDENT = 1e-3
# Least vertical component of the normal of triangles on which landing points move with columns.
_MIN_UPRIGHT = 0.1
# Radius of a beam, m, below which it is a line.
_MIN_RADIUS = 1e-6
# Distance from an outline, in radii of the beam, at which its motion and that of the ground weigh the same.
_OUTLINE_REACH = 0.25
# Squared gradient of a distance from an outline below which points do not follow it.
_MIN_SQUARED_SLOPE = 1e-3


def has_moving_landings(scene: DeviceScene) -> bool:
    """Return True if derivatives are taken and photons may land on columns or cells that move."""
    return scene.derivatives != "none" and bool(scene.surfaces) and bool(_grids(scene))


def move_landings(
    scene: DeviceScene,
    p: Photons,
    encounters: SurfaceEncounters,
    flights: Flight,
    may_move: Bool[Array, ""],
) -> Flight:
    """Move the points where photons land as columns of voxels and cells of terrain move.

    With the direction held fixed, landing points would cross from cell to cell. With the point held fixed
    between faces, rays that start just above the surface would have to turn without bound. So landing points
    u move by a blend,

        T(u) = (1 - fade) motion with the faces + fade * motion at a fixed direction,

    with fade(u) zero at the faces of columns and of cells, and one where the start of the ray is lower above
    the tangent plane than u is away from the next face. With r the ratio p(T) |dT/du| of the motion with the
    faces alone (that of a fixed direction is one), the ratio of the blend is, to first order,

        1 + (1 - fade) (r - 1) + grad(fade) . (motion at a fixed direction - motion with the faces).

    1. The landing point at a fixed direction.
    2. The landing point fixed between faces, and the ratio r: density of directions per area of the map.
    3. The fade and its gradient.
    4. The blend of both motions, and its ratio.
    5. The transmittance of the path to the moved point: to first order, the optical depth at a fixed
       direction grows by what the turn of the path and its change of length add.

    **Arguments:** `may_move`: False for the first order, whose rays move already (`rays_with_grids`).

    **Returns:** the flights; direction, distance and ratio of those that land have their derivative changed.
    """
    assert p.last_scattering is not None
    moves = may_move & p.alive & jnp.any(flights.landed, axis=0)
    direct_distance = jnp.where(moves, encounters.nearest_stop, 1.0)
    direct = along(p.x, p.w, direct_distance)
    landing, triangle = jax.tree.map(detach, direct), encounters.mesh_normal
    targets: list[Target] = []
    for surface, stop in zip(scene.surfaces, encounters.stops):
        is_target = stop <= encounters.nearest_stop
        if surface.shape is None:
            assert triangle is not None
            # Points of a vertical triangle have no place of their own on the map.
            moves &= ~is_target | (jnp.abs(detach(triangle[2])) > _MIN_UPRIGHT)
            targets.append(((triangle, dot(triangle, direct)), is_target))
        else:
            targets.append((surface.shape, is_target))

    def tangent(targets: list[Target], point: Vec) -> tuple[Vec, Scalar]:
        offset = jnp.zeros_like(p.weight)
        normal = (offset, offset, jnp.ones_like(offset))
        for surface, is_target in targets:
            plane = surface if isinstance(surface, tuple) else surface.tangent(point)
            normal = vec(jnp.where(is_target & moves, n, m) for n, m in zip(plane[0], normal))
            offset = jnp.where(is_target & moves, plane[1], offset)
        return normal, offset

    (x, y), widths = _between_faces(_grids(scene), landing)
    normal, offset = tangent(targets, (x, y, landing[2]))

    def towards(x: Scalar, y: Scalar) -> tuple[Vec, Scalar]:
        """Return direction and distance to the point of the surface at x and y near the landing point."""
        z = (offset - normal[0] * x - normal[1] * y) / normal[2]
        to_point = vec(jnp.where(moves, a - b, c) for a, b, c in zip((x, y, z), p.x, p.w))
        distance = jnp.sqrt(jnp.maximum(dot(to_point, to_point), 1e-20))
        return scale(to_point, 1.0 / distance), distance

    w, distance_to_fixed = towards(x, y)
    # Per area of the map, onto which the sloping surface is projected; the last factor is |dT/du| of a point
    # that is fixed between faces, up to a constant.
    density = (
        scene.direction_density(p.last_scattering, w)
        * jnp.abs(dot(normal, w) / normal[2])
        / (distance_to_fixed * distance_to_fixed)
        * (widths[0] * widths[1])
    )
    ratio = jnp.where(moves, attached_ratio(density), 1.0)

    fixed_scene, fixed_targets, start = jax.tree.map(detach, (scene, targets, p.x))

    def fade_at(u: tuple[Scalar, Scalar]) -> Scalar:
        # The tangent plane turns with u over terrain, and the height of the start above it with it.
        normal, offset = tangent(fixed_targets, (*u, landing[2]))
        height_above = jnp.maximum(jnp.abs(dot(normal, start) - offset), 1e-6)
        fade = jnp.ones_like(u[0])
        for to_face in _distances_from_faces(fixed_scene, (*u, landing[2])):
            fade = fade * jnp.minimum(to_face / height_above, 1.0)
        return fade

    fade, gradient = _value_and_slopes(fade_at, (landing[0], landing[1]))
    difference = [direct[k] - landing[k] - (a - detach(a)) for k, a in enumerate((x, y))]
    ratio = 1.0 + (1.0 - fade) * (ratio - 1.0) + gradient[0] * difference[0] + gradient[1] * difference[1]
    # Values stay those that were drawn.
    w, distance = towards(*(a + fade * change for a, change in zip((x, y), difference)))
    w = vec(with_derivative_of(a, jnp.where(moves, b, a)) for a, b in zip(p.w, w))
    if flights.path_slopes is not None:
        # Derivatives alone: values are zero.
        turn = vec(a - detach(a) - (b - detach(b)) for a, b in zip(w, p.w))
        longer = distance - detach(distance) - (direct_distance - detach(direct_distance))
        ratio = ratio * jnp.exp(-flights.path_slopes.change(turn, longer))
    lands = flights.landed & jnp.broadcast_to(moves, flights.landed.shape)

    def moved(fixed: Scalar, changed: Scalar) -> Scalar:
        fixed, changed = (jnp.broadcast_to(a, lands.shape) for a in (fixed, changed))
        return with_derivative_of(fixed, jnp.where(lands, changed, fixed))

    return dataclasses.replace(
        flights,
        moved_w=vec(moved(a, b) for a, b in zip(p.w, w)),
        distance=moved(flights.distance, distance),
        ratio=moved(flights.ratio, flights.ratio * jnp.broadcast_to(ratio, lands.shape)),
        # They belong to whole flights, not to ends, and are not needed any more.
        path_slopes=None,
    )


def _grids(scene: DeviceScene) -> list[Grid]:
    """Return the columns of voxels, then the cells of terrain, if there are any."""
    medium = scene.medium
    grids = [] if medium is None else [(medium.size[:2], medium.origin[:2])]
    fields = [s.shape.heights for s in scene.surfaces if isinstance(s.shape, HeightField)]
    return grids + [(field.spacing, field.origin) for field in fields]


def has_moving_rays(scene: DeviceScene) -> bool:
    """Return True if derivatives are taken and the rays of the footprint move with the geometry.

    Over planes alone, where a quadrature rule takes their place, nothing jumps. Rays of a lidar that is
    placed by its sensor, which may be level, keep a place on terrain alone.
    """
    if scene.derivatives == "none":
        return False
    if scene.beam.rectangle is not None:
        return True
    may_jump = scene.config.n_rays > 1 and not scene.config.uses_quadrature
    has_place = not scene.beam.from_sensor or _terrain(scene) is not None
    return may_jump and has_place


def rays_with_grids(
    scene: DeviceScene, across: tuple[Scalar, Scalar]
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Move the rays of the footprint with the geometry, if they move at all.

    1. Rays of a Gaussian beam move with grids and terrain (`move_across_beam`). The beam itself does not
       move them: the ratio of its irradiance makes up for a change of its width, and for their motion.
    2. The rim of a top-hat beam would not make up for it, nor would the sides of a rectangle. Rays widen with
       the beam, or move with the rectangle, and stay within its rim; away from the rim they move with grids
       and terrain.
    3. Where shapes state outlines, the motion is blended with that of these.
    4. Rays of a lidar that is placed by its sensor stay where they are unless all of them meet terrain.

    **Returns:** positions across the beam, and the ratio of the density, each with their derivative alone
    changed.
    """
    one = jnp.ones_like(across[0])
    if not has_moving_rays(scene):
        return across, one
    beam, outlines = scene.beam, _surfaces_with_outline(scene, across)
    if not (beam.gaussian or outlines or _grids(scene)):
        return across, one
    moved, area, is_met = move_across_beam(scene, across)
    if outlines or not beam.gaussian:
        moved, area = _with_rim_and_outlines(scene, outlines, across, (moved, area))
    density = beam.irradiance(moved) * area if beam.gaussian else area
    # A beam without width has no profile that could make up for the motion.
    may_move = jnp.asarray(True) if beam.rectangle is not None else beam.radius > _MIN_RADIUS
    if beam.from_sensor:
        may_move &= jnp.all(is_met)
    density = jnp.where(may_move, density, 1.0)
    x, y = (with_derivative_of(a, jnp.where(may_move, b, a)) for a, b in zip(across, moved))
    return (x, y), with_derivative_of(one, density / jnp.maximum(detach(density), 1e-30))


def _surfaces_with_outline(scene: DeviceScene, across: tuple[Scalar, Scalar]) -> list[TracedSurface]:
    """Return the surfaces whose shapes state an outline."""
    point, w, _ = scene.beam.ray(across)
    return [
        surface
        for surface in scene.surfaces
        if surface.may_have_outline
        and surface.shape is not None
        and surface.shape.outline(point, w) is not None
    ]


class _Motion(NamedTuple):
    """A motion of points across the beam: zero in value, it has a derivative alone.

    - `displacement`: of the points, m. - `divergence`: relative change of the area about them.
    - `weight`: in a blend of motions, detached. - `weight_slopes`: its derivatives across the beam, 1/m.
    """

    displacement: tuple[Scalar, Scalar]
    divergence: Scalar
    weight: Scalar
    weight_slopes: tuple[Scalar, Scalar]


def _with_rim_and_outlines(
    scene: DeviceScene,
    outlines: list[TracedSurface],
    across: tuple[Scalar, Scalar],
    moved_with_grids: tuple[tuple[Scalar, Scalar], Scalar],
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Blend the motion of points across the beam with that of outlines, and of the rim of an even beam.

    `moved_with_grids`: points and |dT/du| of `move_across_beam`.

    **Returns:** points across the beam, and |dT/du|, for an even beam over that of the motion of the beam.
    """
    fixed_scene = jax.tree.map(detach, scene)
    (moved, area), beam, fixed_beam = moved_with_grids, scene.beam, fixed_scene.beam
    beam_motion, start = _motion_of_beam(beam), jax.tree.map(detach, across)
    if fixed_beam.rectangle is None:
        radius = jnp.maximum(fixed_beam.radius, _MIN_RADIUS)
    else:
        radius = 0.5 * jnp.min(fixed_beam.rectangle[1])
    reach = _OUTLINE_REACH * radius
    if fixed_beam.rectangle is not None:
        # Where cells are many times finer, their faces would outweigh the rim, whose weight is bounded.
        reach = jnp.min(jnp.stack([reach, *(jnp.min(width) for width, _ in _grids(fixed_scene))]))

    def to_rim(u: tuple[Scalar, Scalar]) -> Scalar:
        if fixed_beam.rectangle is None:
            distances = [radius - jnp.sqrt(jnp.maximum(u[0] ** 2 + u[1] ** 2, 1e-12))]
        else:
            corner, size = fixed_beam.rectangle
            from_corner = [u[k] - corner[k] for k in range(2)]
            distances = from_corner + [size[k] - from_corner[k] for k in range(2)]
        return sum((_inverse_square(distance, reach) for distance in distances), jnp.ones_like(u[0]))

    def to_faces(u: tuple[Scalar, Scalar]) -> Scalar:
        landing, _ = _landing(fixed_scene, u)
        # Distances as they look from the sensor, in the plane across the beam.
        slant_range = fixed_beam.slant_range
        magnification = slant_range / (slant_range + dot(landing, fixed_beam.axis))
        distances = [magnification * distance for distance in _distances_from_faces(fixed_scene, landing)]
        weight = sum((_inverse_square(distance, reach) for distance in distances), jnp.zeros_like(u[0]))
        return weight + 1.0 if beam.gaussian else weight

    base, motions = beam_motion.point(start), []
    if not beam.gaussian:
        still = jnp.zeros_like(start[0])
        motions.append(_Motion((still, still), still, *_value_and_slopes(to_rim, start)))
    if beam.gaussian or _grids(scene):
        displacement = (moved[0] - base[0], moved[1] - base[1])
        divergence = area / detach(area) - beam_motion.area
        motions.append(_Motion(displacement, divergence, *_value_and_slopes(to_faces, start)))
    for surface, fixed in zip(outlines, jax.tree.map(detach, outlines)):

        def distance(u: tuple[Scalar, Scalar], surface: TracedSurface = surface) -> Scalar:
            return _distance_from_outline(beam, surface, scene.limits.start_distance, beam_motion.point(u))

        def fixed_distance(u: tuple[Scalar, Scalar], surface: TracedSurface = fixed) -> Scalar:
            return _distance_from_outline(fixed_beam, surface, fixed_scene.limits.start_distance, u)

        motions.append(_outline_motion(distance, fixed_distance, start, reach))
    (x, y), divergence = _blend(motions)
    return (base[0] + x, base[1] + y), 1.0 + divergence


class _MotionOfBeam(NamedTuple):
    """The motion of points with an even beam: with their fractions of its width held fixed.

    Identity in value: (stretch x + shift) along each axis. That of a Gaussian beam is zero.
    """

    stretch: tuple[Scalar, Scalar]
    shift: tuple[Scalar, Scalar]

    def point(self, u: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        """Return where a point moves to."""
        x, y = (a * b + c for a, b, c in zip(self.stretch, u, self.shift))
        return x, y

    @property
    def area(self) -> Scalar:
        """|dT/du|."""
        return self.stretch[0] * self.stretch[1]


def _motion_of_beam(beam: Beam) -> _MotionOfBeam:
    """Return the motion of points with the width of a top-hat beam, or with a rectangle."""
    if beam.rectangle is not None:
        corner, size = beam.rectangle
        stretch = size / jnp.maximum(detach(size), _MIN_RADIUS)
        shift = corner - stretch * detach(corner)
        return _MotionOfBeam((stretch[0], stretch[1]), (shift[0], shift[1]))
    # A top-hat beam is round.
    zero = jnp.zeros_like(beam.radius)
    widening = zero + 1.0 if beam.gaussian else beam.radius / jnp.maximum(detach(beam.radius), _MIN_RADIUS)
    return _MotionOfBeam((widening, widening), (zero, zero))


def _distance_from_outline(
    beam: Beam, surface: TracedSurface, start_distance: Scalar | float, across: tuple[Scalar, Scalar]
) -> Scalar:
    """Return the signed distance, m, of rays through points across the beam from the outline of a shape."""
    point, w, _ = beam.ray(across)
    assert surface.shape is not None
    distance = surface.shape.outline(along(point, w, jnp.full_like(point[0], -start_distance)), w)
    assert distance is not None
    return jnp.broadcast_to(distance, across[0].shape)


def _outline_motion(
    distance: Callable[[tuple[Scalar, Scalar]], Scalar],
    fixed_distance: Callable[[tuple[Scalar, Scalar]], Scalar],
    start: tuple[Scalar, Scalar],
    reach: Scalar,
) -> _Motion:
    """Return the motion that keeps points at their distance from an outline (see the module).

    `distance`, `fixed_distance`: signed distances from the outline by points across the beam, the latter
    without derivatives by parameters.
    """

    def normal(u: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        _, (x, y) = _value_and_slopes(fixed_distance, u)
        # Where the gradient vanishes, in the middle of a shape, the motion does, too: a motion that has a
        # source there would have an infinite divergence. Shapes without an outline at all state a constant.
        square = jnp.maximum(x * x + y * y, _MIN_SQUARED_SLOPE)
        return x / square, y / square

    value, slopes = _value_and_slopes(distance, start)
    fixed_value, fixed_slopes = _value_and_slopes(fixed_distance, start)
    change, n = value - detach(value), normal(start)
    _, (bend_x, _) = _value_and_slopes(lambda u: normal(u)[0], start)
    _, (_, bend_y) = _value_and_slopes(lambda u: normal(u)[1], start)
    change_slopes = [slope - detach(slope) for slope in slopes]
    divergence = -(change_slopes[0] * n[0] + change_slopes[1] * n[1] + change * (bend_x + bend_y))
    weight = _inverse_square(fixed_value, reach)
    # Derivative of 1 / ((d / reach)^2 + tiny).
    slope = -2.0 * weight * weight * fixed_value / reach**2
    weight_slopes = (slope * fixed_slopes[0], slope * fixed_slopes[1])
    return _Motion((-change * n[0], -change * n[1]), divergence, weight, weight_slopes)


def _inverse_square(distance: Scalar, reach: Scalar) -> Scalar:
    """Weight of a motion at a distance, m, from what it belongs to; 1 at the distance `reach`, m."""
    return 1.0 / ((distance / reach) ** 2 + 1e-6)


def _blend(motions: list[_Motion]) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Return the displacement and the divergence of the mean of motions by their weights."""
    total = sum(m.weight for m in motions)
    total_slopes = [sum(m.weight_slopes[k] for m in motions) for k in range(2)]
    displacement, divergence = [jnp.zeros_like(total) for _ in range(2)], jnp.zeros_like(total)
    for motion in motions:
        share = motion.weight / total
        divergence = divergence + share * motion.divergence
        for k in range(2):
            share_slope = (motion.weight_slopes[k] - share * total_slopes[k]) / total
            displacement[k] = displacement[k] + share * motion.displacement[k]
            divergence = divergence + share_slope * motion.displacement[k]
    return (displacement[0], displacement[1]), divergence


def _value_and_slopes(
    function: Callable[[tuple[Scalar, Scalar]], Scalar], u: tuple[Scalar, Scalar]
) -> tuple[Scalar, tuple[Scalar, Scalar]]:
    """Return an elementwise function of points and its derivatives by their two coordinates."""
    one, zero = jnp.ones_like(u[0]), jnp.zeros_like(u[0])
    value, x = jax.jvp(function, (u,), ((one, zero),))
    _, y = jax.jvp(function, (u,), ((zero, one),))
    return value, (x, y)


def move_across_beam(
    scene: DeviceScene, across: tuple[Scalar, Scalar]
) -> tuple[tuple[Scalar, Scalar], Scalar, Bool[Array, "rays"]]:
    """Move points across the beam so that the rays through them land at the same places among grid faces.

    The optical depth of a nearly vertical ray jumps where it crosses into another column, so that its
    derivative with respect to a sideways motion of the grid lies in rare, nearly parallel crossings. Rays
    that move along with the columns do not cross. The normal of terrain jumps at the edges of cells: at a
    fixed direction, landing points would cross them as cells move, or, off nadir, as heights change.

    1. Where the ray meets the terrain, or else the reference plane, detached.
    2. The same place between the faces of all grids, and as high as the terrain is there now.
    3. Its central projection from the sensor onto the plane across the beam; of parallel light, its
       projection along the axis onto the reference plane.
    4. |dT/du|, up to a constant: the area between faces, projected onto that plane.

    **Returns:** points across the beam, |dT/du|, and True for rays that meet terrain.
    """
    beam, terrain = scene.beam, _terrain(scene)
    landing, is_met = _landing(*jax.tree.map(detach, (scene, across)))
    (x, y), widths = _between_faces(_grids(scene), landing)
    height = slope_x = slope_y = jnp.zeros_like(x)
    if terrain is not None:
        value, slopes = terrain.heights.value_and_slope((x, y))
        height, slope_x, slope_y = (jnp.where(is_met, a, 0.0) for a in (value, *slopes))
    if beam.parallel:
        # Points lie on the reference plane, along the axis from the surface.
        east, north, up = beam.axis
        cosine = jnp.abs((up - slope_x * east - slope_y * north) / up)
        return (x - height * east / up, y - height * north / up), widths[0] * widths[1] * cosine, is_met
    in_beam = to_frame(beam.axis, (x, y, height))
    # Central projection from the sensor onto the plane across the beam.
    magnification = beam.slant_range / (beam.slant_range + in_beam[2])
    moved = (in_beam[0] * magnification, in_beam[1] * magnification)
    _, direction, _ = beam.ray(moved)
    cosine = jnp.abs(direction[2] - slope_x * direction[0] - slope_y * direction[1])
    return moved, widths[0] * widths[1] * cosine * magnification**2, is_met


def _terrain(scene: DeviceScene) -> HeightField | None:
    """Return the shape of the ground if it is a height field."""
    shape = scene.surfaces[0].shape if scene.config.has_ground else None
    return shape if isinstance(shape, HeightField) else None


def _landing(scene: DeviceScene, across: tuple[Scalar, Scalar]) -> tuple[Vec, Bool[Array, "rays"]]:
    """Return where rays meet the terrain, or else the reference plane, and True for the terrain."""
    point, w, _ = scene.beam.ray(across)
    terrain = _terrain(scene)
    # Rays from a sensor may be level.
    to_plane = jnp.zeros_like(w[2]) if scene.beam.from_sensor else -point[2] / w[2]
    if terrain is None:
        return along(point, w, to_plane), jnp.zeros(to_plane.shape, bool)
    start_distance = scene.limits.start_distance
    distance = terrain.distance(along(point, w, jnp.full_like(to_plane, -start_distance)), w)
    is_met = distance < FAR
    return along(point, w, jnp.where(is_met, distance - start_distance, to_plane)), is_met


def _distances_from_faces(scene: DeviceScene, point: Vec) -> list[Scalar]:
    """Return the horizontal distances, m, of points from the nearest faces of every grid, along x and y."""
    distances = []
    for size, origin in _grids(scene):
        for k in range(2):
            in_cell = (point[k] - origin[k]) / size[k]
            in_cell = in_cell - jnp.floor(in_cell)
            distances.append(jnp.minimum(in_cell, 1.0 - in_cell) * size[k])
    return distances


def _between_faces(grids: list[Grid], point: Vec) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
    """Return points, fixed as fractions of the way from face to face, and the distances between these faces.

    Along each axis, the faces are the nearest ones on either side among the faces of all grids: points near a
    face move with it, whichever grid it belongs to. Faces of two grids that coincide move with the first.
    """
    place, widths = [], []
    for k in range(2):
        cells = [_cell_around(grid, point[k], k) for grid in grids]
        # Without grids nothing moves.
        lower, upper = cells[0] if cells else (detach(point[k]), detach(point[k]) + 1.0)
        for next_lower, next_upper in cells[1:]:
            tolerance = _COINCIDENT * detach(jnp.minimum(upper - lower, next_upper - next_lower))
            is_inside = (next_lower > lower + tolerance) & (next_lower < upper - tolerance)
            new_lower = jnp.where(is_inside, next_lower, lower)
            is_inside = (next_upper < upper - tolerance) & (next_upper > new_lower + tolerance)
            lower, upper = new_lower, jnp.where(is_inside, next_upper, upper)
        width = upper - lower
        place.append(lower + detach((point[k] - lower) / width) * width)
        widths.append(width)
    return (place[0], place[1]), (widths[0], widths[1])


def _cell_around(grid: Grid, position: Scalar, axis: int) -> tuple[Scalar, Scalar]:
    """Return the faces on either side of positions along an axis, with their derivatives."""
    size, origin = grid[0][axis], grid[1][axis]
    lower = origin + size * jnp.floor(detach((position - origin) / size))
    return lower, lower + size
