r"""Order one of parts of lattices, of several shots, all marched side by side.

A narrow footprint needs few rays, and a compiled program spends as much time between its kernels as in them
where arrays are that short. A part is a few rays of one lattice of one shot. The rays of many parts make up
one chunk of rays, each with the beam and the aim point of its shot, and with a row in the tally for each
material and part: what a material returns has one history where no plate is in its path.

The estimates are those of `jaxlidar.trace.response.trace_first_only` for the same rays.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._products import einsum
from jaxlidar._vectors import vec
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.first_order import FirstOrderTracer, send_rays
from jaxlidar.trace.footprint import Beam, RaySlice, fibonacci_disc
from jaxlidar.trace.response import Response, fates_after_first_scattering


class LatticeSums(NamedTuple):
    """Sums over the rays of a lattice, or of a part of it, per unit optics.

    `weights`: what each material returns, by fine bin; `outside`: before the first bin and after the last.
    `arrived`, `scattered`, `escaped`: as in `jaxlidar.trace.first_order.FirstOrder`, without histories.
    """

    weights: Float[Array, "*s materials bins"]
    outside: Float[Array, "*s materials"]
    arrived: Float[Array, "*s materials"]
    scattered: Float[Array, "*s materials"]
    escaped: Float[Array, "*s"]


def can_trace_parts(scene: DeviceScene) -> bool:
    """Return True for scenes of a medium without plates or mirrors, if no leaf transmits straight on."""
    has_mirrors = any(scene.config.mirrors) and scene.config.returns_specular
    is_simple = scene.straight_transmittance is None and not has_mirrors
    return scene.medium is not None and is_simple and not any(s.is_plate for s in scene.surfaces)


def trace_parts(
    scene: DeviceScene,
    beams: Beam,
    aims: Float[Array, "parts 3"],
    shifts: Float[Array, "parts 2"],
    ray_slices: RaySlice,
    n_rays: int,
) -> LatticeSums:
    """Trace order one of parts of lattices. Each carries the energy of the complete beam.

    **Arguments:**

    - `scene`: one for which `can_trace_parts`, without derivatives.
    - `beams`, `aims`: of the shot of each part, along axis 0 of arrays: the beam about its aim point, and the
      aim point in the coordinates of the scene, m.
    - `shifts`, `ray_slices`: of the lattice of each part, and which part it is, as `fibonacci_disc` takes
      them.
    - `n_rays`: rays of a part.
    """
    n_parts, n_materials, bins = len(aims), len(scene.config.materials), scene.bins
    across, energy = jax.vmap(lambda beam, *lattice: fibonacci_disc(beam, n_rays, *lattice))(
        beams, shifts, ray_slices
    )
    part = jnp.repeat(jnp.arange(n_parts, dtype=jnp.int32), n_rays)
    # Arrays with a number for each ray take the place of the numbers of one beam.
    chunk = dataclasses.replace(scene, beam=jax.tree.map(lambda a: a[part], beams))
    flat_across = (across[0].reshape(-1), across[1].reshape(-1))
    rays = send_rays(chunk, flat_across, energy.reshape(-1), group=part, aim=vec(aims[part].T))
    tally = FirstOrderTracer(chunk, n_groups=n_parts).trace_rays(rays)
    by_material = (n_parts, n_materials)
    weights, outside = bins.trim(tally.returned.reshape(*by_material, bins.padded))
    arrived, scattered = tally.arrived.reshape(by_material), tally.scattered.reshape(by_material)
    return LatticeSums(weights, outside, arrived, scattered, tally.escaped)


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
    departed, escapes, remaining = fates_after_first_scattering(
        scene, arrivals, unscattered(scattered), unscattered(escaped)
    )
    monomials = histories.monomials(optics)
    arrivals, departed = (einsum("mh,hw->wm", a, monomials)[..., None] for a in (arrivals, departed))
    escapes, remaining = (einsum("h,hw->w", a, monomials)[:, None] for a in (escapes, remaining))
    return Response(
        first=(reflectance[..., None] * weights[None])[:, :, None],
        higher=None,
        first_outside=(reflectance * outside[None])[..., None],
        higher_outside=None,
        arrived=arrivals,
        departed=departed,
        escaped=escapes,
        late=jnp.zeros_like(remaining),
        remaining=remaining,
    )
