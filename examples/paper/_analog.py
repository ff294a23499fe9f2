"""Analog Monte Carlo, the paper's own estimator (section 1.4), for comparison.

Photons are followed one by one until they leave the scene. The estimator shares flights, collisions and
optics with the tracer, but has neither expected returns at every collision, nor a deterministic first order,
nor stratified random numbers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from jaxlidar import SPEED_OF_LIGHT
from jaxlidar.extend import along, check_integer, check_key, check_number, dot
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.setup import make_setup
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.spectral.apply_optics import setup_optics
from jaxlidar.trace.device_scene import DeviceScene, build_device_scene, not_scattered
from jaxlidar.trace.first.footprint import across_beam
from jaxlidar.trace.march.flight import Flight, SurfaceEncounters, meet_surfaces, sample_flights
from jaxlidar.trace.march.meshes import clear_of_mesh
from jaxlidar.trace.photons.photon_step import collide, passed_plates
from jaxlidar.trace.photons.photons import Photons
from jaxlidar.trace.photons.random_numbers import PhotonDraws

PHOTONS_PER_CHUNK = 512
_Vec = tuple[Array, Array, Array]


class AnalogReturns(eqx.Module):
    """Arrival times and weights of photons followed one by one, as `analog_returns` gives them.

    - `time`: (photons,) ns, of arrival at the sensor, from the two-way travel time of the reference plane, as
      in `Waveform.time`; 0 where it did not return.
    - `weight`: (wavelengths, photons) apparent reflectance that the photon stands for; 0 where it did not
      return. The sum over photons, divided by their number, estimates the apparent reflectance of the scene.
    """

    time: Float[Array, " photons"]
    weight: Float[Array, "wavelengths photons"]


def analog_returns(
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    *,
    key: PRNGKeyArray,
    n_photons: int,
    cone: float = 10.0,
) -> AnalogReturns:
    """Trace photons that leave the scene within a cone about the direction to the sensor.

    Photons are followed one by one, with independent random numbers. At 1000 m an aperture of 0.2 m would see
    one photon in 10^8, so the cone stands in for it, here as in the paper. The estimate is that of
    `simulate`, averaged over the cone.

    **Arguments:**

    - `lidar`: a `Lidar`.
    - `scene`: a `Scene`.
    - `plan`: a `Plan` made by `jaxlidar.plan`; its window and orders bound what is followed.
    - `key`: a JAX random key.
    - `n_photons`: number of photons, at least 1.
    - `cone`: half-angle of the cone, degrees, in (0, 90]. A smaller one is less biased and returns fewer
      photons. Default 10.

    **Returns:** an `AnalogReturns`.

    **Raises:** ValueError for values outside their ranges; for a canopy with the hot spot, because photons
    that fly back on their own take paths independent of their paths in; for several wavelengths where leaves
    transmit straight on; and for a plan that keeps no histories, because of the number of its orders.

    **Source:** section 1.4 of the paper.
    """
    check_kinds(lidar, scene)
    check_key(key)
    check_number("cone", cone, 0.0, 90.0, low_open=True)
    return _analog_returns(lidar, scene, plan, key, check_integer("n_photons", n_photons), cone)


@eqx.filter_jit
def _analog_returns(
    lidar: Lidar, scene: Scene, plan: Plan, key: PRNGKeyArray, n_photons: int, cone: float
) -> AnalogReturns:
    device_scene = _build_scene(lidar, scene, plan)
    monomials = device_scene.histories.monomials(setup_optics(make_setup(lidar, scene, plan)))
    chunk_size = min(PHOTONS_PER_CHUNK, n_photons)

    def chunk(key: PRNGKeyArray) -> tuple[Array, Array]:
        start_key, key = jax.random.split(key)
        start = _send_photons(device_scene, chunk_size, start_key)

        def order_step(carry, order):
            def trace(carry):
                p, arrivals = carry
                onward, arrived = _trace_flight(device_scene, p, jax.random.fold_in(key, order), cone)
                arrivals = jax.tree.map(lambda a, b: jnp.where(arrived.value > 0, a, b), arrived, arrivals)
                return onward, arrivals

            return lax.cond(jnp.any(carry[0].alive), trace, lambda c: c, carry), None

        zeros = jnp.zeros_like(start.weight)
        no_arrivals = _Arrivals(zeros, zeros, start.history)
        # One flight more than scatterings, to leave the scene.
        (_, arrivals), _ = lax.scan(order_step, (start, no_arrivals), jnp.arange(plan.orders + 1))
        return arrivals.time, monomials[arrivals.history].T * arrivals.value[None, :]

    time, weight = lax.map(chunk, jax.random.split(key, -(-n_photons // chunk_size)))
    weight = jnp.moveaxis(weight, 1, 0)
    return AnalogReturns(time.reshape(-1)[:n_photons], weight.reshape(weight.shape[0], -1)[:, :n_photons])


def photon_paths(
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    *,
    key: PRNGKeyArray,
    n_photons: int,
    leaving: float = 5.0,
    source: Float[ArrayLike, "3"] | None = None,
) -> Float[Array, "photons points 3"]:
    """Trace points along the paths of photons.

    **Arguments:**

    - `lidar`: a `Lidar`.
    - `scene`: a `Scene`.
    - `plan`: a `Plan` made by `jaxlidar.plan`; its window and orders bound what is followed.
    - `key`: a JAX random key.
    - `n_photons`: number of photons, at least 1.
    - `leaving`: length, m, over which photons that leave the scene are followed. Default 5.
    - `source`: (3,) m, a point that sends photons in all directions, in place of the lidar. Default None.

    **Returns:** (photons, points, 3) x, y, z in m, with two points more than the plan has orders: the start
    above the scene or at the source, the collisions, and the end of the path out of the scene. Remaining
    points repeat the last collision.

    **Raises:** ValueError as for `analog_returns`.
    """
    check_kinds(lidar, scene)
    check_key(key)
    check_number("leaving", leaving, 0.0)
    start = None if source is None else jnp.asarray(source, float) - lidar.aim_point
    return _photon_paths(lidar, scene, plan, key, check_integer("n_photons", n_photons), leaving, start)


@eqx.filter_jit
def _photon_paths(
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    key: PRNGKeyArray,
    n_photons: int,
    leaving: float,
    source: Float[Array, "3"] | None,
) -> Float[Array, "photons points 3"]:
    device_scene = _build_scene(lidar, scene, plan)
    start_key, key = jax.random.split(key)
    if source is None:
        start = _send_photons(device_scene, n_photons, start_key)
    else:
        zero, w = jnp.zeros(n_photons), jax.random.normal(start_key, (n_photons, 3))
        w = w / jnp.linalg.norm(w, axis=1, keepdims=True)
        start = _start_photons(tuple(zero + a for a in source), tuple(w.T), zero)

    def order_step(p, order):
        onward, _ = _trace_flight(device_scene, p, jax.random.fold_in(key, order), 90.0)
        out = along(p.x, p.w, jnp.where(p.alive & ~onward.alive, leaving, 0.0))
        return onward, jnp.stack([jnp.where(onward.alive, a, b) for a, b in zip(onward.x, out)], axis=-1)

    _, points = lax.scan(order_step, start, jnp.arange(plan.orders + 1))
    points = jnp.concatenate([jnp.stack(start.x, axis=-1)[None], points])
    aim = lidar.aim_point
    return jnp.moveaxis(points, 0, 1) + aim[None, None, :]


class _Arrivals(eqx.Module):
    """Photons at the sensor; `value` is zero for those that do not arrive."""

    time: Float[Array, " photons"]
    value: Float[Array, " photons"]
    history: Int[Array, " photons"]


def _build_scene(lidar: Lidar, scene: Scene, plan: Plan) -> DeviceScene:
    """Build the device scene, and refuse scenes that the analog estimator cannot simulate."""
    if lidar.has_sensor_position:
        raise ValueError(
            "the lidar is placed by its sensor; admissible for the analog estimator, which collects photons "
            "that leave the scene, is one with an altitude"
        )
    setup = make_setup(lidar, scene, plan)
    canopy = setup.scene.canopy
    if canopy is not None and canopy.hotspot:
        raise ValueError(
            "the canopy has hotspot = True; admissible is Canopy(..., hotspot=False): photons that fly back "
            "on their own take paths independent of their paths in"
        )
    if not plan.config.keeps_histories:
        raise ValueError(
            f"plan has {plan.orders} orders, too many to keep histories, or histories = False; admissible "
            "are plans with histories = True, of fewer orders (max_orders=) where these are too many"
        )
    device_scene = build_device_scene(setup, derivatives="none")
    transmittance = device_scene.straight_transmittance
    if transmittance is None:
        return device_scene
    if transmittance.size > 1:
        raise ValueError(f"wavelength has {transmittance.size} values; 1 if transmission is straight")
    return device_scene.with_leaf_transmittance(transmittance[0])


def _start_photons(x: _Vec, w: _Vec, path: Array) -> Photons:
    """Return photons of the weight one, without a history, that start from no surface."""
    zero = jnp.zeros(path.shape, jnp.int32)
    return Photons(
        x=x,
        w=w,
        path=path,
        weight=jnp.ones_like(path),
        history=zero,
        surface=zero - 1,
        last_scattering=not_scattered(path),
        alive=zero == 0,
    )


def _fly_once(
    scene: DeviceScene, p: Photons, key: PRNGKeyArray, max_length: Float[Array, " photons"]
) -> tuple[PhotonDraws, SurfaceEncounters, Flight]:
    """Sample one flight of each photon, of at most `max_length`, m, with independent random numbers.

    **Returns:** the numbers, for the collision; the surfaces ahead; and the flight.
    """
    # Not zero, whose logarithm would be an infinite optical depth.
    tiny = jnp.finfo(p.weight.dtype).tiny
    shape = (PhotonDraws.dimensions(scene.n_plates, return_path=False), p.weight.size)
    uniform = jax.random.uniform(key, shape, p.weight.dtype, tiny)
    draws = PhotonDraws.from_numbers(list(uniform), scene.n_plates)
    encounters = meet_surfaces(scene, p, draws.plates_ahead)
    flights = sample_flights(scene, p, encounters, max_length, draws.flight[None])
    return draws, encounters, jax.tree.map(lambda a: a[0], flights)


def _send_photons(scene: DeviceScene, count: int, key: PRNGKeyArray) -> Photons:
    """Send photons from the sensor, at independent positions across the beam."""
    radius_key, turn_key = jax.random.split(key)
    fraction, turn = jax.random.uniform(radius_key, (count,)), jax.random.uniform(turn_key, (count,))
    point, w, excess = scene.beam.ray(across_beam(scene.beam, fraction, turn))
    to_start = jnp.asarray(-scene.limits.start_distance, excess.dtype)
    return _start_photons(along(point, w, to_start), w, excess + to_start)


def _trace_flight(
    scene: DeviceScene, p: Photons, key: PRNGKeyArray, cone: float
) -> tuple[Photons, _Arrivals]:
    """Trace one flight of each photon.

    1. Find the surfaces ahead, and sample the flight.
    2. Apply the plates that it passes to the weight and the history.
    3. A photon that leaves the scene within `cone` degrees of the sensor arrives there.
    4. Other photons collide and scatter.
    """
    beam, config = scene.beam, scene.config
    draws, encounters, flight = _fly_once(scene, p, key, scene.longest_flight(p))
    weight, history = p.weight, p.history
    for passage in passed_plates(scene, p, flight, encounters):
        after = scene.history_after(history, config.surfaces[passage.plate].transmission)
        history = jnp.where(passage.is_transmitted, after, history)
        transmitted_weight = weight / (1.0 - scene.limits.reflection_probability)
        weight = jnp.where(passage.is_transmitted, transmitted_weight, weight)

    out = beam.excess(p.x)
    in_cone = dot(p.w, beam.view(p.x)) > jnp.cos(jnp.deg2rad(cone))
    # Divided by the cone's projected solid angle over pi: a level Lambertian surface returns its reflectance.
    value = weight * beam.in_view(p.x) / jnp.sin(jnp.deg2rad(cone)) ** 2
    value = jnp.where(flight.escaped & in_cone, value, 0.0)
    arrived = _Arrivals((p.path + out) / SPEED_OF_LIGHT, value, history)

    has_hit = flight.has_hit
    x, path, collision = collide(scene, p, flight, encounters, draws)
    onward = Photons(
        x=clear_of_mesh(scene, x, collision.w, collision.surface, collision.normal),
        w=collision.w,
        path=path,
        weight=jnp.where(has_hit, weight * collision.weight * collision.onward_weight, 0.0),
        history=scene.history_after(history, collision.channel),
        surface=collision.surface,
        last_scattering=collision.last_scattering,
        alive=has_hit,
    )
    return onward, arrived
