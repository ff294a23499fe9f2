r"""Orders two and above: photons that collide, scatter and at every collision return what is expected.

Photons carry no energy, only the geometric weight of their path and the number of its history. Each
order draws one collision: the optical depth to it, the material, the direction onward. At the
collision the photon deposits the probability of returning from there (pi times the density of
scattering towards the sensor, times the transmittance of the way there).

Derivatives: what is drawn is held fixed (directions, materials, and the place of a collision as a
fraction of the ray's chord through its voxel), and the density with which it was drawn stays in the weight
as p / stop_gradient(p). Voxel sizes, heights and extinction move positions, path lengths and densities
continuously, so the derivative of an expected value is the expected value of the derivative. An
extinction coefficient that is exactly zero is never met, and its derivative here is zero.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .._vector import Scalar, Vec, add, along, dot, polar, scale
from ..constants import SPEED_OF_LIGHT
from ..layout import Bins, Layout
from ..materials import (
    AbstractLaw,
    EqualAngle,
    Lambertian,
    about,
    anywhere,
    facet_normal,
    facet_reflection,
    facet_transmission,
)
from .deposit import instant_row, scatter_rows
from .draws import draws
from .footprint import GOLDEN, Beam, quantile_radius
from .histories import Histories
from .march import FAR, Medium, columns, depth_to_top, free_flight, hold_in_columns
from .surfaces import Surface

CHUNK = 512
_DIMENSIONS = 6

stop = lax.stop_gradient


class Photons(eqx.Module):
    """The state of a chunk of photons.

    `on` is the surface a photon stands on, or -1. `facing` is the normal about which its direction was
    drawn: of length one by the cosine law, two by the equal-angle law; zero where all were alike.
    """

    x: Vec
    w: Vec
    path: Float[Array, "photons"]
    weight: Float[Array, "photons"]
    history: Int[Array, "photons"]
    on: Int[Array, "photons"]
    facing: Vec
    alive: Bool[Array, "photons"]


class HigherOrders(eqx.Module):
    """Response of orders two and above, and the fate of all light (see `jaxlidar.trace.response`)."""

    weights: Float[Array, "materials histories bins"]
    arrived: Float[Array, "materials histories"]
    left: Float[Array, "materials histories"]
    escaped: Float[Array, "histories"]
    late: Float[Array, "histories"]
    remaining: Float[Array, "histories"]


def higher_orders(
    beam: Beam,
    medium: Medium | None,
    surfaces: tuple[Surface, ...],
    layout: Layout,
    table: Histories,
    bins: Bins,
    key: PRNGKeyArray,
    photons: int,
) -> HigherOrders:
    """Trace `photons` photons through up to `layout.orders` scatterings; sums are means per photon."""
    footprint_key, draw_key = jax.random.split(key)
    plates = [i for i, s in enumerate(surfaces) if s.plate]
    numbers = draws(draw_key, layout.orders, _DIMENSIONS + 2 * len(plates))
    shift = jax.random.uniform(footprint_key, (2,))
    tracer = _Tracer(beam, medium, surfaces, layout, table, bins)
    size = min(CHUNK, photons)
    chunks = -(-photons // size)
    count, materials = table.count, len(layout.materials)

    def chunk(tallies, number):
        lane = number * size + jnp.arange(size, dtype=jnp.uint32)
        share = (lane.astype(float) + shift[0]) / photons
        inside = share < 1.0
        r = quantile_radius(beam, jnp.clip(share, 0.0, 1.0 - 1e-7))
        turn = (lane * jnp.uint32(GOLDEN * 2**32)).astype(float) * 2.0**-32 + shift[1]
        across = (r * jnp.cos(2 * jnp.pi * turn), r * jnp.sin(2 * jnp.pi * turn))
        across, share = hold_in_columns(beam, medium, across)
        point, w, excess = beam.ray(across)
        up = jnp.asarray(-layout.upstream, r.dtype)
        start = Photons(
            along(point, w, up),
            w,
            excess + up,
            jnp.where(inside, share / photons, 0.0),
            jnp.zeros((size,), jnp.int32),
            jnp.full((size,), -1, jnp.int32),
            tuple(jnp.zeros_like(r) for _ in range(3)),
            inside,
        )

        def order(carry, n):
            return tracer.one_order(*carry, numbers(lane, n), n), None

        (last, tallies), _ = lax.scan(order, (start, tallies), jnp.arange(layout.orders))
        over = jnp.where(last.alive, stop(last.weight), 0.0)
        return eqx.tree_at(lambda t: t.remaining, tallies, tallies.remaining.at[last.history].add(over)), None

    zero = HigherOrders(
        jnp.zeros((materials * count, bins.padded)),
        jnp.zeros((materials, count)),
        jnp.zeros((materials, count)),
        jnp.zeros((count,)),
        jnp.zeros((count,)),
        jnp.zeros((count,)),
    )
    tallies, _ = lax.scan(chunk, zero, jnp.arange(chunks, dtype=jnp.uint32))
    weights = bins.trim(tallies.weights.reshape(materials, count, bins.padded))
    return eqx.tree_at(lambda t: t.weights, tallies, weights)


class _Tracer(eqx.Module):
    """The scene as constants of the photon loop."""

    beam: Beam
    medium: Medium | None
    surfaces: tuple[Surface, ...]
    layout: Layout = eqx.field(static=True)
    table: Histories = eqx.field(static=True)
    bins: Bins = eqx.field(static=True)
    column: Float[Array, "cells"] | None
    successor: Int[Array, "histories letters"]

    def __init__(self, beam, medium, surfaces, layout, table, bins):
        self.beam, self.medium, self.surfaces = beam, medium, surfaces
        self.layout, self.table, self.bins = layout, table, bins
        self.column = columns(medium) if medium is not None and layout.vertical else None
        self.successor = jnp.asarray(table.successor)

    def grow(
        self, history: Int[Array, "photons"], letter: Int[Array, "photons"] | int
    ) -> Int[Array, "photons"]:
        """The history with one more scattering; unchanged where the letter is -1."""
        if isinstance(letter, int):
            return self.successor[history, letter] if letter >= 0 else history
        grown = self.successor[history, jnp.maximum(letter, 0)]
        return jnp.where(letter >= 0, grown, history)

    def one_order(self, p: Photons, tally: HigherOrders, u: list[Scalar], order: Int[Array, ""]):
        """Fly, collide, deposit, scatter."""
        layout = self.layout
        met, outcomes, ratio = self._plates_ahead(p, u)
        events = [
            d if not s.plate else jnp.where(o == _EVENT, d, FAR)
            for d, s, o in zip(met, self.surfaces, outcomes)
        ]
        limit = jnp.full_like(p.weight, FAR)
        for d in events:
            limit = jnp.minimum(limit, d)
        budget = jnp.maximum(layout.max_path - p.path, 0.0)
        if self.medium is not None and self.surfaces:
            w, limit, turned = self._aim(p, limit, events, (order > 0) & (limit < budget))
            p = eqx.tree_at(lambda p: (p.w, p.weight), p, (w, p.weight * turned))

        # Free flight.
        if self.medium is None:
            collided = jnp.zeros_like(p.alive)
            distance, density = jnp.minimum(limit, budget), jnp.ones_like(p.weight)
            in_medium = collided
            cell = jnp.zeros_like(p.history)
        else:
            target = -jnp.log(u[0])
            free = free_flight(
                self.medium, p.x, p.w, target, jnp.minimum(limit, budget), p.alive, layout.march_steps
            )
            collided, cell = free.collided, free.cell
            k = jnp.where(collided, self.medium.extinction(cell, p.w), 1.0)
            chord = jnp.where(collided, free.chord, 1.0)
            part = jnp.clip((target - free.depth) / jnp.maximum(k * chord, 1e-30), 0.0, 1.0)
            part = stop(jnp.where(collided, part, 0.0))
            depth = free.depth + jnp.where(collided, part * k * chord, 0.0)
            distance = jnp.where(collided, free.entered + part * chord, jnp.minimum(limit, budget))
            density = jnp.exp(stop(depth) - depth) * chord / stop(chord)
            in_medium = ~collided & (free.entered >= budget)
        landed = p.alive & ~collided & (limit < budget)
        collided = p.alive & collided
        event = collided | landed
        late = p.alive & ~event & ((limit < FAR) | in_medium)
        escaped = p.alive & ~event & ~late

        # Plates that were passed on the way.
        weight, history = p.weight * density, p.history
        for i, (s, d, o) in enumerate(zip(self.surfaces, met, outcomes)):
            if not s.plate:
                continue
            own = events[i] <= distance
            passed = p.alive & (d < FAR) & ((d < distance) | ~event) & ~own
            weight = weight * jnp.where(passed | (landed & own), ratio[i], 1.0)
            through = passed & (o == _THROUGH)
            scatterer = layout.surfaces[i]
            tally = self._arrive(tally, scatterer.material, history, jnp.where(through, weight, 0.0))
            history = jnp.where(through, self.grow(history, scatterer.transmitted), history)
            weight = jnp.where(through, weight / (1.0 - layout.lobe), weight)
            tally = self._leave(tally, scatterer.material, history, jnp.where(through, weight, 0.0))

        held = stop(weight)
        tally = eqx.tree_at(
            lambda t: (t.escaped, t.late),
            tally,
            (
                tally.escaped.at[history].add(jnp.where(escaped, held, 0.0)),
                tally.late.at[history].add(jnp.where(late, held, 0.0)),
            ),
        )

        x = along(p.x, p.w, jnp.where(event, distance, 0.0))
        path = p.path + jnp.where(event, distance, 0.0)
        hit = self._hit(p.w, cell, collided, landed, events, limit, u)
        weight = jnp.where(event, weight * hit.ratio, 0.0)
        tally = self._arrive(tally, hit.material, history, weight)
        tally = self._deposit(tally, p.w, x, path, jnp.where(order > 0, weight, 0.0), history, hit, event, u)
        history = self.grow(history, hit.letter)
        weight = weight * hit.onward
        tally = self._leave(tally, hit.material, history, weight)
        return Photons(x, hit.w, path, weight, history, hit.on, hit.facing, event), tally

    def _aim(self, p: Photons, limit: Scalar, events: list[Scalar], heading: Bool[Array, "photons"]):
        """Direction, distance and density ratio of rays towards a surface, as geometry moves them.

        The transmittance of the way back jumps where a landing point crosses from below one column of
        voxels to the next. With the direction held fixed, points would cross; with the point held fixed
        in its column, rays that start just above the surface would have to turn without bound. So points move
        with the share `fade` of the former motion: none at a column's faces, and nearly all for rays
        shorter than the way to the next face. Values do not change, only derivatives.
        """
        medium = self.medium
        heading &= p.alive
        reach = jnp.where(heading, limit, 1.0)
        direct = along(p.x, p.w, reach)
        held = jax.tree.map(stop, direct)
        normal, offset = tuple(jnp.zeros_like(reach) for _ in range(3)), jnp.zeros_like(reach)
        for s, d in zip(self.surfaces, events):
            here = d <= limit
            normal = tuple(jnp.where(here, n, m) for n, m in zip(s.normal, normal))
            offset = jnp.where(here, s.offset, offset)
        upright = jnp.where(heading, normal[2], 1.0)

        def on_surface(x, y):
            z = (offset - normal[0] * x - normal[1] * y) / upright
            return x, y, jnp.where(heading, z, direct[2])

        def seen_from(point):
            way = add(point, scale(p.x, jnp.asarray(-1.0)))
            far2 = jnp.maximum(dot(way, way), 1e-20)
            return scale(way, 1.0 / jnp.sqrt(far2)), jnp.sqrt(far2)

        # Fixed in the column.
        size, origin = medium.size[:2], medium.origin[:2]
        place = [stop((held[k] - origin[k]) / size[k]) for k in range(2)]
        column = on_surface(*(origin[k] + size[k] * place[k] for k in range(2)))
        w, far = seen_from(column)
        # Per area of the map, from which the sloping surface is projected.
        density = _drawn(p.facing, w) * jnp.abs(dot(normal, w) / upright) / (far * far) * (size[0] * size[1])
        ratio = jnp.where(heading, _ratio(density), 1.0)

        rise = jnp.maximum(stop(reach * jnp.abs(dot(normal, p.w))), 1e-6)
        fades, slopes = [], []
        for k in range(2):
            within = place[k] - jnp.floor(place[k])
            nearest = jnp.minimum(within, 1.0 - within) * stop(size[k])
            fades.append(jnp.minimum(nearest / rise, 1.0))
            slopes.append(jnp.where(nearest < rise, jnp.where(within < 0.5, 1.0, -1.0) / rise, 0.0))
        fade = fades[0] * fades[1]
        gradient = (slopes[0] * fades[1], slopes[1] * fades[0])
        apart = [(direct[k] - held[k]) - (column[k] - stop(column[k])) for k in range(2)]
        turned = 1.0 + (1.0 - fade) * (ratio - 1.0) + gradient[0] * apart[0] + gradient[1] * apart[1]
        x, y = (held[k] + (column[k] - stop(column[k])) + fade * apart[k] for k in range(2))
        w, far = seen_from(on_surface(x, y))
        # Values stay those that were drawn, to the last digit.
        w = tuple(jnp.where(heading, stop(a) + (b - stop(b)), a) for a, b in zip(p.w, w))
        far = jnp.where(heading, stop(limit) + (far - stop(far)), limit)
        return w, far, jnp.where(heading, turned, 1.0)

    def _arrive(self, tally, material, history, weight):
        return eqx.tree_at(lambda t: t.arrived, tally, tally.arrived.at[material, history].add(stop(weight)))

    def _leave(self, tally, material, history, weight):
        return eqx.tree_at(lambda t: t.left, tally, tally.left.at[material, history].add(stop(weight)))

    def _plates_ahead(self, p: Photons, u: list[Scalar]):
        """Distance to each surface, what will happen at each plate, and the density ratio of that."""
        met, outcomes, ratios = [], [], []
        drawn = iter(u[_DIMENSIONS:])
        for i, s in enumerate(self.surfaces):
            met.append(jnp.where(p.on == i, FAR, s.distance(p.x, p.w)))
            if not s.plate:
                outcomes.append(None)
                ratios.append(None)
                continue
            v, c = next(drawn), jnp.broadcast_to(s.coverage, p.weight.shape)
            hit = v < c
            outcome = jnp.where(hit, _EVENT, _GAP)
            if s.straight and self.layout.surfaces[i].transmitted >= 0:
                # The lobe is chosen with the number that decided that the plate was hit.
                outcome = jnp.where(hit & (v >= c * self.layout.lobe), _THROUGH, outcome)
            outcomes.append(outcome)
            ratios.append(_ratio(jnp.where(hit, c, 1.0 - c)))
        return met, outcomes, ratios

    def _hit(self, w, cell, collided, landed, events, limit, u) -> "_Hit":
        """What was hit, how it scatters, and whereto."""
        layout, one = self.layout, jnp.ones_like(limit)
        none = jnp.full(limit.shape, -1, jnp.int32)
        hit = _Hit(jnp.zeros_like(none), none, one, one, w, none, none, none, w, w)
        if self.medium is not None:
            hit = _merge(collided, self._in_medium(w, cell, u), hit)
        for i, (s, scatterer) in enumerate(zip(self.surfaces, layout.surfaces)):
            here = landed & (events[i] <= limit)
            normal = s.lit_normal(w)
            out = s.law.sample(*jax.tree.map(stop, (w, normal)), u[4], u[5])
            facing = _facing(s.law, normal)
            ratio, onward, letter = _ratio(s.law.density(w, normal, out)), one, scatterer.reflected
            letters = jnp.full_like(none, letter)
            if scatterer.transmitted >= 0:
                if s.straight:
                    onward = one / layout.lobe
                else:
                    through = u[1] >= layout.lobe
                    far = about(tuple(-n for n in jax.tree.map(stop, normal)), u[4], u[5])
                    out = tuple(jnp.where(through, f, o) for f, o in zip(far, out))
                    facing = tuple(jnp.where(through, -n, f) for n, f in zip(normal, facing))
                    ratio = jnp.where(through, _ratio(-dot(normal, far)), ratio)
                    onward = jnp.where(through, 1.0 / (1.0 - layout.lobe), 1.0 / layout.lobe)
                    letters = jnp.where(through, scatterer.transmitted, letters)
            diffuse = scatterer.transmitted if not s.straight else -1
            surface = _Hit(
                jnp.full_like(none, scatterer.material),
                letters,
                one,
                onward * ratio,
                jax.tree.map(stop, out),
                jnp.full_like(none, i),
                jnp.full_like(none, scatterer.reflected),
                jnp.full_like(none, diffuse),
                normal,
                jax.tree.map(stop, facing),
            )
            hit = _merge(here, surface, hit)
        return hit

    def _in_medium(self, w, cell, u) -> "_Hit":
        medium, layout = self.medium, self.layout
        assert medium is not None
        leaf_k = None if medium.leaf is None else medium.leaf_at(cell, w)
        bark_k = None if medium.bark is None else medium.bark_at(cell)
        like = jnp.zeros_like(cell)
        parts = []
        if layout.leaf is not None:
            onward, letter = jnp.ones_like(u[0]), jnp.full_like(like, layout.leaf.reflected)
            if bark_k is None:
                chosen, share = jnp.ones_like(u[1], bool), u[1]
            else:
                p = leaf_k / jnp.maximum(leaf_k + bark_k, 1e-30)
                chosen, share = u[1] < p, u[1] / jnp.maximum(p, 1e-30)
            ratio = _ratio(leaf_k)
            if layout.leaf_isotropic:
                normal, out, facing = w, anywhere(u[4], u[5]), tuple(0.0 * n for n in w)
            else:
                if medium.angles is None:
                    normal = facet_normal(w, u[2], u[3])
                else:
                    normal, more = self._leaf_normal(w, u[2], u[3])
                    ratio = ratio * more
                out, facing = about(normal, u[4], u[5]), normal
                if layout.leaf.transmitted >= 0:
                    through = share >= layout.lobe
                    facing = tuple(jnp.where(through, -n, n) for n in normal)
                    lift = jnp.where(through, 2.0 * dot(out, normal), 0.0)
                    out = tuple(o - lift * n for o, n in zip(out, normal))
                    letter = jnp.where(through, layout.leaf.transmitted, letter)
                    onward = jnp.where(through, 1.0 / (1.0 - layout.lobe), 1.0 / layout.lobe)
            parts.append((chosen, layout.leaf, letter, ratio, onward, out, normal, facing))
        if layout.bark is not None:
            chosen = jnp.ones_like(u[1], bool) if not parts else ~parts[0][0]
            if layout.bark_isotropic:
                normal, out, facing = w, anywhere(u[4], u[5]), tuple(0.0 * n for n in w)
            else:
                normal = facing = facet_normal(w, u[2], u[3])
                out = about(normal, u[4], u[5])
            letter = jnp.full_like(like, layout.bark.reflected)
            one = jnp.ones_like(u[0])
            parts.append((chosen, layout.bark, letter, _ratio(bark_k), one, out, normal, facing))
        hit = None
        for chosen, scatterer, letter, ratio, onward, out, normal, facing in parts:
            full = jnp.full_like(like, scatterer.material)
            none = jnp.full_like(like, -1)
            part = _Hit(
                full,
                letter,
                ratio,
                onward,
                jax.tree.map(stop, out),
                none,
                jnp.full_like(like, scatterer.reflected),
                jnp.full_like(like, scatterer.transmitted),
                jax.tree.map(stop, normal),
                jax.tree.map(stop, facing),
            )
            hit = part if hit is None else _merge(chosen, part, hit)
        assert hit is not None
        return hit

    def _leaf_normal(self, w, u, v):
        """A normal on the lit side from the leaf angle distribution, and |normal . w| / G(w)."""
        medium = self.medium
        p = medium.leaf_angles.normalised()
        number = jnp.sum(jnp.cumsum(stop(p))[None, :-1] < u[:, None], axis=1)
        theta = (number + 0.5) * (0.5 * jnp.pi / p.size)
        normal = polar(jnp.cos(theta), 2 * jnp.pi * v)
        cosine = dot(normal, w)
        normal = tuple(jnp.where(cosine > 0, -n, n) for n in normal)
        return normal, jnp.abs(cosine) / medium.angles.projection_at(w) * _ratio(p[number])

    def _deposit(self, tally, w, x, path, weight, history, hit, event, u):
        """Return what is expected to reach the sensor from each collision."""
        beam, layout, medium = self.beam, self.layout, self.medium
        v = beam.view(x)
        reflected, transmitted = self._view_factors(w, v, hit)
        if medium is None:
            clear = jnp.ones_like(path)
        elif layout.vertical:
            clear = jnp.exp(-jax.vmap(lambda x: depth_to_top(medium, x, self.column))(x))
        else:
            far = jnp.full_like(path, FAR)
            clear = jnp.exp(-free_flight(medium, x, v, far, far, event, layout.march_steps).depth)
        drawn = iter(u[_DIMENSIONS + sum(s.plate for s in self.surfaces) :])
        for i, (s, scatterer) in enumerate(zip(self.surfaces, layout.surfaces)):
            if not s.plate:
                continue
            covered = next(drawn) < s.coverage
            crossed = (s.distance(x, v) < FAR) & (hit.on != i)
            c = jnp.broadcast_to(s.coverage, path.shape)
            ratio = _ratio(jnp.where(covered, c, 1.0 - c))
            if s.straight:
                history = jnp.where(crossed & covered, self.grow(history, scatterer.transmitted), history)
                through = ratio if scatterer.transmitted >= 0 else jnp.where(covered, 0.0, ratio)
            else:
                through = jnp.where(covered, 0.0, ratio)
            clear = clear * jnp.where(crossed, through, 1.0)
        out = beam.excess(x)
        time = (path + out) / SPEED_OF_LIGHT
        # Apparent reflectance refers to the range that the time of arrival stands for.
        spread = ((beam.slant_range + 0.5 * (path + out)) / (beam.slant_range + out)) ** 2
        value = jnp.where(event, weight * clear * spread * beam.in_view(x), 0.0)
        response = tally.weights
        pairs = [(hit.reflected, reflected)]
        if transmitted is not None:
            pairs.append((hit.transmitted, transmitted))
        first, row = instant_row(self.bins, time, value)
        for letter, factor in pairs:
            slot = hit.material * self.table.count + self.grow(history, letter)
            factor = jnp.where(letter >= 0, factor, 0.0)
            response = scatter_rows(response, slot, first, row * factor[:, None])
        return eqx.tree_at(lambda t: t.weights, tally, response)

    def _view_factors(self, w, v, hit):
        """Apparent reflectance per unit reflectance, and per unit transmittance (None if none has any)."""
        layout, medium = self.layout, self.medium
        reflected = jnp.zeros_like(w[0])
        transmits = [s.transmitted >= 0 and not p.straight for s, p in zip(layout.surfaces, self.surfaces)]
        if layout.leaf is not None:
            transmits.append(layout.leaf.transmitted >= 0)
        transmitted = jnp.zeros_like(w[0]) if any(transmits) else None
        if medium is not None:
            angle = dot(w, v)
            facet = facet_reflection(angle)
            if layout.leaf is not None:
                here = (hit.on < 0) & (hit.material == layout.leaf.material)
                leaf = jnp.full_like(angle, 0.25)
                if not layout.leaf_isotropic:
                    leaf = facet if medium.angles is None else jnp.maximum(dot(hit.normal, v), 0.0)
                reflected = jnp.where(here, leaf, reflected)
                if layout.leaf.transmitted >= 0:
                    through = (
                        facet_transmission(angle)
                        if medium.angles is None
                        else jnp.maximum(-dot(hit.normal, v), 0.0)
                    )
                    transmitted = jnp.where(here, through, transmitted)
            if layout.bark is not None:
                here = (hit.on < 0) & (hit.material == layout.bark.material)
                reflected = jnp.where(here, 0.25 if layout.bark_isotropic else facet, reflected)
        for i, (s, scatterer) in enumerate(zip(self.surfaces, layout.surfaces)):
            here = hit.on == i
            normal = s.lit_normal(w)
            lit = dot(normal, v) > 0
            factor = s.law.view_factor(w, normal, v, self.beam.half_angle)
            reflected = jnp.where(here, jnp.where(lit, factor, 0.0), reflected)
            if scatterer.transmitted >= 0 and not s.straight:
                transmitted = jnp.where(here, jnp.maximum(-dot(normal, v), 0.0), transmitted)
        return reflected, transmitted


class _Hit(eqx.Module):
    """A collision: material, letter that was drawn, density ratios, new direction; letters for the return."""

    material: Int[Array, "photons"]
    letter: Int[Array, "photons"]
    ratio: Float[Array, "photons"]
    onward: Float[Array, "photons"]
    w: Vec
    on: Int[Array, "photons"]
    reflected: Int[Array, "photons"]
    transmitted: Int[Array, "photons"]
    normal: Vec
    facing: Vec


_GAP, _EVENT, _THROUGH = 0, 1, 2


def _facing(law: AbstractLaw, normal: Vec) -> Vec:
    """How `Photons.facing` remembers the law by which a surface sent a photon on."""
    length = {Lambertian: 1.0, EqualAngle: 2.0}.get(type(law), 0.0)
    return scale(normal, jnp.asarray(length))


def _drawn(facing: Vec, w: Vec) -> Scalar:
    """Relative density with which the direction `w` was drawn."""
    kind, cosine = dot(facing, facing), dot(facing, w)
    equal = 1.0 / jnp.sqrt(jnp.maximum(1.0 - 0.25 * cosine * cosine, 1e-6))
    return jnp.where(kind > 2.0, equal, jnp.where(kind > 0.5, jnp.maximum(cosine, 1e-6), 1.0))


def _merge(where: Bool[Array, "photons"], a: _Hit, b: _Hit) -> _Hit:
    return jax.tree.map(lambda p, q: jnp.where(where, p, q), a, b)


def _ratio(density: Scalar) -> Scalar:
    """One, with the relative derivative of a density; no derivative where the density is zero."""
    held = stop(density)
    safe = jnp.where(held == 0, 1.0, held)
    return jnp.where(held == 0, 1.0, 1.0 + (density - held) / safe)
