r"""Order one of parts of lattices, of several shots, all marched side by side.

A narrow footprint needs few rays, and a compiled program spends as much time between its kernels as in them
where arrays are that short. A part is a few rays of one lattice of one shot. The rays of many parts make up
one chunk of rays, each with the beam and the aim point of its shot. The tally has a row for each material and
lattice: what a material returns has one history where no plate is in its path. Chunk after chunk is added to
one tally, which is smoothed and trimmed at the end: with its hundreds of bins for a few rays, that would take
longer than the march.

The estimates are those of `trace.response.trace_first_only` for the same rays.
"""

import dataclasses
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._vectors import vec
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.first.first_order import FirstOrderTally, FirstOrderTracer, send_rays
from jaxlidar.trace.first.footprint import (
    Beam,
    FootprintStrips,
    RaySlice,
    fibonacci_disc,
    spread_over_strips,
)
from jaxlidar.trace.response import Response, fates_after_first_scattering, histories_to_traces

T = TypeVar("T")

# Strips with less than this fraction of a beam's energy get no more rays than that.
_LEAST_ENERGY = 1e-6


class LatticeSums(NamedTuple):
    """Sums over the rays of a lattice, per unit optics.

    `weights`: what each material returns, by fine bin; `outside`: before the first bin and after the last.
    `arrived`, `scattered`, `escaped`: as in `trace.first.first_order.FirstOrder`, without histories.
    """

    weights: Float[Array, "*s materials bins"]
    outside: Float[Array, "*s materials"]
    arrived: Float[Array, "*s materials"]
    scattered: Float[Array, "*s materials"]
    escaped: Float[Array, "*s"]


class LatticeParts(NamedTuple):
    """Parts of lattices, along axis 0 of arrays.

    - `lattice`: number of the lattice in the tally. - `energy`: fraction of the beam's.
    - `beams`, `aims`: of the shot: the beam about its aim point, and the aim point in the coordinates of the
      scene, m.
    - `shifts`, `ray_slices`: of the lattice, and which part it is, as `fibonacci_disc` takes them.
    - `strips`: over which the rays are spread; None: they have equal energies.
    """

    lattice: Int[Array, "parts"]
    energy: Float[Array, "parts"]
    beams: Beam
    aims: Float[Array, "parts 3"]
    shifts: Float[Array, "parts 2"]
    ray_slices: RaySlice
    strips: FootprintStrips | None = None


def can_trace_parts(scene: DeviceScene) -> bool:
    """Return True for scenes of a medium without plates or mirrors, if no leaf transmits straight on."""
    has_mirrors = any(scene.config.mirrors) and scene.config.returns_specular
    is_simple = scene.straight_transmittance is None and not has_mirrors
    return scene.medium is not None and is_simple and not any(s.is_plate for s in scene.surfaces)


def empty_tally(scene: DeviceScene, n_lattices: int) -> FirstOrderTally:
    """Return the tally of lattices without rays."""
    return FirstOrderTracer(scene, n_groups=n_lattices).empty_tally(jnp.zeros_like(scene.beam.radius))


def add_parts(
    scene: DeviceScene, tally: FirstOrderTally, parts: LatticeParts, n_lattices: int, n_rays: int
) -> FirstOrderTally:
    """Trace order one of parts of `n_rays` rays, and add them to the tally of their lattices.

    `scene`: one for which `can_trace_parts`, without derivatives.
    """
    across, energy = jax.vmap(lambda beam, *lattice: fibonacci_disc(beam, n_rays, *lattice))(
        parts.beams, parts.shifts, parts.ray_slices
    )
    if parts.strips is not None:
        strips = parts.strips
        across, energy = jax.lax.cond(
            jnp.any(strips.weight != 1.0),
            lambda: jax.vmap(spread_over_strips)(parts.beams, across, energy, strips),
            lambda: (across, energy),
        )
    energy = energy * parts.energy[:, None]
    part = jnp.repeat(jnp.arange(len(parts.lattice), dtype=jnp.int32), n_rays)
    # Arrays with a number for each ray take the place of the numbers of one beam.
    chunk = dataclasses.replace(scene, beam=jax.tree.map(lambda a: a[part], parts.beams))
    flat_across = (across[0].reshape(-1), across[1].reshape(-1))
    lattice, aim = parts.lattice[part], vec(parts.aims[part].T)
    rays = send_rays(chunk, flat_across, energy.reshape(-1), group=lattice, aim=aim)
    return FirstOrderTracer(chunk, n_groups=n_lattices).add_rays(tally, rays)


def strips_of_columns(
    scene: DeviceScene,
    beam: Beam,
    aim: Float[Array, "3"],
    n_rays: Int[Array, ""] | int,
    n_lattices: int,
    is_spread: Bool[Array, ""],
) -> FootprintStrips:
    """Return the strips of a beam straight down over the five columns nearest to it along each axis.

    Where a footprint grazes a column, no ray of equal energy may meet it, and nothing tells that it was
    missed. So each strip gets at least one of `n_rays` rays of all lattices for every lattice.

    The number of rays in a strip is a whole one. Where it is the same in all lattices, their scatter does not
    tell that it is rounded. So lattices weight the rays of the outer strips by 1 + h / (n m (1 - m)), where m
    is their fraction of the n rays and h = 1 in one half of the lattices, -1 in the other. The signs are
    those of a Hadamard matrix: they cancel in the mean. The standard error of the mean then contains 0.27 of
    a ray, beside 12^-1/2 of a ray by rounding.

    `is_spread`: False for the strips of rays of equal energies.
    """
    medium = scene.medium
    assert medium is not None
    # Rays are farthest from the axis at the lowest voxels. The frame of a beam straight down has its axes to
    # the east and to the south.
    shrinking = 1.0 - (medium.origin[2] - aim[2]) / beam.slant_range
    size, corner = medium.size[:2] / shrinking, (medium.origin[:2] - aim[:2]) / shrinking
    column = jnp.floor(-corner / size)[:, None] + jnp.arange(-1.0, 3.0, dtype=aim.dtype)[None]
    edges = corner[:, None] + size[:, None] * column
    edges = jnp.stack([edges[0], -edges[1, ::-1]])
    bounds = jnp.pad(ndtr(edges / (0.5 * beam.radius)), ((0, 0), (1, 0)))
    energy = jnp.diff(bounds, axis=1, append=1.0)

    n = jnp.maximum(n_rays, n_lattices).astype(aim.dtype)
    gets_rays = is_spread & (energy > _LEAST_ENERGY)
    rays = jnp.where(gets_rays, jnp.maximum(energy, n_lattices / n), energy)
    rays = rays / jnp.sum(rays, axis=1, keepdims=True)
    stretch = energy / jnp.where(rays > 0.0, rays, 1.0)
    is_part = gets_rays & (rays < 1.0)
    one_ray = jnp.where(is_part, 1.0 / (n * jnp.where(is_part, rays * (1.0 - rays), 1.0)), 0.0)
    weight = stretch[None] * (1.0 + jnp.asarray(_signs(n_lattices), aim.dtype) * one_ray[None])
    strips = FootprintStrips(
        jnp.cumsum(rays, axis=1) - rays, bounds, stretch, jnp.where(is_spread, weight, 1.0)
    )
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (n_lattices, *energy.shape)), strips)


def _signs(n_lattices: int) -> Int[np.ndarray, "lattices axes strips"]:
    """Return a sign for each lattice and outer strip, zero for the strip in the middle."""
    signs = scipy.linalg.hadamard(n_lattices)
    # Its first row is that of the mean. There are eight outer strips for seven rows: those farthest apart
    # have one in common.
    zero = np.zeros_like(signs[0])
    east, south = (1, 2, 3, 4), (5, 6, 7, 1)
    return np.stack(
        [[signs[i], signs[j], zero, signs[k], signs[m]] for i, j, k, m in (east, south)]
    ).transpose(2, 0, 1)


def lattice_sums(scene: DeviceScene, tally: FirstOrderTally, n_lattices: int) -> LatticeSums:
    """Return the sums of each lattice, along axis 0 of arrays."""
    tally = FirstOrderTracer(scene, n_groups=n_lattices).smooth(tally)

    def by_lattice(a: Float[Array, "rows *s"]) -> Float[Array, "lattices materials *s"]:
        return jnp.swapaxes(a.reshape(-1, n_lattices, *a.shape[1:]), 0, 1)

    weights, outside = scene.bins.trim(by_lattice(tally.returned))
    return LatticeSums(
        weights, outside, by_lattice(tally.arrived), by_lattice(tally.scattered), tally.escaped
    )


def energy_of_lattices(sums: LatticeSums, strips: FootprintStrips) -> Float[Array, "lattices"]:
    """Return the energy of all rays of each lattice of a shot, along axis 0 of arrays.

    It is one but where rays are spread over strips: the number of rays in a strip varies with the shift.
    """
    # What does not escape arrives at a material. A shot without rays has no energy.
    energy = jnp.sum(sums.arrived, axis=-1) + sums.escaped
    return jnp.where(jnp.any(strips.weight != 1.0) & (jnp.sum(energy) > 0.0), energy, 1.0)


def per_unit_energy(values: T, energy: Float[Array, "lattices"]) -> T:
    """Return values of lattices, along axis 0 of arrays, whose mean is per unit energy of all of their rays.

    With the values Y_j and the energies E_j of lattices, and their means Y and E, the ratio Y / E is the mean
    of

        Z_j = Y / E + (Y_j - Y E_j / E) / E

    whose scatter is that of the ratio to first order (Cochran 1977, Sampling Techniques, section 6.3).
    """
    mean_energy = jnp.mean(energy)

    def ratio(a: Float[Array, "lattices *s"]) -> Float[Array, "lattices *s"]:
        excess = (energy / mean_energy - 1.0).reshape(-1, *[1] * (a.ndim - 1))
        return (a - excess * jnp.mean(a, axis=0, keepdims=True)) / mean_energy

    return jax.tree.map(ratio, values)


def response_of_lattice(
    scene: DeviceScene, sums: LatticeSums, optics: Float[Array, "channels wavelengths"]
) -> Response:
    """Return the response of one lattice with optics applied: a trace for each wavelength, and one history.

    `optics`: reflectance or transmittance of every channel.
    """
    config, histories = scene.config, scene.first_histories
    weights, outside, arrived, scattered, escaped = sums
    # Reflectance of each material: (wavelengths, materials).
    scatterers = [s for s in (config.leaf, config.bark, *config.surfaces) if s is not None]
    channel = {s.material: s.reflection for s in scatterers}
    reflectance = optics.T[:, jnp.asarray([channel[m] for m in range(len(config.materials))])]

    def unscattered(a: Float[Array, "*s"]) -> Float[Array, "*s histories"]:
        return jnp.zeros((*a.shape, histories.count), a.dtype).at[..., 0].set(a)

    arrivals = unscattered(arrived)
    departed, escapes, unfollowed = fates_after_first_scattering(
        scene, arrivals, unscattered(scattered), unscattered(escaped)
    )
    budget = (arrivals, departed, escapes, unfollowed)
    arrivals, departed, escapes, unfollowed = histories_to_traces(budget, histories, optics)
    return Response(
        first=(reflectance[..., None] * weights[None])[:, :, None],
        higher=None,
        first_outside=(reflectance * outside[None])[..., None],
        higher_outside=None,
        arrived=arrivals,
        departed=departed,
        escaped=escapes,
        flown_outside=jnp.zeros_like(unfollowed),
        unfollowed=unfollowed,
    )
