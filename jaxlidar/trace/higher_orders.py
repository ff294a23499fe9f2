r"""Orders two and above: photons collide, scatter, and deposit the expected return of every collision.

Photons carry no energy, only the geometric weight of their path and the number of its history. Each order
draws a collision: the optical depth to it, the material, the direction onward. From there the photon deposits
the probability of returning (pi times the density of scattering towards the sensor, times the transmittance
of the way there). It does so from several points of the flight, `plan.ends`, one in each stratum of the
probability of getting there, and goes on from one of them.

Derivatives: what is drawn is held fixed (directions, materials, and the place of a collision as a fraction of
the ray's chord through its voxel), and the density with which it was drawn stays in the weight as p /
stop_gradient(p). Voxel sizes, heights and extinction move positions, path lengths and densities continuously,
so the derivative of an expected value is the expected value of the derivative. Photons never collide where
the extinction coefficient is exactly zero, and the derivative with respect to it is zero here.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._vectors import FAR, Scalar, Vec, along
from jaxlidar.trace.collisions import collide, view_factors
from jaxlidar.trace.deposit import instant_row, scatter_rows
from jaxlidar.trace.flight import Flight, events_of, fly, nearest, plates_ahead
from jaxlidar.trace.footprint import GOLDEN, across_beam
from jaxlidar.trace.march import depth_to_top, free_flight
from jaxlidar.trace.photons import THROUGH, Hit, Photons, ratio_of, stop
from jaxlidar.trace.random_numbers import Draw, Independent, lattices
from jaxlidar.trace.reparametrise import footprint_rays, rays_to_surfaces
from jaxlidar.trace.setting import Setting, unscattered

CHUNK = 256
# Chunks that are traced together, order by order. Each group has its own sum: single precision loses small
# deposits on a large sum.
GROUP = 32


class HigherOrders(eqx.Module):
    """Response of orders two and above, and the fate of all light (see `jaxlidar.trace.response`)."""

    weights: Float[Array, "materials histories bins"]
    outside: Float[Array, "materials histories"]
    arrived: Float[Array, "materials histories"]
    left: Float[Array, "materials histories"]
    escaped: Float[Array, "histories"]
    late: Float[Array, "histories"]
    remaining: Float[Array, "histories"]


def higher_orders(setting: Setting, key: PRNGKeyArray) -> HigherOrders:
    """Trace a batch of photons through up to `plan.orders` scatterings; sums are means per photon."""
    beam, medium, plan, bins = setting.beam, setting.medium, setting.plan, setting.bins
    photons = setting.sizes.photons
    footprint_key, draw_key = jax.random.split(key)
    plates = sum(s.plate for s in setting.surfaces)
    dimensions = Draw.dimensions(plates)
    shift = jax.random.uniform(footprint_key, (2,))
    if plan.independent:
        numbers, places = Independent(draw_key, dimensions), Independent(footprint_key, 2)
    else:
        numbers, places = lattices(draw_key, plan.order_steps, dimensions), None
    size = min(CHUNK, photons)
    chunks = -(-photons // size)
    groups = -(-chunks // GROUP)
    each = -(-chunks // groups)
    count, materials = setting.table.count, len(plan.materials)

    def start(lane):
        if places is None:
            share = (lane.astype(float) + shift[0]) / photons
            turn = (lane * jnp.uint32(GOLDEN * 2**32)).astype(float) * 2.0**-32 + shift[1]
        else:
            share, turn = places(lane, jnp.asarray(plan.order_steps))
        inside = lane < photons
        across, share = footprint_rays(beam, medium, across_beam(beam, share, turn))
        point, w, excess = beam.ray(across)
        up = jnp.asarray(-plan.upstream, excess.dtype)
        return Photons(
            along(point, w, up),
            w,
            excess + up,
            jnp.where(inside, share / photons, 0.0),
            jnp.zeros(lane.shape, jnp.int32),
            jnp.full(lane.shape, -1, jnp.int32),
            unscattered(excess),
            inside,
        )

    def group(total, number):
        lane = number * (each * size) + jnp.arange(each * size, dtype=jnp.uint32)

        def one_order(carry, n):
            def chunk(tally, part):
                lane, photons = part

                def go(photons, tally):
                    return _one_order(setting, photons, tally, Draw.of(numbers(lane, n), plates), n)

                # Living photons come first, so that whole chunks of dead ones are skipped.
                photons, tally = lax.cond(jnp.any(photons.alive), go, lambda *c: c, photons, tally)
                return tally, photons

            lanes, photons, tally = carry
            tally, photons = lax.scan(chunk, tally, (lanes, photons))
            lanes, photons = _alive_first(lanes, photons)
            return lanes, photons, tally

        def order(carry, n):
            # The loop is as long as the ladder of sizes has it.
            return lax.cond(n < plan.orders, one_order, lambda carry, _: carry, carry, n), None

        rows = jax.tree.map(lambda a: a.reshape(each, size), (lane, start(lane)))
        (_, last, tally), _ = lax.scan(order, (*rows, zero), jnp.arange(plan.order_steps))
        over = jnp.where(last.alive, stop(last.weight), 0.0)
        tally = eqx.tree_at(lambda t: t.remaining, tally, tally.remaining.at[last.history].add(over))
        return jax.tree.map(jnp.add, total, tally), None

    zero = HigherOrders(
        jnp.zeros((materials, count, bins.padded)),
        jnp.zeros((materials, count)),
        jnp.zeros((materials, count)),
        jnp.zeros((materials, count)),
        jnp.zeros((count,)),
        jnp.zeros((count,)),
        jnp.zeros((count,)),
    )
    tallies, _ = lax.scan(group, zero, jnp.arange(groups, dtype=jnp.uint32))
    return eqx.tree_at(lambda t: (t.weights, t.outside), tallies, bins.trimmed(tallies.weights))


def _alive_first(lanes: Array, photons: Photons) -> tuple[Array, Photons]:
    """Bring the living photons to the front, in their order; all others are dead copies of the first."""
    alive = photons.alive.reshape(-1)
    number = jnp.arange(alive.size)
    place = jnp.where(alive, jnp.cumsum(alive) - 1, alive.size)
    source = jnp.zeros_like(number).at[place].set(number, mode="drop")
    lanes, photons = jax.tree.map(lambda a: a.reshape(-1)[source].reshape(a.shape), (lanes, photons))
    alive = (number < jnp.sum(alive)).reshape(photons.alive.shape)
    return lanes, eqx.tree_at(lambda p: p.alive, photons, alive)


def _one_order(setting: Setting, p: Photons, tally: HigherOrders, draw: Draw, order: Int[Array, ""]):
    """Fly, collide, deposit, scatter."""
    plan, ends = setting.plan, setting.plan.ends
    met, outcomes, ratio = plates_ahead(setting, p, draw.ahead)
    events = events_of(setting, met, outcomes)
    limit = nearest(p, events)
    budget = stop(setting.budget(p))
    if setting.medium is not None and setting.surfaces:
        w, limit, turned = rays_to_surfaces(setting, p, limit, events, (order > 0) & (limit < budget))
        p = eqx.tree_at(lambda p: (p.w, p.weight), p, (w, p.weight * turned))
    # One number says in which stratum the photon goes on, and where in each stratum the points are.
    chosen = jnp.minimum(jnp.floor(draw.flight * ends), ends - 1)
    strata = jnp.stack([(i + (draw.flight * ends - chosen)) / ends for i in range(ends)])
    wide = functools.partial(jnp.broadcast_to, shape=strata.shape)
    flights = fly(setting, p, limit, budget, jnp.maximum(strata, 1e-9))
    p, draw, flights, events, limit = lax.optimization_barrier((p, draw, flights, events, limit))

    def pick(a: Array) -> Array:
        return jnp.take_along_axis(a, chosen.astype(jnp.int32)[None], 0, mode="promise_in_bounds")[0]

    # Plates that were passed on the way. Histories do not depend on the order; what arrives at a plate does.
    weight, history = wide(p.weight) * flights.density, wide(p.history)
    passes: dict[int, Bool[Array, "ends photons"]] = {}
    for i, (s, d, o) in enumerate(zip(setting.surfaces, met, outcomes)):
        if not s.plate:
            continue
        own = wide(events[i]) <= flights.distance
        passed = wide(p.alive & (d < FAR)) & ((wide(d) < flights.distance) | ~flights.event) & ~own
        weight = weight * jnp.where(passed | (flights.landed & own), wide(ratio[i]), 1.0)
        passes[i] = passed & wide(o == THROUGH)
    before = pick(weight), pick(history)
    for i, through in passes.items():
        scatterer, here = plan.surfaces[i], pick(through)
        gone, arrived = before
        for j, other in passes.items():
            if j != i:
                nearer = here & pick(other) & (met[j] < met[i])
                gone = jnp.where(nearer, gone / (1.0 - plan.lobe), gone)
                arrived = jnp.where(nearer, setting.grow(arrived, plan.surfaces[j].transmitted), arrived)
        gone = jnp.where(here, gone, 0.0)
        tally = _arrive(tally, scatterer.material, arrived, gone)
        onward = setting.grow(arrived, scatterer.transmitted)
        tally = _leave(tally, scatterer.material, onward, gone / (1.0 - plan.lobe))
        history = jnp.where(through, setting.grow(history, scatterer.transmitted), history)
        weight = jnp.where(through, weight / (1.0 - plan.lobe), weight)

    if plan.drawn_first:
        tally = _return(setting, p, flights, events, limit, weight, history, draw, tally)
    else:
        # The first order is deterministic and has been deposited.
        given = (setting, p, flights, events, limit, weight, history, draw)
        tally = lax.cond(order > 0, lambda t: _return(*given, t), lambda t: t, tally)

    flight, weight, history = jax.tree.map(pick, (flights, weight, history))
    held = stop(weight)
    tally = eqx.tree_at(
        lambda t: (t.escaped, t.late),
        tally,
        (
            tally.escaped.at[history].add(jnp.where(flight.escaped, held, 0.0)),
            tally.late.at[history].add(jnp.where(flight.late, held, 0.0)),
        ),
    )
    flown = jnp.where(flight.event, flight.distance, 0.0)
    x = along(p.x, p.w, flown)
    landed = flight.landed_on(events, limit)
    hit = collide(setting, x, p.w, flight.cell, flight.collided, landed, draw)
    weight = jnp.where(flight.event, weight, 0.0)
    tally = _arrive(tally, hit.material, history, weight)
    history = setting.grow(history, hit.letter)
    weight = weight * hit.ratio * hit.onward
    tally = _leave(tally, hit.material, history, weight)
    return Photons(x, hit.w, p.path + flown, weight, history, hit.on, hit.sent, flight.event), tally


def _return(
    setting: Setting,
    p: Photons,
    flights: Flight,
    events: list[Scalar],
    limit: Scalar,
    weight: Float[Array, "ends photons"],
    history: Int[Array, "ends photons"],
    draw: Draw,
    tally: HigherOrders,
) -> HigherOrders:
    """Deposit the expected return of every end of the flights, each its share."""
    ends = setting.plan.ends

    def flat(tree):
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (ends, a.shape[-1])).reshape(-1), tree)

    p, flights, events, limit, draw, history = flat((p, flights, events, limit, draw, history))
    flown = jnp.where(flights.event, flights.distance, 0.0)
    x = along(p.x, p.w, flown)
    landed = flights.landed_on(events, limit)
    hit = collide(setting, x, p.w, flights.cell, flights.collided, landed, draw)
    value = jnp.where(flights.event, flat(weight), 0.0) * hit.ratio / ends
    given = lax.optimization_barrier((p.w, x, p.path + flown, value, history, hit, draw))
    return _deposit(setting, tally, *given)


def _arrive(tally: HigherOrders, material: Array | int, history: Array, weight: Scalar) -> HigherOrders:
    return eqx.tree_at(lambda t: t.arrived, tally, tally.arrived.at[material, history].add(stop(weight)))


def _leave(tally: HigherOrders, material: Array | int, history: Array, weight: Scalar) -> HigherOrders:
    return eqx.tree_at(lambda t: t.left, tally, tally.left.at[material, history].add(stop(weight)))


def _deposit(
    setting: Setting,
    tally: HigherOrders,
    w: Vec,
    x: Vec,
    path: Scalar,
    weight: Scalar,
    history: Int[Array, "photons"],
    hit: Hit,
    draw: Draw,
) -> HigherOrders:
    """Deposit the expected return of each collision."""
    beam, plan, medium = setting.beam, setting.plan, setting.medium
    v = beam.view(x)
    reflected, transmitted = view_factors(setting, x, w, v, hit)
    if medium is None:
        clear = jnp.ones_like(path)
    elif setting.column is not None:
        column = setting.column
        clear = jnp.exp(-jax.vmap(lambda x: depth_to_top(medium, x, column))(x))
    else:
        none, far = jnp.zeros((0, path.size)), jnp.full_like(path, FAR)
        clear = jnp.exp(-free_flight(medium, x, v, none, far, weight > 0, plan.march_steps).total)
    drawn = iter(draw.behind)
    for i, (s, scatterer) in enumerate(zip(setting.surfaces, plan.surfaces)):
        if not s.plate:
            continue
        covered = next(drawn) < s.coverage
        crossed = s.distance(x, v) < FAR
        if not s.shape.lights_itself:
            crossed &= hit.on != i
        c = jnp.broadcast_to(s.coverage, path.shape)
        ratio = ratio_of(jnp.where(covered, c, 1.0 - c))
        if s.straight:
            history = jnp.where(crossed & covered, setting.grow(history, scatterer.transmitted), history)
            through = ratio if scatterer.transmitted >= 0 else jnp.where(covered, 0.0, ratio)
        else:
            through = jnp.where(covered, 0.0, ratio)
        clear = clear * jnp.where(crossed, through, 1.0)
    out = beam.excess(x)
    time = (path + out) / SPEED_OF_LIGHT
    # Apparent reflectance refers to the range that the time of arrival stands for.
    spread = ((beam.slant_range + 0.5 * (path + out)) / (beam.slant_range + out)) ** 2
    value = weight * clear * spread * beam.in_view(x)
    response = tally.weights.reshape(-1, setting.bins.padded)
    pairs = [(hit.reflected, reflected)]
    if transmitted is not None:
        pairs.append((hit.transmitted, transmitted))
    first, row = lax.optimization_barrier(instant_row(setting.bins, time, value))
    for letter, factor in pairs:
        slot = hit.material * setting.table.count + setting.grow(history, letter)
        factor = jnp.where(letter >= 0, factor, 0.0)
        response = scatter_rows(response, slot, first, row * factor[:, None])
    return eqx.tree_at(lambda t: t.weights, tally, response.reshape(tally.weights.shape))
