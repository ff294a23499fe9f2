"""Geometry traced once: the response of a scene to a pulse without duration, for any optics.

    received[wavelength, bin] = sum over histories h of
        response[bin, h] * prod over letters s of optics_s[wavelength] ** exponent[h, s]

known in biomedical optics as white Monte Carlo (Alerstam et al. 2008).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.laws import Specular
from jaxlidar.planning.effects import without
from jaxlidar.planning.plan import Plan
from jaxlidar.scenes.scene import Scene
from jaxlidar.trace.first_order import FirstOrder, first_order
from jaxlidar.trace.footprint import Beam, beam_of, lattice, product_rule, scattered
from jaxlidar.trace.higher_orders import higher_orders
from jaxlidar.trace.histories import Histories, histories
from jaxlidar.trace.march import Medium, medium_of
from jaxlidar.trace.mirror import mirror_rays
from jaxlidar.trace.surfaces import Surface, surfaces_of


class Response(eqx.Module):
    """Geometric weight of all paths, by last material, history and fine time bin.

    - `first`: (materials, first histories, bins) order one, apparent reflectance per unit optics.
    - `higher`: (materials, histories, bins) orders two and above, or None where they were not traced.
    - `arrived`, `left`: (materials, histories) weight that reached each material, and that went on.
    - `escaped`, `late`, `remaining`: (histories,) weight that left the scene, that outlasted the window, and
      that had scatterings left when the last order was reached.
    """

    first: Float[Array, "materials short bins"]
    higher: Float[Array, "materials histories bins"] | None
    arrived: Float[Array, "materials histories"]
    left: Float[Array, "materials histories"]
    escaped: Float[Array, "histories"]
    late: Float[Array, "histories"]
    remaining: Float[Array, "histories"]


def geometry_of(
    lidar: Lidar, scene: Scene, leaf_transmittance: Float[Array, ""] | float
) -> tuple[Beam, Medium | None, tuple[Surface, ...]]:
    """Beam, voxels and planes relative to where the beam's axis meets the reference plane."""
    aim = jnp.concatenate([lidar.position, jnp.zeros_like(lidar.position[:1])])
    medium = None
    if scene.canopy is not None:
        straight = scene.canopy.transmission == "straight"
        factor = jnp.asarray(1.0 - leaf_transmittance if straight else 1.0)
        medium = medium_of(scene.canopy.voxels, aim, scene.canopy.sides == "periodic", factor)
    return beam_of(lidar), medium, surfaces_of(scene, aim)


def trace_scene(
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    key: PRNGKeyArray,
    leaf_transmittance: Float[Array, ""] | float = 0.0,
) -> Response:
    """One batch: the deterministic first order and `plan.n_photons` photons for the higher ones.

    A pure function of arrays, to be compiled, batched and differentiated. `leaf_transmittance` matters only
    where the canopy's transmission is straight; extinction is then scaled by one minus it.
    """
    lidar, scene = without(lidar, scene, plan.off)
    trace, bins = plan.trace, plan.bins
    beam, medium, surfaces = geometry_of(lidar, scene, leaf_transmittance)
    table = histories(len(trace.letters), plan.degree)
    short = histories(len(trace.letters), plan.first_degree)
    # What is not random is compiled without random numbers.
    shift_key, photon_key = jax.random.split(key) if plan.is_random else (key, key)

    if plan.smooth_footprint:
        across, energy = product_rule(beam)
    elif trace.independent:
        across, energy = scattered(beam, plan.n_rays, shift_key)
    else:
        shift = jax.random.uniform(shift_key, (2,)) if plan.random_footprint else jnp.asarray([0.5, 0.0])
        across, energy = lattice(beam, plan.n_rays, shift)
    first = first_order(beam, medium, surfaces, trace, short, bins, across, energy)
    weights = jnp.zeros_like(first.weights) if trace.drawn_first else first.weights
    for i, surface in enumerate(surfaces):
        if isinstance(surface.law, Specular) and "specular return" not in plan.off:
            weights = weights + _mirror(beam, medium, surfaces, i, plan, short)

    if trace.orders < 2 and not trace.drawn_first:
        straight = [s.straight for s in surfaces]
        return _only_first(first, weights, plan, short, straight)
    higher = higher_orders(beam, medium, surfaces, trace, table, bins, photon_key, plan.n_photons)
    return Response(
        weights, higher.weights, higher.arrived, higher.left, higher.escaped, higher.late, higher.remaining
    )


def _mirror(
    beam: Beam, medium: Medium | None, surfaces: tuple, which: int, plan: Plan, table: Histories
) -> Float[Array, "materials short bins"]:
    """What comes back from one mirror, through all that lies before it."""
    across, value = mirror_rays(beam, surfaces[which])
    # As if it were a Lambertian sheet met at normal incidence, weighted by what the mirror returns.
    plain = eqx.tree_at(lambda s: s.law, surfaces[which], _Facing())
    others = tuple(plain if i == which else s for i, s in enumerate(surfaces))
    response = first_order(beam, medium, others, plan.trace, table, plan.bins, across, value)
    material = plan.trace.surfaces[which].material
    keep = jnp.arange(response.weights.shape[0]) == material
    return jnp.where(keep[:, None, None], response.weights, 0.0)


class _Facing(eqx.Module):
    """View factor one: the value is already in the weight of the ray."""

    def view_factor(self, incident, normal, view, half_angle):
        return jnp.ones_like(incident[0])


def _only_first(
    first: FirstOrder,
    weights: Float[Array, "materials short bins"],
    plan: Plan,
    table: Histories,
    straight: list[bool],
) -> Response:
    """The fate of light when nothing is followed beyond the first scattering: what scatters remains."""
    trace = plan.trace
    left = jnp.zeros_like(first.arrived)
    remaining = jnp.zeros_like(first.escaped)
    scatterers = [(s, False) for s in (trace.leaf, trace.bark) if s is not None]
    scatterers += list(zip(trace.surfaces, straight))
    for s, passes in scatterers:
        for letter in (s.reflected, s.transmitted):
            if letter < 0:
                continue
            after = table.successor[:, letter]
            grown = jnp.where(after != jnp.arange(table.count), first.arrived[s.material], 0.0)
            left = left.at[s.material, after].add(grown)
            # What goes straight through a plate was followed to what lies behind it.
            if not (passes and letter == s.transmitted):
                remaining = remaining.at[after].add(grown)
    escaped, late = first.escaped, jnp.zeros_like(remaining)
    if len(scatterers) == 1 and not (trace.leaf or trace.bark):
        # Nothing is in the way of what one plane scatters.
        escaped, remaining = escaped + remaining, late
    return Response(weights, None, first.arrived, left, escaped, late, remaining)
