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
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlidar._vectors import vec
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.first.first_order import FirstOrderTally, FirstOrderTracer, send_rays
from jaxlidar.trace.first.footprint import Beam, RaySlice, fibonacci_disc
from jaxlidar.trace.response import Response, fates_after_first_scattering, histories_to_traces


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
    """

    lattice: Int[Array, "parts"]
    energy: Float[Array, "parts"]
    beams: Beam
    aims: Float[Array, "parts 3"]
    shifts: Float[Array, "parts 2"]
    ray_slices: RaySlice


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
    energy = energy * parts.energy[:, None]
    part = jnp.repeat(jnp.arange(len(parts.lattice), dtype=jnp.int32), n_rays)
    # Arrays with a number for each ray take the place of the numbers of one beam.
    chunk = dataclasses.replace(scene, beam=jax.tree.map(lambda a: a[part], parts.beams))
    flat_across = (across[0].reshape(-1), across[1].reshape(-1))
    lattice, aim = parts.lattice[part], vec(parts.aims[part].T)
    rays = send_rays(chunk, flat_across, energy.reshape(-1), group=lattice, aim=aim)
    return FirstOrderTracer(chunk, n_groups=n_lattices).add_rays(tally, rays)


def lattice_sums(scene: DeviceScene, tally: FirstOrderTally, n_lattices: int) -> LatticeSums:
    """Return the sums of each lattice, along axis 0 of arrays."""
    tally = FirstOrderTracer(scene, n_groups=n_lattices).smooth(tally)

    def by_lattice(a: Float[Array, "rows *s"]) -> Float[Array, "lattices materials *s"]:
        return jnp.swapaxes(a.reshape(-1, n_lattices, *a.shape[1:]), 0, 1)

    weights, outside = scene.bins.trim(by_lattice(tally.returned))
    return LatticeSums(
        weights, outside, by_lattice(tally.arrived), by_lattice(tally.scattered), tally.escaped
    )


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
