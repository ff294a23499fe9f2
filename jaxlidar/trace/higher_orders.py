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

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._one_function import once
from jaxlidar._vectors import FAR, Scalar, Vec, along
from jaxlidar.trace.collisions import collide, shown, view_factors
from jaxlidar.trace.deposit import instant_row, scatter_rows
from jaxlidar.trace.flight import Flight, events_of, fly, nearest, plates_ahead
from jaxlidar.trace.footprint import GOLDEN, across_beam
from jaxlidar.trace.labels import Label, book
from jaxlidar.trace.march import depth_to_top, free_flight
from jaxlidar.trace.nodes import Nodes
from jaxlidar.trace.ordering import in_order
from jaxlidar.trace.photons import THROUGH, Met, Photons, ratio_of, stop
from jaxlidar.trace.random_numbers import Draw, Independent, lattices, to_unit, words
from jaxlidar.trace.reparametrise import (
    footprint_rays,
    moves_landings,
    rays_to_surfaces,
    rays_to_terrain,
    sees_terrain,
)
from jaxlidar.trace.scored_light import gains, rise, scored
from jaxlidar.trace.setting import Setting, unscattered

CHUNK = 256
# Chunks that are traced together, order by order. Each group has its own sum: single precision loses small
# deposits on a large sum.
GROUP = 32


class HigherOrders(eqx.Module):
    """Response of orders two and above, and the fate of all light (see `jaxlidar.trace.response`).

    The last axis but bins is that of histories; or, where optics are applied, of wavelengths, with `Nodes` of
    nodes and wavelengths; `weights` and `outside` of shots and wavelengths, where shots see it (`Viewing`).
    `scored`: derivatives of what returns, where scores are asked for.
    """

    weights: Float[Array, "materials seen bins"]
    outside: Float[Array, "materials seen"]
    arrived: Float[Array, "materials labels"]
    left: Float[Array, "materials labels"]
    escaped: Float[Array, "labels"]
    late: Float[Array, "labels"]
    remaining: Float[Array, "labels"]
    scored: Float[Array, "bins columns wavelengths"] | None = None


def higher_orders(setting: Setting, key: PRNGKeyArray, nodes: Nodes | None = None) -> HigherOrders:
    """Trace a batch of photons through up to `plan.orders` scatterings; sums are means per photon.

    With `nodes`, light enters about these and is booked under them: sums are means per photon of a node.
    """
    beam, medium, plan, bins = setting.beam, setting.medium, setting.plan, setting.bins
    photons = setting.sizes.photons if nodes is None else nodes.photons
    plates = sum(s.plate for s in setting.surfaces)
    dimensions = Draw.dimensions(plates)
    # Words before these shift the footprint of order one.
    drawn = words(key, 4 + 2 * plan.order_steps * dimensions)[2:]
    shift, places = to_unit(drawn[:2]), None
    numbers = lattices(drawn[2:], plan.order_steps, dimensions)
    footprint_key = key
    if plan.independent or nodes is not None:
        footprint_key, key = jax.random.split(key)
    if plan.independent:
        numbers, places = Independent(key, dimensions), Independent(footprint_key, 2)
    size = min(CHUNK, photons)
    chunks = -(-photons // size)
    groups = -(-chunks * size // (GROUP * CHUNK))
    each = -(-chunks // groups)
    materials, scores = len(plan.materials), setting.scores
    colours = 0 if setting.optics is None else setting.optics.shape[1]
    count = setting.table.count if not colours else colours * (1 if nodes is None else len(nodes.place))
    seen = count if setting.viewing is None else colours * setting.viewing.shots
    terrain = sees_terrain(setting)

    def begin(lane):
        if nodes is not None:
            return nodes.start(setting, lane, footprint_key)
        if places is None:
            share = (lane.astype(float) + shift[0]) / photons
            turn = (lane * jnp.uint32(GOLDEN * 2**32)).astype(float) * 2.0**-32 + shift[1]
        else:
            share, turn = places(lane, jnp.asarray(plan.order_steps))
        inside = lane < photons
        across, share = footprint_rays(beam, medium, across_beam(beam, share, turn))
        if terrain:
            across, more = rays_to_terrain(setting, across)
            share = share * more
        point, w, excess = beam.ray(across)
        up = jnp.asarray(-plan.upstream, excess.dtype)
        return lane, Photons(
            along(point, w, up),
            w,
            excess + up,
            jnp.where(inside, share / photons, 0.0),
            jnp.zeros(lane.shape, jnp.int32),
            jnp.full(lane.shape, -1, jnp.int32),
            setting.kept(unscattered(excess)),
            inside,
            tuple(jnp.ones_like(excess) for _ in range(colours)),
            score=None if scores is None else jnp.zeros((*lane.shape, scores.count)),
        )

    def group(total, number):
        lane = number * (each * size) + jnp.arange(each * size, dtype=jnp.uint32)

        def one_order(carry, n):
            photons, tally = carry
            source, living = in_order(setting, photons[1])
            flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), photons)

            def taken(number):
                place = source[number]
                lane, own = jax.tree.map(lambda a: a.at[place].get(mode="promise_in_bounds"), flat)
                alive = number * size + jnp.arange(size) < living
                return once((lane, eqx.tree_at(lambda p: p.alive, own, alive)))

            def flown(lane, own, tally):
                own, tally = _one_order(setting, own, tally, Draw.of(numbers(lane, n), plates), n)
                return (lane, own), tally

            def chunk(tally, number):
                lane, own = taken(number)
                own, tally = lax.cond(jnp.any(own.alive), flown, lambda *c: (c[:2], c[2]), lane, own, tally)
                return tally, own

            def next_chunk(number, state):
                photons, tally = state
                lane, own = taken(number)
                own, tally = flown(lane, own, tally)
                return jax.tree.map(lambda a, b: a.at[number].set(b), photons, own), tally

            # Chunks of dead photons are skipped, or not even looked at.
            if setting.reverse:
                tally, photons = lax.scan(chunk, tally, jnp.arange(each))
                return photons, tally
            left = eqx.tree_at(lambda p: p[1].alive, photons, jnp.zeros_like(photons[1].alive))
            return lax.fori_loop(0, -(-living // size), next_chunk, (left, tally))

        def order(carry, n):
            # The loop is as long as the ladder of sizes has it.
            return lax.cond(n < plan.orders, one_order, lambda carry, _: carry, carry, n), None

        rows = jax.tree.map(lambda a: a.reshape(each, size, *a.shape[1:]), begin(lane))
        ((_, last), tally), _ = lax.scan(order, (rows, zero), jnp.arange(plan.order_steps))
        over = jnp.where(last.alive, last.weight, 0.0)
        remaining = book(tally.remaining, (), Label.of(last), over)
        tally = eqx.tree_at(lambda t: t.remaining, tally, remaining)
        return jax.tree.map(jnp.add, total, tally), None

    zero = HigherOrders(
        jnp.zeros((materials, seen, bins.padded)),
        jnp.zeros((materials, seen)),
        jnp.zeros((materials, count)),
        jnp.zeros((materials, count)),
        jnp.zeros((count,)),
        jnp.zeros((count,)),
        jnp.zeros((count,)),
        None if scores is None else jnp.zeros((bins.padded, scores.count, scores.left.shape[1])),
    )
    tallies, _ = lax.scan(group, zero, jnp.arange(groups, dtype=jnp.uint32))
    if tallies.scored is not None:
        tallies = eqx.tree_at(lambda t: t.scored, tallies, tallies.scored[bins.row : bins.row + bins.count])
    return eqx.tree_at(lambda t: (t.weights, t.outside), tallies, bins.trimmed(tallies.weights))


def _one_order(setting: Setting, p: Photons, tally: HigherOrders, draw: Draw, order: Int[Array, ""]):
    """Fly, collide, deposit, scatter."""
    plan, ends = setting.plan, setting.plan.ends
    met, outcomes, ratio = plates_ahead(setting, p, draw.ahead)
    events = events_of(setting, met, outcomes)
    limit = nearest(p, events)
    budget = stop(setting.budget(p))
    if moves_landings(setting):
        w, limit, turned = rays_to_surfaces(setting, p, limit, events, (order > 0) & (limit < budget))
        p = eqx.tree_at(lambda p: (p.w, p.weight), p, (w, p.weight * turned))
    # One number says in which stratum the photon goes on, and where in each stratum the points are.
    chosen = jnp.minimum(jnp.floor(draw.flight * ends), ends - 1)
    strata = jnp.stack([(i + (draw.flight * ends - chosen)) / ends for i in range(ends)])
    wide = functools.partial(jnp.broadcast_to, shape=strata.shape)
    flights = fly(setting, p, limit, budget, jnp.maximum(strata, 1e-9))
    p, draw, flights, events, limit = once((p, draw, flights, events, limit))

    def pick(a: Array) -> Array:
        own = chosen.astype(jnp.int32).reshape((1,) * (a.ndim - 1) + chosen.shape)
        return jnp.take_along_axis(a, own, 0, mode="promise_in_bounds")[0]

    # Plates that were passed on the way. Histories do not depend on the order; what arrives at a plate does.
    weight, label = wide(p.weight) * flights.density, jax.tree.map(wide, Label.of(p))
    passes: dict[int, Bool[Array, "ends photons"]] = {}
    for i, (s, d, o) in enumerate(zip(setting.surfaces, met, outcomes)):
        if not s.plate:
            continue
        own = wide(events[i]) <= flights.distance
        passed = wide(p.alive & (d < FAR)) & ((wide(d) < flights.distance) | ~flights.event) & ~own
        weight = weight * jnp.where(passed | (flights.landed & own), wide(ratio[i]), 1.0)
        passes[i] = passed & wide(o == THROUGH)
    before = pick(weight), jax.tree.map(pick, label)
    for i, through in passes.items():
        scatterer, here = plan.surfaces[i], pick(through)
        gone, arrived = before
        for j, other in passes.items():
            if j != i:
                nearer = here & pick(other) & (met[j] < met[i])
                gone = jnp.where(nearer, gone / (1.0 - plan.lobe), gone)
                arrived = arrived.grown_where(nearer, setting, plan.surfaces[j].transmitted)
        gone = jnp.where(here, gone, 0.0)
        tally = _arrive(tally, scatterer.material, arrived, gone)
        onward = arrived.grown(setting, scatterer.transmitted)
        tally = _leave(tally, scatterer.material, onward, gone / (1.0 - plan.lobe))
        label = label.grown_where(through, setting, scatterer.transmitted)
        weight = jnp.where(through, weight / (1.0 - plan.lobe), weight)

    if plan.drawn_first:
        tally = _return(setting, p, flights, events, limit, weight, label, draw, tally)
    else:
        # The first order is deterministic and has been deposited.
        given = (setting, p, flights, events, limit, weight, label, draw)
        tally = lax.cond(order > 0, lambda t: _return(*given, t), lambda t: t, tally)

    flight, weight, label = jax.tree.map(pick, (flights, weight, label))
    tally = eqx.tree_at(
        lambda t: (t.escaped, t.late),
        tally,
        (
            book(tally.escaped, (), label, jnp.where(flight.escaped, weight, 0.0)),
            book(tally.late, (), label, jnp.where(flight.late, weight, 0.0)),
        ),
    )
    flown = jnp.where(flight.event, flight.distance, 0.0)
    x = along(p.x, p.w, flown)
    landed = flight.landed_on(events, limit)
    hit = collide(setting, x, p.w, flight.cell, flight.collided, landed, draw)
    weight = jnp.where(flight.event, weight, 0.0)
    tally = _arrive(tally, hit.material, label, weight)
    label = label.grown(setting, hit.letter)
    weight = weight * hit.ratio * hit.onward
    tally = _leave(tally, hit.material, label, weight)
    score = None
    if p.score is not None:
        assert flight.moved is not None
        score = p.score - flight.moved.T + gains(setting, flight.cell, flight.collided, hit)
    onward = Photons(
        x,
        hit.w,
        p.path + flown,
        weight,
        label.number,
        hit.on,
        setting.kept(hit.sent),
        flight.event,
        label.tints,
        label.entry,
        score,
    )
    return onward, tally


def _return(
    setting: Setting,
    p: Photons,
    flights: Flight,
    events: list[Scalar],
    limit: Scalar,
    weight: Float[Array, "ends photons"],
    label: Label,
    draw: Draw,
    tally: HigherOrders,
) -> HigherOrders:
    """Deposit the expected return of every end of the flights, each its share."""
    ends, score = setting.plan.ends, None
    if p.score is not None:
        assert flights.moved is not None
        score = p.score[None] - jnp.swapaxes(flights.moved, 1, 2)
        score = score.reshape(-1, score.shape[-1])
    p, flights = dataclasses.replace(p, score=None), dataclasses.replace(flights, moved=None)

    def flat(tree):
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (ends, a.shape[-1])).reshape(-1), tree)

    p, flights, events, limit, draw, label = flat((p, flights, events, limit, draw, label))
    flown = jnp.where(flights.event, flights.distance, 0.0)
    x = along(p.x, p.w, flown)
    landed = flights.landed_on(events, limit)
    hit = collide(setting, x, p.w, flights.cell, flights.collided, landed, draw)
    value = jnp.where(flights.event, flat(weight), 0.0) * hit.ratio / ends
    if score is not None:
        score = score + gains(setting, flights.cell, flights.collided, hit)
    # What is not asked for would be computed as well.
    given = once((p.w, x, p.path + flown, value, label, shown(setting, hit), draw.behind, score))
    return _deposit(setting, tally, *given)


def _arrive(tally: HigherOrders, material: Array | int, label: Label, weight: Scalar) -> HigherOrders:
    return eqx.tree_at(lambda t: t.arrived, tally, book(tally.arrived, (material,), label, weight))


def _leave(tally: HigherOrders, material: Array | int, label: Label, weight: Scalar) -> HigherOrders:
    return eqx.tree_at(lambda t: t.left, tally, book(tally.left, (material,), label, weight))


def _deposit(
    setting: Setting,
    tally: HigherOrders,
    w: Vec,
    x: Vec,
    path: Scalar,
    weight: Scalar,
    label: Label,
    hit: Met,
    behind: tuple[Scalar, ...],
    score: Float[Array, "photons columns"] | None,
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
        if score is not None:
            score = score - rise(setting, medium, x)
    else:
        none, far = jnp.zeros((0, path.size)), jnp.full_like(path, FAR)
        steps, reverse = plan.march_steps, setting.reverse
        how = {"reverse": reverse, "scores": setting.scores}
        back = free_flight(medium, x, v, none, far, weight > 0, steps, **how)
        clear = jnp.exp(-back.total)
        if score is not None:
            assert back.moved is not None
            score = score - back.moved[0].T
    drawn = iter(behind)
    for i, (s, scatterer) in enumerate(zip(setting.surfaces, plan.surfaces)):
        if not s.plate:
            if s.shape.lights_itself and not beam.parallel:
                # A ground may hide its own slopes, and what stands on them, from the sensor.
                clear = jnp.where(s.distance(x, v) < FAR, 0.0, clear)
            continue
        covered = next(drawn) < s.coverage
        crossed = s.distance(x, v) < FAR
        if not s.shape.lights_itself:
            crossed &= hit.on != i
        c = jnp.broadcast_to(s.coverage, path.shape)
        ratio = ratio_of(jnp.where(covered, c, 1.0 - c))
        if s.straight:
            label = label.grown_where(crossed & covered, setting, scatterer.transmitted)
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
    shots, material = None, hit.material
    if setting.viewing is not None:
        assert label.entry is not None
        # One row for each shot that may see it.
        shots, part, later = once(setting.viewing.parts(beam.axis, label.entry, x))
        time, value, material = time[:, None] + later, value[:, None] * part, material[:, None]
    first, row = once(instant_row(setting.bins, time, value))
    for letter, factor in pairs:
        factor = jnp.where(letter >= 0, factor, 0.0)
        for slot, tint in label.grown(setting, letter).slots(shots):
            slot = material * tally.weights.shape[1] + slot
            # Fused into the rows, it would be computed again for each of their bins.
            left = once(factor if tint is None else factor * tint)
            left = left.reshape(left.shape + (1,) * (row.ndim - 1))
            response = scatter_rows(response, slot, first, row * left)
    if score is not None:
        assert tally.scored is not None
        returned = scored(setting, tally.scored, first, row, score, pairs, label)
        tally = eqx.tree_at(lambda t: t.scored, tally, returned)
    return eqx.tree_at(lambda t: t.weights, tally, response.reshape(tally.weights.shape))
