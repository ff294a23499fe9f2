r"""Reparametrised rays and photons: they move with the geometry, so that derivatives of jumps are unbiased.

Let f jump at places that depend on a parameter theta. Under the integral over fixed sample points the
derivative of the jumps is lost. With points x = T(u, theta) that move with the jumps,

    integral of f(x) p(x) dx = integral of f(T(u, theta)) p(T(u, theta)) |dT/du| du,

f(T(u, theta)) does not jump in theta, and automatic differentiation of the right-hand side is unbiased
(Loubet et al. 2019, ACM Trans. Graph. 38, 228). T is the identity in value: values do not change, only
derivatives, and the factor p(T) |dT/du| is one in value, the attached ratio.

The optical depth of a ray jumps where it crosses from one column of voxels to the next, the normal of terrain
where its landing point crosses from one cell to the next. Therefore the rays of the footprint move along with
columns (`rays_with_columns`) and cells (`rays_with_terrain`), and so do the landing points of photons that
head for a surface (`landings_with_grids`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxlidar._vectors import (
    FAR,
    Scalar,
    Vec,
    add,
    along,
    dot,
    from_frame,
    scale,
    to_frame,
    vec,
    with_derivative_of,
)
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.flight import SurfaceEncounters
from jaxlidar.trace.footprint import Beam
from jaxlidar.trace.photons import Photons, attached_ratio, detach
from jaxlidar.trace.voxel_traversal import Medium

# Widths of columns or cells, and the position of one of their corners, m.
Grid = tuple[Float[Array, "2"], Float[Array, "2"]]


def has_moving_landings(scene: DeviceScene) -> bool:
    """Return True if derivatives are taken and photons may land on columns or cells that move."""
    return scene.derivatives != "none" and bool(scene.surfaces) and bool(_grids(scene))


def landings_with_grids(
    scene: DeviceScene, p: Photons, encounters: SurfaceEncounters, heading: Bool[Array, "photons"]
) -> tuple[Vec, Scalar, Scalar]:
    """Move the rays of photons towards surfaces as columns of voxels and cells of terrain move.

    With the direction held fixed, landing points would cross from column to column. With the point held fixed
    in its column, rays that start just above the surface would have to turn without bound. So landing points
    u move by a blend,

        T(u) = (1 - fade) column motion + fade * motion at a fixed direction,

    with fade(u) zero at the faces of columns and of cells, and one where the start of the ray is lower above
    the tangent plane than u is away from the next face. With r the ratio p(T) |dT/du| of the column motion
    alone (that of a fixed direction is one), the ratio of the blend is, to first order,

        1 + (1 - fade) (r - 1) + grad(fade) . (motion at a fixed direction - column motion).

    1. The landing point at a fixed direction, and the tangent plane there.
    2. The landing point fixed in its column, and the ratio r: density of directions per area of the map.
    3. The fade, as the product of those of all grids, and its gradient.
    4. The blend of both motions, and its ratio.

    Columns are those of the first grid, of voxels if there are any. Over terrain the derivative is unbiased
    if the cells do not move relative to them.

    **Arguments:** `heading`: True for photons on their way to a surface.

    **Returns:** direction, distance to the nearest stop, and ratio, each with their derivative alone changed.
    """
    grids = _grids(scene)
    size, origin = grids[0]
    assert p.last_scattering is not None
    heading &= p.alive
    distance = jnp.where(heading, encounters.nearest_stop, 1.0)
    direct = along(p.x, p.w, distance)
    landing = jax.tree.map(detach, direct)
    normal, offset = vec(jnp.zeros_like(distance) for _ in range(3)), jnp.zeros_like(distance)
    for surface, stop in zip(scene.surfaces, encounters.stops):
        is_target = stop <= encounters.nearest_stop
        surface_normal, surface_offset = surface.shape.tangent(direct)
        normal = vec(jnp.where(is_target, n, m) for n, m in zip(surface_normal, normal))
        offset = jnp.where(is_target, surface_offset, offset)
    normal_z = jnp.where(heading, normal[2], 1.0)

    def on_surface(x, y):
        z = (offset - normal[0] * x - normal[1] * y) / normal_z
        return x, y, jnp.where(heading, z, direct[2])

    def towards(point):
        to_point = add(point, scale(p.x, jnp.asarray(-1.0)))
        distance2 = jnp.maximum(dot(to_point, to_point), 1e-20)
        return scale(to_point, 1.0 / jnp.sqrt(distance2)), jnp.sqrt(distance2)

    # The position in units of columns is fixed.
    in_column = [detach((landing[k] - origin[k]) / size[k]) for k in range(2)]
    column = on_surface(*(origin[k] + size[k] * in_column[k] for k in range(2)))
    w, distance_to_column = towards(column)
    # Per area of the map, onto which the sloping surface is projected; the last factor is |dT/du| of a point
    # that is fixed in its column, up to a constant.
    density = (
        scene.direction_density(p.last_scattering, w)
        * jnp.abs(dot(normal, w) / normal_z)
        / (distance_to_column * distance_to_column)
        * (size[0] * size[1])
    )
    ratio = jnp.where(heading, attached_ratio(density), 1.0)

    height_above = jnp.maximum(detach(distance * jnp.abs(dot(normal, p.w))), 1e-6)
    fade, gradient = _fade(grids[0], landing, height_above)
    for grid in grids[1:]:
        # Product rule: the fade is zero at the faces of every grid.
        next_fade, next_gradient = _fade(grid, landing, height_above)
        fade, gradient = (
            fade * next_fade,
            tuple(g * next_fade + fade * m for g, m in zip(gradient, next_gradient)),
        )
    difference = [(direct[k] - landing[k]) - (column[k] - detach(column[k])) for k in range(2)]
    blend_ratio = (
        1.0 + (1.0 - fade) * (ratio - 1.0) + gradient[0] * difference[0] + gradient[1] * difference[1]
    )
    x, y = (landing[k] + (column[k] - detach(column[k])) + fade * difference[k] for k in range(2))
    w, moved_distance = towards(on_surface(x, y))
    # Values stay those that were drawn.
    w = vec(with_derivative_of(a, jnp.where(heading, b, a)) for a, b in zip(p.w, w))
    nearest_stop = encounters.nearest_stop
    nearest_stop = with_derivative_of(nearest_stop, jnp.where(heading, moved_distance, nearest_stop))
    ratio = with_derivative_of(jnp.ones_like(nearest_stop), jnp.where(heading, blend_ratio, 1.0))
    return w, nearest_stop, ratio


def _grids(scene: DeviceScene) -> list[Grid]:
    """Return the columns of voxels, then the cells of terrain, if there are any."""
    medium = scene.medium
    grids = [] if medium is None else [(medium.size[:2], medium.origin[:2])]
    fields = [s.shape.heights for s in scene.surfaces if isinstance(s.shape, HeightField)]
    return grids + [(field.spacing, field.origin) for field in fields]


def _fade(grid: Grid, point: Vec, height_above: Scalar) -> tuple[Scalar, tuple[Scalar, ...]]:
    """Return the fraction of the motion at a fixed direction, and its derivatives with respect to x and y.

    It rises linearly from zero at a face to one at the distance `height_above` from it.
    """
    size, origin = detach(grid[0]), detach(grid[1])
    fades, slopes = [], []
    for k in range(2):
        in_cell = (point[k] - origin[k]) / size[k]
        in_cell = in_cell - jnp.floor(in_cell)
        to_face = jnp.minimum(in_cell, 1.0 - in_cell) * size[k]
        fades.append(jnp.minimum(to_face / height_above, 1.0))
        sign = jnp.where(in_cell < 0.5, 1.0, -1.0)
        slopes.append(jnp.where(to_face < height_above, sign / height_above, 0.0))
    return fades[0] * fades[1], (slopes[0] * fades[1], slopes[1] * fades[0])


def has_rays_moving_with_terrain(scene: DeviceScene) -> bool:
    """Return True if the beam is oblique and Gaussian, and may meet terrain."""
    ground = scene.surfaces[0].shape if scene.config.has_ground else None
    return isinstance(ground, HeightField) and scene.beam.gaussian and not scene.config.vertical


def rays_with_terrain(
    scene: DeviceScene, across: tuple[Scalar, Scalar]
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Move the rays of the footprint so that they meet the same places of terrain.

    At a fixed direction, landing points would cross from one cell of a terrain to the next, where its normal
    jumps, as heights change; straight from above they do not. The profile of a Gaussian beam makes up for the
    motion; the edge of a top-hat would not.

    1. Where the ray meets the terrain, detached.
    2. The same place among the cells, where and as high as it is now.
    3. Its central projection onto the plane across the beam.
    4. The ratio of irradiance times |dT/du|, per area of cells.

    **Returns:** positions across the beam, and the ratio of the density, each with their derivative alone
    changed.
    """
    beam, one, shape = scene.beam, jnp.ones_like(across[0]), scene.surfaces[0].shape
    assert isinstance(shape, HeightField)
    point, w, _ = jax.tree.map(detach, beam.ray(across))
    start_distance = scene.limits.start_distance
    start = along(point, w, jnp.asarray(-start_distance, one.dtype))
    distance = detach(shape.distance(start, w))
    # A beam without width has no profile that could make up for the motion.
    is_met = (distance < FAR) & (beam.radius > 1e-6)
    landing = along(start, w, jnp.where(is_met, distance, start_distance))
    # The same places among the cells, at the heights that the terrain has there.
    field = shape.heights
    x, y = (
        field.origin[k] + field.spacing[k] * detach(at)
        for k, at in enumerate(field.grid_coordinates(landing))
    )
    height, (slope_x, slope_y) = field.value_and_slope((x, y))
    in_beam = to_frame(beam.axis, (x, y, height))
    # Central projection from the sensor onto the plane of `across`.
    magnification = beam.slant_range / (beam.slant_range + in_beam[2])
    moved = (in_beam[0] * magnification, in_beam[1] * magnification)
    _, direction, _ = beam.ray(moved)
    cosine = jnp.abs(direction[2] - slope_x * direction[0] - slope_y * direction[1])
    area = field.spacing[0] * field.spacing[1] * beam.radius**2
    density = jnp.where(is_met, beam.irradiance(moved) * area * cosine * magnification**2, 1.0)
    ratio = jnp.where(is_met, density / jnp.maximum(detach(density), 1e-30), 1.0)
    x, y = (with_derivative_of(a, jnp.where(is_met, a + (b - detach(b)), a)) for a, b in zip(across, moved))
    return (x, y), with_derivative_of(one, ratio)


def rays_with_columns(
    beam: Beam, medium: Medium | None, across: tuple[Scalar, Scalar]
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """Move the rays of the footprint with the columns of the voxel grid.

    The optical depth of a nearly vertical ray jumps where it crosses into another column, so that its
    derivative with respect to a sideways motion of the grid lies in rare, nearly parallel crossings. Rays
    that move along with the columns do not cross. The profile of a Gaussian beam makes up for the motion; the
    edge of a top-hat would not, so that its rays stay, and that derivative stays noisy.

    1. Where the rays meet the reference plane.
    2. The motion of these points with the grid, across the beam.
    3. The ratio of irradiance times |dT/du|: rays move with the widths of voxels and of the beam.

    **Returns:** positions across the beam, and the ratio of the density, each with their derivative alone
    changed.
    """
    if medium is None or not beam.gaussian:
        return across, jnp.ones_like(across[0])
    # A beam without width has no profile that could make up for the motion.
    has_width = beam.radius > 1e-6
    across_axis = from_frame(beam.axis, (*across, jnp.zeros_like(across[0])))
    # Where the rays meet the reference plane.
    on_plane = along(across_axis, beam.axis, -across_axis[2] / beam.axis[2])
    moved = []
    for k in range(2):
        in_grid = detach((on_plane[k] - medium.origin[k]) / medium.size[k])
        position = medium.origin[k] + medium.size[k] * in_grid
        moved.append(jnp.where(has_width, position - detach(position), 0.0))
    shift = to_frame(beam.axis, (*moved, jnp.zeros_like(across[0])))
    across = (across[0] + shift[0], across[1] + shift[1])
    # Rays lie farther apart where voxels or the beam are wider.
    area = medium.size[0] * medium.size[1] * beam.radius**2
    density = jnp.where(has_width, beam.irradiance(across) * area, 1.0)
    detached = detach(density)
    return across, 1.0 + (density - detached) / jnp.maximum(detached, 1e-30)
