"""One step of photons, in the parts that all estimators share: fly, pass plates, collide.

The response (`trace.photons.higher_orders`), with the energy budget (`trace.photons.absorption`), and the
estimator of the paper (`examples/paper`) follow photons in the same way, and differ in what they add to a
tally on the way:

1. `meet_surfaces` and `sample_flights` say where a flight ends (`trace.march.flight`).
2. `passed_plates` says which plates the flight has passed, and which of these transmitted the photon.
3. `collide` samples the collision at the end (`trace.photons.collisions`).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxlidar._vectors import FAR, Scalar, Vec, along, dot
from jaxlidar.trace.device_scene import DeviceScene, not_scattered
from jaxlidar.trace.march.flight import Flight, SurfaceEncounters
from jaxlidar.trace.photons.collisions import sample_collision
from jaxlidar.trace.photons.photons import STOPPED, TRANSMITTED, Collision, Photons
from jaxlidar.trace.photons.random_numbers import PhotonDraws


def start_photons(
    scene: DeviceScene,
    entry: tuple[Scalar, Scalar],
    weight: Scalar,
    index: Int[Array, "photons"],
    alive: Bool[Array, "photons"],
) -> Photons:
    """Start photons above everything in the scene, on the rays through `entry`, m across the beam.

    `index`: the history, or the entry node, which takes its place.
    """
    point, w, excess = scene.beam.ray(entry)
    # Not at the sensor: positions stay small enough for single precision.
    to_start = jnp.asarray(-scene.limits.start_distance, excess.dtype)
    # With shot views, times are relative to a shot whose axis goes through the point of entry:
    # `ShotViews.seen_by_shots` adds the delay of each shot.
    entry_path = 0.0 if scene.shot_views is None else 2.0 * dot(point, w)
    optical_weights = None
    if scene.optics is not None:
        optical_weights = jnp.ones((*index.shape, scene.optics.shape[1]), excess.dtype)
    return Photons(
        x=along(point, w, to_start),
        w=w,
        path=excess + to_start - entry_path,
        weight=weight,
        history=index,
        surface=jnp.full(index.shape, -1, jnp.int32),
        last_scattering=scene.if_differentiated(not_scattered(excess)),
        alive=alive,
        optical_weights=optical_weights,
        entry_point=None if scene.shot_views is None else entry,
        score=None if scene.slopes is None else jnp.zeros((*index.shape, scene.slopes.count)),
    )


class PlatePassage(NamedTuple):
    """A plate in the path of flights. `plate`: its number among the surfaces.

    - `is_passed`: True for flights that go on behind it, by a gap or straight through its material.
    - `is_met`: the same, or they end on it.
    - `is_transmitted`: True for flights that went straight through its material.
    """

    plate: int
    is_passed: Bool[Array, "*photons"]
    is_met: Bool[Array, "*photons"]
    is_transmitted: Bool[Array, "*photons"]


def passed_plates(
    scene: DeviceScene, p: Photons, flights: Flight, encounters: SurfaceEncounters
) -> list[PlatePassage]:
    """Return the passage of every plate. Flights may have several ends, along their first axis.

    A plate is passed if it lies nearer than the end of the flight, or the flight leaves the scene, and the
    photon did not stop at it; it is met if it is passed, or the flight ends on it. Late flights end where
    they can be recorded no more: plates behind that are not passed.
    """

    def to_ends(a: Array) -> Array:
        return jnp.broadcast_to(a, flights.distance.shape)

    passages = []
    for i, (surface, outcome) in enumerate(zip(scene.surfaces, encounters.outcomes)):
        if not surface.is_plate or outcome is None:
            continue
        distance = encounters.distances[i]
        # A plate at which the photon stops is an end, not a passage.
        is_stop = to_ends(outcome == STOPPED) & (to_ends(distance) <= flights.distance)
        is_ahead = to_ends(p.alive & (distance < FAR))
        is_passed = is_ahead & ((to_ends(distance) < flights.distance) | flights.escaped) & ~is_stop
        is_met = is_passed | (flights.landed & is_stop)
        passages.append(PlatePassage(i, is_passed, is_met, is_passed & to_ends(outcome == TRANSMITTED)))
    return passages


def collide(
    scene: DeviceScene, p: Photons, flight: Flight, encounters: SurfaceEncounters, draws: PhotonDraws
) -> tuple[Vec, Scalar, Collision]:
    """Sample the collision at the end of a flight.

    **Returns:** position, path length since the sensor, and collision; those of the start, and a collision
    without meaning, where nothing was hit.
    """
    flown = jnp.where(flight.has_hit, flight.distance, 0.0)
    x = along(p.x, p.w, flown)
    landed = flight.landed_on(encounters)
    collision = sample_collision(
        scene, x, p.w, flight.cell, flight.collided, landed, draws, encounters.mesh_normal
    )
    return x, p.path + flown, collision
