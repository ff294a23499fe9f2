"""Analog Monte Carlo, the paper's own estimator (section 1.4), for comparison.

Photons are followed one by one until they leave the scene. The estimator shares flights, collisions and
optics with the tracer, but has neither expected returns at every collision, nor a deterministic first order,
nor stratified random numbers.
"""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._checks import briefly, check_integer, check_key, check_range
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._vectors import FAR, along, dot
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.setup import reduce
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.trace.collisions import collide
from jaxlidar.trace.colouring import optics_of
from jaxlidar.trace.flight import events_of, fly, nearest, plates_ahead
from jaxlidar.trace.footprint import across_beam
from jaxlidar.trace.photons import THROUGH, Photons
from jaxlidar.trace.random_numbers import Draw
from jaxlidar.trace.setting import Setting, setting_of, straight_transmittance, unscattered

CHUNK = 512


@final
@briefly
class AnalogReturns(eqx.Module):
    """Arrival times and weights of photons followed one by one, as `analog_returns` gives them.

    - `time`: (photons,) ns, of arrival at the sensor, from the two-way travel time of the reference plane, as
      in `Waveform.time`; 0 where it did not return.
    - `weight`: (wavelengths, photons) apparent reflectance that the photon stands for; 0 where it did not
      return. The sum over photons, divided by their number, estimates the apparent reflectance of the scene.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jax.numpy as jnp
    >>> returns = jl.AnalogReturns(time=jnp.array([0.0, 12.5]), weight=jnp.array([[0.0, 0.8]]))
    >>> print(f"{float(returns.weight.sum() / returns.time.size):.2f}")
    0.40
    """

    time: Float[Array, "photons"]
    weight: Float[Array, "wavelengths photons"]


@eqx.filter_jit
def analog_returns(
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    *,
    key: PRNGKeyArray,
    n_photons: int,
    cone: float = 10.0,
) -> AnalogReturns:
    """Times and weights of photons that leave the scene within a cone about the direction to the sensor.

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
    that fly back on their own take ways independent of their ways in; for several wavelengths where leaves
    transmit straight on; and for a plan of so many orders that it keeps no histories.

    **Source:** section 1.4 of the paper.

    **Example:**

    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> key = jax.random.key(0)
    >>> returns = jl.analog_returns(lidar, scene, jl.plan(lidar, scene), key=key, n_photons=50_000)
    >>> print(f"{float(returns.weight.mean()):.1f}")
    0.4
    """
    check_kinds(lidar, scene)
    check_key(key)
    check_range("cone", cone, 0.0, 90.0, low_open=True)
    check_integer("n_photons", n_photons)
    setting = _setting(lidar, scene, plan)
    monomials = setting.table.monomials(optics_of(reduce(lidar, scene, plan)))
    size = min(CHUNK, n_photons)

    def chunk(key: PRNGKeyArray) -> tuple[Array, Array]:
        start_key, key = jax.random.split(key)
        start = _start(setting, size, start_key)

        def order(carry, n):
            def go(carry):
                onward, arrived = _one_flight(setting, carry[0], jax.random.fold_in(key, n), cone)
                return onward, jax.tree.map(
                    lambda a, b: jnp.where(arrived.value > 0, a, b), arrived, carry[1]
                )

            return lax.cond(jnp.any(carry[0].alive), go, lambda c: c, carry), None

        none = _Arrival(jnp.zeros((size,)), jnp.zeros((size,)), start.history)
        # One flight more than scatterings, to leave the scene.
        (_, arrived), _ = lax.scan(order, (start, none), jnp.arange(plan.orders + 1))
        return arrived.time, monomials[arrived.history].T * arrived.value[None, :]

    time, weight = lax.map(chunk, jax.random.split(key, -(-n_photons // size)))
    weight = jnp.moveaxis(weight, 1, 0)
    return AnalogReturns(time.reshape(-1)[:n_photons], weight.reshape(weight.shape[0], -1)[:, :n_photons])


@eqx.filter_jit
def photon_paths(
    lidar: Lidar, scene: Scene, plan: Plan, *, key: PRNGKeyArray, n_photons: int, leaving: float = 5.0
) -> Float[Array, "photons points 3"]:
    """Points along the paths of photons, for drawings: where they are sent, collide and leave the scene.

    **Arguments:**

    - `lidar`: a `Lidar`.
    - `scene`: a `Scene`.
    - `plan`: a `Plan` made by `jaxlidar.plan`; its window and orders bound what is followed.
    - `key`: a JAX random key.
    - `n_photons`: number of photons, at least 1.
    - `leaving`: length of the way out of the scene that is given, m. Default 5.

    **Returns:** (photons, points, 3) x, y, z in m, with two points more than the plan has orders: the start
    above the scene, the collisions, and the end of the way out. The points that remain are again the last
    collision.

    **Raises:** ValueError as for `analog_returns`.

    **Example:**

    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground())
    >>> paths = jl.photon_paths(lidar, scene, jl.plan(lidar, scene), key=jax.random.key(0), n_photons=4)
    >>> print(paths.shape, f"{abs(float(paths[0, 1, 2])):.2f}")
    (4, 3, 3) 0.00
    """
    check_kinds(lidar, scene)
    check_key(key)
    check_integer("n_photons", n_photons)
    setting = _setting(lidar, scene, plan)
    start_key, key = jax.random.split(key)
    start = _start(setting, n_photons, start_key)

    def order(p, n):
        onward, _ = _one_flight(setting, p, jax.random.fold_in(key, n), 90.0)
        out = along(p.x, p.w, jnp.where(p.alive & ~onward.alive, leaving, 0.0))
        return onward, jnp.stack([jnp.where(onward.alive, a, b) for a, b in zip(onward.x, out)], axis=-1)

    _, points = lax.scan(order, start, jnp.arange(plan.orders + 1))
    points = jnp.concatenate([jnp.stack(start.x, axis=-1)[None], points])
    aim = jnp.concatenate([lidar.position, jnp.zeros_like(lidar.position[:1])])
    return jnp.moveaxis(points, 0, 1) + aim[None, None, :]


class _Arrival(eqx.Module):
    """Photons at the sensor; `value` is zero for those that do not arrive."""

    time: Float[Array, "photons"]
    value: Float[Array, "photons"]
    history: Int[Array, "photons"]


def _setting(lidar: Lidar, scene: Scene, plan: Plan) -> Setting:
    setup = reduce(lidar, scene, plan)
    canopy = setup.scene.canopy
    if canopy is not None and canopy.hotspot:
        raise ValueError("hotspot = True; admissible is False: the way back is independent of the way in")
    if not plan.trace.keeps_histories:
        raise ValueError(
            f"plan has {plan.orders} orders, too many to keep histories; follow fewer (max_orders=)"
        )
    transmittance = straight_transmittance(setup)
    if transmittance is None:
        return setting_of(setup, derivatives="none")
    if transmittance.size > 1:
        raise ValueError(f"wavelength has {transmittance.size} values; 1 if transmission is straight")
    return setting_of(setup, derivatives="none").thinned(transmittance[0])


def _start(setting: Setting, size: int, key: PRNGKeyArray) -> Photons:
    radius_key, turn_key = jax.random.split(key)
    share, turn = jax.random.uniform(radius_key, (size,)), jax.random.uniform(turn_key, (size,))
    point, w, excess = setting.beam.ray(across_beam(setting.beam, share, turn))
    up = jnp.asarray(-setting.plan.upstream, excess.dtype)
    none = jnp.zeros((size,), jnp.int32)
    return Photons(
        along(point, w, up),
        w,
        excess + up,
        jnp.ones_like(excess),
        none,
        none - 1,
        unscattered(excess),
        none == 0,
    )


def _one_flight(setting: Setting, p: Photons, key: PRNGKeyArray, cone: float) -> tuple[Photons, _Arrival]:
    """Fly; arrive, if the flight leads out of the scene to the sensor; otherwise collide and scatter."""
    beam, plan = setting.beam, setting.plan
    plates = sum(s.plate for s in setting.surfaces)
    tiny = jnp.finfo(p.weight.dtype).tiny
    shape = (Draw.dimensions(plates, back=False), p.weight.size)
    draw = Draw.of(list(jax.random.uniform(key, shape, p.weight.dtype, tiny)), plates)
    met, outcomes, _ = plates_ahead(setting, p, draw.ahead)
    events = events_of(setting, met, outcomes)
    limit = nearest(p, events)
    flights = fly(setting, p, limit, setting.budget(p), draw.flight[None])
    flight = jax.tree.map(lambda a: a[0], flights)
    weight, letters = p.weight, p.history
    for i, (s, d, o) in enumerate(zip(setting.surfaces, met, outcomes)):
        if s.plate:
            through = p.alive & (o == THROUGH) & (d < FAR) & ((d < flight.distance) | ~flight.event)
            letters = jnp.where(through, setting.grow(letters, plan.surfaces[i].transmitted), letters)
            weight = jnp.where(through, weight / (1.0 - plan.lobe), weight)

    out = beam.excess(p.x)
    back = flight.escaped & (dot(p.w, beam.view(p.x)) > jnp.cos(jnp.deg2rad(cone)))
    # So that a level Lambertian surface returns its reflectance.
    share = weight * beam.in_view(p.x) / jnp.sin(jnp.deg2rad(cone)) ** 2
    arrived = _Arrival((p.path + out) / SPEED_OF_LIGHT, jnp.where(back, share, 0.0), letters)

    event = flight.event
    flown = jnp.where(event, flight.distance, 0.0)
    x = along(p.x, p.w, flown)
    landed = flight.landed_on(events, limit)
    hit = collide(setting, x, p.w, flight.cell, flight.collided, landed, draw)
    letters = setting.grow(letters, hit.letter)
    onward = Photons(
        x,
        hit.w,
        p.path + flown,
        jnp.where(event, weight * hit.ratio * hit.onward, 0.0),
        letters,
        hit.on,
        hit.sent,
        event,
    )
    return onward, arrived
