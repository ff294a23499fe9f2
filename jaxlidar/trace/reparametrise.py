"""Reparametrised rays: rays move with the geometry, so that derivatives of what jumps are unbiased.

The optical depth of a ray jumps where it crosses from one column of voxels to the next. Rays are therefore
moved along with the columns, and their weights change with the density. Values do not change, only
derivatives. (In rendering this is known as reparametrising discontinuous integrands: Loubet et al. 2019, ACM
Trans. Graph. 38, 228.)
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
from jaxlidar.trace.footprint import Beam
from jaxlidar.trace.march import Medium
from jaxlidar.trace.photons import Photons, ratio_of, stop
from jaxlidar.trace.setting import Setting


def rays_to_surfaces(
    setting: Setting, p: Photons, limit: Scalar, events: list[Scalar], heading: Bool[Array, "photons"]
) -> tuple[Vec, Scalar, Scalar]:
    """Direction, distance and density ratio of rays towards a surface, as geometry moves them.

    The transmittance of the way back jumps where a landing point crosses from below one column of voxels to
    the next, and the normal of terrain where it crosses from one cell to the next. With the direction held
    fixed, points would cross; with the point held fixed in its column, rays that start just above the surface
    would have to turn without bound. So points move with the share `fade` of the motion at a fixed direction:
    none at the faces of a column or a cell, and nearly all for rays shorter than the way to the next face.
    Values do not change, only derivatives.
    """
    grids = _grids(setting)
    size, origin = grids[0]
    assert p.sent is not None
    heading &= p.alive
    reach = jnp.where(heading, limit, 1.0)
    direct = along(p.x, p.w, reach)
    held = jax.tree.map(stop, direct)
    normal, offset = vec(jnp.zeros_like(reach) for _ in range(3)), jnp.zeros_like(reach)
    for s, d in zip(setting.surfaces, events):
        here = d <= limit
        own, at = s.shape.tangent(direct)
        normal = vec(jnp.where(here, n, m) for n, m in zip(own, normal))
        offset = jnp.where(here, at, offset)
    upright = jnp.where(heading, normal[2], 1.0)

    def on_surface(x, y):
        z = (offset - normal[0] * x - normal[1] * y) / upright
        return x, y, jnp.where(heading, z, direct[2])

    def seen_from(point):
        way = add(point, scale(p.x, jnp.asarray(-1.0)))
        far2 = jnp.maximum(dot(way, way), 1e-20)
        return scale(way, 1.0 / jnp.sqrt(far2)), jnp.sqrt(far2)

    # Fixed in the column.
    place = [stop((held[k] - origin[k]) / size[k]) for k in range(2)]
    column = on_surface(*(origin[k] + size[k] * place[k] for k in range(2)))
    w, far = seen_from(column)
    # Per area of the map, from which the sloping surface is projected.
    density = (
        setting.density(p.sent, w) * jnp.abs(dot(normal, w) / upright) / (far * far) * (size[0] * size[1])
    )
    ratio = jnp.where(heading, ratio_of(density), 1.0)

    rise = jnp.maximum(stop(reach * jnp.abs(dot(normal, p.w))), 1e-6)
    fade, gradient = _fade(grids[0], held, rise)
    for grid in grids[1:]:
        other, more = _fade(grid, held, rise)
        fade, gradient = fade * other, tuple(g * other + fade * m for g, m in zip(gradient, more))
    apart = [(direct[k] - held[k]) - (column[k] - stop(column[k])) for k in range(2)]
    turned = 1.0 + (1.0 - fade) * (ratio - 1.0) + gradient[0] * apart[0] + gradient[1] * apart[1]
    x, y = (held[k] + (column[k] - stop(column[k])) + fade * apart[k] for k in range(2))
    w, far = seen_from(on_surface(x, y))
    # Values stay those that were drawn.
    w = vec(with_derivative_of(a, jnp.where(heading, b, a)) for a, b in zip(p.w, w))
    far = with_derivative_of(limit, jnp.where(heading, far, limit))
    return w, far, with_derivative_of(jnp.ones_like(far), jnp.where(heading, turned, 1.0))


# Widths of columns or cells, and the place of one of their corners, m.
Grid = tuple[Float[Array, "2"], Float[Array, "2"]]


def moves_landings(setting: Setting) -> bool:
    """Whether rays are to move with geometry: for derivatives, where what they land on jumps by place."""
    return setting.derivatives != "none" and bool(setting.surfaces) and bool(_grids(setting))


def _grids(setting: Setting) -> list[Grid]:
    """Columns of voxels, then cells of terrain."""
    medium = setting.medium
    grids = [] if medium is None else [(medium.size[:2], medium.origin[:2])]
    fields = [s.shape.heights for s in setting.surfaces if isinstance(s.shape, HeightField)]
    return grids + [(field.spacing, field.origin) for field in fields]


def _fade(grid: Grid, point: Vec, rise: Scalar) -> tuple[Scalar, tuple[Scalar, ...]]:
    """The share of the motion at a fixed direction, and its derivatives with respect to x and y."""
    size, origin = stop(grid[0]), stop(grid[1])
    fades, slopes = [], []
    for k in range(2):
        within = (point[k] - origin[k]) / size[k]
        within = within - jnp.floor(within)
        nearest = jnp.minimum(within, 1.0 - within) * size[k]
        fades.append(jnp.minimum(nearest / rise, 1.0))
        slopes.append(jnp.where(nearest < rise, jnp.where(within < 0.5, 1.0, -1.0) / rise, 0.0))
    return fades[0] * fades[1], (slopes[0] * fades[1], slopes[1] * fades[0])


def sees_terrain(setting: Setting) -> bool:
    """Whether the beam leans, is Gaussian, and may meet terrain: then `rays_to_terrain` moves its rays."""
    ground = setting.surfaces[0].shape if setting.plan.has_ground else None
    return isinstance(ground, HeightField) and setting.beam.gaussian and not setting.plan.vertical


def rays_to_terrain(setting: Setting, across: tuple[Scalar, Scalar]) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """The rays of the footprint, moved so that they meet the same places of terrain; change of their energy.

    At a fixed direction, places would cross from one cell of a terrain to the next, where its normal jumps,
    as heights change. Straight from above they do not. As for `footprint_rays`, the profile of a Gaussian
    beam makes up for the motion, and the edge of a top-hat would not. Values do not change, only derivatives.
    """
    beam, one, shape = setting.beam, jnp.ones_like(across[0]), setting.surfaces[0].shape
    assert isinstance(shape, HeightField)
    point, w, _ = jax.tree.map(stop, beam.ray(across))
    start = along(point, w, jnp.asarray(-setting.plan.upstream, one.dtype))
    distance = stop(shape.distance(start, w))
    met = (distance < FAR) & (beam.radius > 1e-6)
    held = along(start, w, jnp.where(met, distance, setting.plan.upstream))
    # The same places among the cells.
    field = shape.heights
    x, y = (field.origin[k] + field.spacing[k] * stop(at) for k, at in enumerate(field.place(held)))
    height, (east, north) = field.with_slope((x, y))
    place = (x, y, height)
    turned = to_frame(beam.axis, place)
    wider = beam.slant_range / (beam.slant_range + turned[2])
    moved = (turned[0] * wider, turned[1] * wider)
    _, way, _ = beam.ray(moved)
    facing = jnp.abs(way[2] - east * way[0] - north * way[1])
    area = field.spacing[0] * field.spacing[1] * beam.radius**2
    density = jnp.where(met, beam.irradiance(moved) * area * facing * wider**2, 1.0)
    held_density = stop(density)
    change = jnp.where(met, density / jnp.maximum(held_density, 1e-30), 1.0)
    x, y = (with_derivative_of(a, jnp.where(met, a + (b - stop(b)), a)) for a, b in zip(across, moved))
    return (x, y), with_derivative_of(one, change)


def footprint_rays(
    beam: Beam, medium: Medium | None, across: tuple[Scalar, Scalar]
) -> tuple[tuple[Scalar, Scalar], Scalar]:
    """The rays of the footprint, moved with the columns of the grid, and the change of their energy.

    Values do not change, only derivatives. The optical depth of a nearly vertical ray jumps where it crosses
    into another column, so its derivative with respect to a sideways motion of the grid lies in rare, nearly
    parallel crossings. Rays that move along with the columns do not cross, and the profile of a Gaussian beam
    makes up for their motion. The edge of a top-hat would not, so its rays stay, and that derivative stays
    noisy.
    """
    if medium is None or not beam.gaussian:
        return across, jnp.ones_like(across[0])
    # A beam without width has no profile that could make up for it.
    wide = beam.radius > 1e-6
    across_axis = from_frame(beam.axis, (*across, jnp.zeros_like(across[0])))
    # Where the rays meet the reference plane.
    flat = along(across_axis, beam.axis, -across_axis[2] / beam.axis[2])
    moved = []
    for k in range(2):
        place = stop((flat[k] - medium.origin[k]) / medium.size[k])
        now = medium.origin[k] + medium.size[k] * place
        moved.append(jnp.where(wide, now - stop(now), 0.0))
    shift = to_frame(beam.axis, (*moved, jnp.zeros_like(across[0])))
    across = (across[0] + shift[0], across[1] + shift[1])
    # Rays lie farther apart where voxels or the beam are wider.
    area = medium.size[0] * medium.size[1] * beam.radius**2
    density = jnp.where(wide, beam.irradiance(across) * area, 1.0)
    held = stop(density)
    return across, 1.0 + (density - held) / jnp.maximum(held, 1e-30)
