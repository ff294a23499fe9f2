"""Absorption and escape: light that is followed to its end, without time and without a last order.

Photons carry their energy at every wavelength; optics are applied at every scattering. A collision of energy
E with a material (R, T) absorbs E (1 - R a - T), tallied as its expectation, with a the albedo of the law.
The photon goes on by one sampled channel, with E R a or E T divided by the probability of that channel: in
the mean E (R a + T), so that energy is conserved in the mean.

Russian roulette: with E the largest energy of any wavelength, relative to the emitted one, a photon of E < f
survives with the probability E / f, and its energies are divided by that. This is unbiased.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxlidar._jax.vmapped_loops import any_problem
from jaxlidar._vectors import Vec, along, vec
from jaxlidar.planning.config import Scatterer
from jaxlidar.scenes.height_field import HeightField
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.first.footprint import across_beam
from jaxlidar.trace.march.flight import SurfaceEncounters
from jaxlidar.trace.march.meshes import clear_of_mesh
from jaxlidar.trace.photons.photon_step import collide, fly_once, passed_plates, start_photons
from jaxlidar.trace.photons.photons import TRANSMITTED, Photons

# Below this fraction of the emitted energy a photon may be ended.
_ROULETTE_ENERGY = 0.05


class EnergyFractions(eqx.Module):
    """Fractions of the emitted energy by fate, the mean of photons.

    - `absorbed`: by each material. - `up`, `down`: left the scene upward, or downward where there is no
      ground.
    - `on_ground`: arrived at the ground, every time it did. - `unfollowed`: flew farther than flights are
      followed, or was not at its end when the last order was reached.
    """

    absorbed: Float[Array, "materials wavelengths"]
    up: Float[Array, "wavelengths"]
    down: Float[Array, "wavelengths"]
    on_ground: Float[Array, "wavelengths"]
    unfollowed: Float[Array, "wavelengths"]


class _PhotonLoop(eqx.Module):
    """State of the loop over orders: photons, their energy, sums so far, and the order."""

    photons: Photons
    energy: Float[Array, "photons wavelengths"]
    fractions: EnergyFractions
    order: Int[Array, ""]


def from_beam(scene: DeviceScene, key: PRNGKeyArray, count: int) -> tuple[Vec, Vec]:
    """Sample starts above the scene and directions of light of the beam."""
    fraction, turn = jax.random.uniform(key, (2, count))
    point, w, _ = scene.beam.ray(across_beam(scene.beam, fraction, turn))
    return along(point, w, jnp.asarray(-scene.limits.start_distance, fraction.dtype)), w


def from_parallel_light(scene: DeviceScene, key: PRNGKeyArray, count: int) -> tuple[Vec, Vec]:
    """Sample collimated light in the direction of the beam, uniform over one period of the voxel map.

    It starts at the top of the map, or of the terrain where that is higher.
    """
    medium = scene.medium
    assert medium is not None
    u, v = jax.random.uniform(key, (2, count))
    low, high = medium.origin, medium.origin + medium.size * medium.counts
    x, y = (low[k] + s * (high[k] - low[k]) for k, s in enumerate((u, v)))
    top = jnp.full_like(u, high[2])
    for surface in scene.surfaces:
        if isinstance(surface.shape, HeightField):
            top = jnp.maximum(top, surface.shape.highest)
    return (x, y, top), vec(jnp.broadcast_to(c, u.shape) for c in scene.beam.axis)


def trace_to_end(
    scene: DeviceScene,
    optics: Float[Array, "channels wavelengths"],
    key: PRNGKeyArray,
    count: int,
    source: Callable[[DeviceScene, PRNGKeyArray, int], tuple[Vec, Vec]],
    max_orders: int,
) -> EnergyFractions:
    """Trace photons of a source to their ends, at most through `max_orders` scatterings.

    1. Sample the starts and directions of `count` photons, each of energy one.
    2. Trace order after order while any photon lives.
    3. Count the energy that the last order leaves as unfollowed.
    4. Divide all sums by the number of photons.

    **Arguments:**

    - `optics`: reflectance or transmittance of every channel.
    - `count`: number of photons.
    - `source`: returns starts and directions of `count` photons, as `from_beam` does.
    """
    start_key, key = jax.random.split(key)
    x, w = source(scene, start_key, count)
    # Weight and history stay as they are: the energy is an array of its own, by wavelength.
    photons = start_photons(x, w, jnp.zeros_like(x[0]))
    n_wavelengths = optics.shape[1]
    zeros = jnp.zeros((n_wavelengths,), optics.dtype)
    absorbed = jnp.zeros((len(scene.config.materials), n_wavelengths), optics.dtype)
    fractions = EnergyFractions(absorbed, zeros, zeros, zeros, zeros)
    energy = jnp.ones((count, n_wavelengths), optics.dtype)
    # A loop of unknown length: energy is followed until no photon is left, which no fixed number of orders
    # would do. It has no reverse derivative; `energy_budget` needs none.
    start = _PhotonLoop(photons, energy, fractions, jnp.zeros((), jnp.int32))

    def continue_(loop: _PhotonLoop) -> Bool[Array, ""]:
        return any_problem(loop.photons.alive) & (loop.order < max_orders)

    def step(loop: _PhotonLoop) -> _PhotonLoop:
        return _trace_order(scene, optics, loop, jax.random.fold_in(key, loop.order))

    end = jax.lax.while_loop(continue_, step, start)
    # What the last order leaves is not followed, and is reported so.
    after_last = jnp.sum(jnp.where(end.photons.alive[:, None], end.energy, 0.0), axis=0)
    unfollowed = end.fractions.unfollowed + after_last
    fractions = eqx.tree_at(lambda f: f.unfollowed, end.fractions, unfollowed)
    return jax.tree.map(lambda a: a / count, fractions)


def _trace_order(scene: DeviceScene, optics: Array, loop: _PhotonLoop, key: PRNGKeyArray) -> _PhotonLoop:
    """Trace photons through one order of scattering.

    1. Find the surfaces ahead, and sample the flight.
    2. Apply the plates that transmit light straight on, and tally what they absorb.
    3. Tally light that escapes, or flies farther than flights are followed.
    4. Sample the collision, and tally what its material absorbs.
    5. Multiply the energy by the optics of the sampled channel; end faint photons by Russian roulette.
    """
    config, p, energy, fractions = scene.config, loop.photons, loop.energy, loop.fractions
    draw_key, roulette_key = jax.random.split(key)
    # Light is followed however late it would come, within the length that bounds the march.
    max_length = jnp.full_like(p.weight, scene.limits.max_flight)
    # Ratios of flights and of plate outcomes are one in value, and no derivatives are taken. The weight of
    # the collision is not one: it is used below.
    draws, encounters, flight = fly_once(scene, p, draw_key, max_length)

    def optics_at(channel: int) -> Float[Array, "1 wavelengths"]:
        return optics[channel : channel + 1] if channel >= 0 else jnp.zeros_like(optics[:1])

    def absorbed_of(scatterer: Scatterer, arriving: Array, albedo: Array) -> Array:
        """Sum of the arriving energy that a material absorbs; `albedo`: of the law."""
        reflected = optics_at(scatterer.reflection) * albedo[:, None]
        return jnp.sum(arriving * (1.0 - reflected - optics_at(scatterer.transmission)), axis=0)

    # Within the medium everything that is not absorbed goes on.
    full_albedo = jnp.ones_like(p.weight)
    absorbed = fractions.absorbed
    # Each plate needs what arrives at it, in order of distance; the product of all factors needs no order.
    energy_before = energy
    for passage in passed_plates(scene, p, flight, encounters):
        scatterer, is_transmitted = config.surfaces[passage.plate], passage.is_transmitted[:, None]
        arriving = _arriving_energy(scene, optics, energy_before, encounters, passage.plate)
        arriving = jnp.where(is_transmitted, arriving, 0.0)
        # The expectation is over reflection as well, by the law, whatever was sampled.
        distance = jnp.where(passage.is_transmitted, encounters.distances[passage.plate], 0.0)
        point, surface = along(p.x, p.w, distance), scene.surfaces[passage.plate]
        albedo = surface.scale_by_pattern(point, surface.law.albedo(p.w, surface.lit_normal(point, p.w)))
        absorbed = absorbed.at[scatterer.material].add(absorbed_of(scatterer, arriving, albedo))
        factor = optics_at(scatterer.transmission) / (1.0 - scene.limits.reflection_probability)
        energy = jnp.where(is_transmitted, energy * factor, energy)

    escaped = jnp.where(flight.escaped[:, None], energy, 0.0)
    upward = (p.w[2] > 0)[:, None]
    outside = jnp.where(flight.outside[:, None], energy, 0.0)
    x, path, collision = collide(scene, p, flight, encounters, draws)
    energy = jnp.where(flight.has_hit[:, None], energy, 0.0)
    for scatterer in (config.leaf, config.bark):
        if scatterer is not None:
            on_material = flight.collided & (collision.material == scatterer.material)
            arriving = jnp.where(on_material[:, None], energy, 0.0)
            absorbed = absorbed.at[scatterer.material].add(absorbed_of(scatterer, arriving, full_albedo))
    on_ground = fractions.on_ground
    for surface, on_surface, scatterer in zip(scene.surfaces, flight.landed_on(encounters), config.surfaces):
        arriving = jnp.where(on_surface[:, None], energy, 0.0)
        normal = surface.lit_normal(x, p.w, encounters.mesh_normal)
        albedo = surface.scale_by_pattern(x, surface.law.albedo(p.w, normal))
        absorbed = absorbed.at[scatterer.material].add(absorbed_of(scatterer, arriving, albedo))
        if not (surface.is_plate or surface.is_mesh):
            on_ground = on_ground + jnp.sum(arriving, axis=0)

    # Photons that hit zeros have the channel -1, and the energy zero.
    channel = jnp.maximum(collision.channel, 0)
    energy = energy * optics[channel] * (collision.weight * collision.onward_weight)[:, None]
    alive = flight.has_hit & (jnp.max(energy, axis=1) > 0)
    # By the largest energy of all wavelengths: one photon carries them all, and ends for all at once.
    survival = jnp.minimum(jnp.max(energy, axis=1) / _ROULETTE_ENERGY, 1.0)
    survives = alive & (jax.random.uniform(roulette_key, survival.shape, survival.dtype) < survival)
    energy = jnp.where(survives[:, None], energy / jnp.where(survives, survival, 1.0)[:, None], 0.0)
    photons = Photons(
        x=clear_of_mesh(scene, x, collision.w, collision.surface, collision.normal),
        w=collision.w,
        path=path,
        weight=p.weight,
        history=p.history,
        surface=collision.surface,
        last_scattering=collision.last_scattering,
        alive=survives,
    )
    fractions = EnergyFractions(
        absorbed=absorbed,
        up=fractions.up + jnp.sum(jnp.where(upward, escaped, 0.0), axis=0),
        down=fractions.down + jnp.sum(jnp.where(upward, 0.0, escaped), axis=0),
        on_ground=on_ground,
        unfollowed=fractions.unfollowed + jnp.sum(outside, axis=0),
    )
    return _PhotonLoop(photons, energy, fractions, loop.order + 1)


def _arriving_energy(
    scene: DeviceScene, optics: Array, energy: Array, encounters: SurfaceEncounters, plate: int
) -> Array:
    """Return the energy that arrives at a plate: after transmission by the plates that lie nearer."""
    for j, surface in enumerate(scene.surfaces):
        scatterer, outcome = scene.config.surfaces[j], encounters.outcomes[j]
        if j == plate or not surface.is_plate or scatterer.transmission < 0:
            continue
        is_nearer = encounters.distances[j] < encounters.distances[plate]
        transmitted = is_nearer & (outcome == TRANSMITTED)
        factor = optics[scatterer.transmission][None, :] / (1.0 - scene.limits.reflection_probability)
        energy = jnp.where(transmitted[:, None], energy * factor, energy)
    return energy
