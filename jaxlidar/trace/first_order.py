r"""First order: every ray of the footprint is marched through the scene, and its expected return deposited.

Nothing is random. With extinction coefficients k_m of the materials m, their sum k, and the optical depth tau
from the sensor, the return from a stretch of the ray is

    f_m * integral of k_m exp(-kappa tau(s)) ds,    kappa = 2, or 1 with the hot spot,

integrated exactly over every piece of the ray that lies within one voxel and one time bin. f_m is the
intensity factor for backscatter (`jaxlidar.optics.facets`, `jaxlidar.optics.phase`).
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._one_function import once
from jaxlidar._vectors import FAR, Scalar, Vec, along, scale
from jaxlidar.optics.facets import FACET_BACKSCATTER
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.trace_plan import TracePlan
from jaxlidar.trace.deposit import instant_row, scatter_rows, smooth_row
from jaxlidar.trace.histories import Histories
from jaxlidar.trace.march import Medium
from jaxlidar.trace.reparametrise import footprint_rays, rays_to_terrain, sees_terrain
from jaxlidar.trace.scored_light import rows_of_stretches, scatter_columns, with_scores
from jaxlidar.trace.scores import rows_of
from jaxlidar.trace.setting import Setting
from jaxlidar.trace.stretches import Stretches, in_blocks, march_ray, mean_decay, stretch_pieces
from jaxlidar.trace.surfaces import Surface

CHUNK = 512


class Passage:
    """Transmission of light by the plates it passes `ways` times, as exponents and their weights.

    A fully covering plate multiplies by T each time; a partial one by (1 - c) + c T, which is expanded so
    that each term is a monomial in T.
    """

    def __init__(self, surfaces: tuple[Surface, ...], plan: TracePlan, ways: int):
        self.plates = [(i, s, plan.surfaces[i].transmitted) for i, s in enumerate(surfaces) if s.plate]
        choices = []
        for i, s, letter in self.plates:
            c = s.coverage
            # A plate without a letter for transmittance is opaque.
            straight = s.straight and letter >= 0
            if plan.full_cover[i]:
                options = [(ways, jnp.ones_like(c) if straight else jnp.zeros_like(c))]
            elif straight:
                terms = {1: [1 - c, c], 2: [(1 - c) ** 2, 2 * c * (1 - c), c**2]}[ways]
                options = list(enumerate(terms))
            else:
                options = [(0, (1 - c) ** ways)]
            # Where the plate is not in the way, the first option alone stands, with weight one.
            choices.append([(*option, float(n == 0)) for n, option in enumerate(options)])
        self.combinations = list(itertools.product(*choices))

    def terms(self, table: Histories, base: int, s: Scalar, met: list[Scalar]):
        """Pairs of history and weight for light that scatters at distance `s` into history `base`.

        The history is an array, or a number where there are no plates.
        """
        if not self.plates:
            yield base, jnp.ones_like(s)
            return
        successor = jnp.asarray(table.successor)
        for combination in self.combinations:
            number = jnp.full(s.shape, base, jnp.int32)
            weight = jnp.ones_like(s)
            for (i, _, letter), (exponent, value, absent) in zip(self.plates, combination):
                above = met[i] < s
                grown = number
                for _ in range(exponent if letter >= 0 else 0):
                    grown = successor[grown, letter]
                number = jnp.where(above, grown, number)
                weight = weight * jnp.where(above, value, absent)
            yield number, weight


class FirstOrder(eqx.Module):
    """Deterministic first-order response, and the fate of the light that it describes.

    `scattered`: how much of the light that arrived is scattered at all, per unit optics. `scored`:
    derivatives of the weights, where scores are asked for.
    """

    weights: Float[Array, "materials histories bins"]
    outside: Float[Array, "materials histories"]
    arrived: Float[Array, "materials histories"]
    scattered: Float[Array, "materials histories"]
    escaped: Float[Array, "histories"]
    scored: Float[Array, "materials histories bins columns"] | None = None


class Sent(NamedTuple):
    """Rays of the footprint: where they start above the scene, their directions, and what they meet.

    - `x`, `w`: start and direction. - `excess`: way from the sensor to the start, m, less the slant range.
    - `energy`: share of the pulse's. - `met`: distance to each surface, m; `stop`: to the ground.
    """

    x: Vec
    w: Vec
    excess: Scalar
    energy: Scalar
    met: list[Scalar]
    stop: Scalar


def sent_rays(setting: Setting, across: tuple[Scalar, Scalar], energy: Scalar) -> Sent:
    """The rays through `across`, which carry the shares `energy`."""
    beam, plan = setting.beam, setting.plan
    across, share = footprint_rays(beam, setting.medium, across)
    energy = energy * share
    if sees_terrain(setting):
        across, share = rays_to_terrain(setting, across)
        energy = energy * share
    point, w, excess = beam.ray(across)
    x = along(point, w, jnp.asarray(-plan.upstream, energy.dtype))
    met = [s.distance(x, w) for s in setting.surfaces]
    stop = met[0] if plan.has_ground else jnp.full_like(energy, FAR)
    return Sent(x, w, excess - plan.upstream, energy, met, stop)


def march_rays(setting: Setting, sent: Sent) -> tuple[Stretches, list[Scalar], Scalar]:
    """As `march_ray`, for all rays, up to the ground; `stops` are the surfaces.

    Stretches stay along the first axis, where the march leaves them: transposing costs as much.
    """
    plan, medium = setting.plan, setting.medium
    assert medium is not None
    step = jnp.asarray(plan.max_step, sent.energy.dtype)
    march = jax.vmap(march_ray, (None, 0, 0, 0, 0, None, None), (1, 0, 0))
    return march(medium, sent.x, sent.w, sent.stop, sent.met, plan.first_steps, step)


def first_order(
    setting: Setting,
    across: tuple[Float[Array, "rays"], Float[Array, "rays"]],
    energy: Float[Array, "rays"],
    *,
    mirror: int | None = None,
) -> FirstOrder:
    """Response of order one.

    `across` and `energy` give the place of each ray across the beam and its share of energy. With `mirror`,
    the rays carry what that surface returns of them (see `jaxlidar.trace.mirror`), and nothing else is
    deposited.
    """
    beam, medium, surfaces = setting.beam, setting.medium, setting.surfaces
    plan, table, bins = setting.plan, setting.short, setting.bins
    count, leaf = table.count, -1 if plan.leaf is None else plan.leaf.material
    out_way, both_ways = Passage(surfaces, plan, 1), Passage(surfaces, plan, 2)
    kappa = 1.0 if plan.hotspot else 2.0
    successor = table.successor
    materials, scores = len(plan.materials), setting.scores

    def deposited(tally, stretch, light):
        """A tally with what stretches add to it; `light` is that of the ray of each."""
        assert medium is not None
        (response, arrived, scored), (sent, visible) = tally, light
        k, way, before = stretch.extinction, sent.w, sent.met
        low = bins.position(2.0 * (sent.excess + stretch.start) / SPEED_OF_LIGHT)
        first, pieces = stretch_pieces(bins, low, stretch, kappa)
        passing = jnp.exp(-stretch.depth) * mean_decay(k * stretch.length) * stretch.length
        middle = stretch.start + 0.5 * stretch.length
        for m, part in _parts(medium, plan, stretch, way) if mirror is None else ():
            value = part.extinction * (part.backscatter * visible)
            for history, share in both_ways.terms(table, int(successor[0, part.letter]), middle, before):
                slot = jnp.broadcast_to(m * count + history, first.shape)
                # Fused, what the pieces are multiplied by would be computed again for each, out of order.
                row = once(pieces * once(value * share)[None])
                row = jnp.moveaxis(row, 0, -1)
                response = scatter_rows(response, slot, first, row)
                if scores is not None:
                    assert scored is not None
                    given = part.extinction, part.backscatter * visible * share
                    rows = rows_of_stretches(setting, m == leaf, way, low, stretch, kappa, *given)
                    scored = scatter_columns(scored, slot, first, rows)
            for history, share in out_way.terms(table, 0, middle, before):
                weight = part.extinction * passing * share * sent.energy
                arrived = _add(arrived, m * count + history, weight)
        return response, arrived, scored

    def rays(across, energy):
        x, w, excess, energy, met, stop = sent = sent_rays(setting, across, energy)
        visible = energy * beam.in_view(along(x, w, jnp.minimum(stop, plan.upstream)))
        response = jnp.zeros((materials * count, bins.padded), energy.dtype)
        arrived = jnp.zeros((materials * count,), energy.dtype)
        scattered, escaped = arrived, jnp.zeros((count,), energy.dtype)
        at_stops, total = [jnp.zeros_like(energy) for _ in met], jnp.zeros_like(energy)
        scored, moved = None, []
        if scores is not None:
            scored = jnp.zeros((materials * count, bins.padded, scores.count), energy.dtype)

        if medium is not None:
            stretch, at_stops, total = march_rays(setting, sent)
            if scores is not None:
                stretch, moved = with_scores(setting, stretch, w, met)

            tally, light = (response, arrived, scored), (sent, visible)
            if setting.reverse:

                def step(tally, stretch):
                    return deposited(tally, stretch, light), None

                response, arrived, scored = lax.scan(step, tally, stretch)[0]
            else:
                there = stretch.extinction > 0.0 if setting.derivatives == "none" else None
                response, arrived, scored = in_blocks(deposited, tally, stretch, light, there)
            # Smoothing is linear, so only the sum is smoothed. All that collides is scattered.
            response, scattered = smooth_row(response, bins.kernel)[:, 1:-1], arrived
            if scored is not None:
                smooth = smooth_row(jnp.swapaxes(scored, 1, 2), bins.kernel)[..., 1:-1]
                scored = jnp.swapaxes(smooth, 1, 2)

        for i, (s, scatterer) in enumerate(zip(surfaces, plan.surfaces)):
            if mirror is not None and i != mirror:
                continue
            hit = jnp.where((met[i] <= stop) & (met[i] < FAR), s.coverage * energy, 0.0)
            at = along(x, w, jnp.where(met[i] < FAR, met[i], 0.0))
            normal, back = s.lit_normal(at, w), scale(w, jnp.asarray(-1.0))
            for history, share in out_way.terms(table, 0, met[i], met):
                weight = hit * jnp.exp(-at_stops[i]) * share
                slot = scatterer.material * count + history
                arrived = _add(arrived, slot, weight)
                scattered = _add(scattered, slot, weight * s.by_place(at, s.law.albedo(w, normal)))
            if mirror is None and isinstance(s.law, AbstractMirror):
                continue
            seen = s.by_place(at, beam.in_view(at))
            if mirror is None:
                seen = s.law.intensity_factor(w, normal, back, beam.half_angle) * seen
            time = 2.0 * (excess + jnp.minimum(met[i], 1e9)) / SPEED_OF_LIGHT
            first, row = instant_row(bins, time, hit * seen * jnp.exp(-kappa * at_stops[i]))
            for history, share in both_ways.terms(table, int(successor[0, scatterer.reflected]), met[i], met):
                slot = jnp.broadcast_to(scatterer.material * count + history, first.shape)
                response = scatter_rows(response, slot, first, row * share[:, None])
                if scored is not None:
                    rows = rows_of(lax.stop_gradient(row * share[:, None]), -kappa * moved[i])
                    scored = scatter_columns(scored, slot, first, rows)

        gone = jnp.where(stop < FAR, 0.0, energy * jnp.exp(-total))
        for history, share in out_way.terms(table, 0, stop, met):
            escaped = _add(escaped, history, gone * share)
        shape = (materials, count)
        if scored is not None:
            scored = scored[:, bins.row : bins.row + bins.count].reshape(*shape, bins.count, -1)
        return response, (arrived.reshape(shape), scattered.reshape(shape), escaped), scored

    n = energy.shape[0]
    fill = -n % CHUNK
    padded = [jnp.pad(a, (0, fill)).reshape(-1, CHUNK) for a in (*across, energy)]

    def chunk(x, y, e):
        return rays((x, y), e)

    if n <= CHUNK:
        response, fate, scored = rays(across, energy)
    elif medium is None:
        # Without a march all chunks fit into the memory at once, and no loop is compiled.
        each = jax.vmap(chunk)(*padded)
        response, fate, scored = jax.tree.map(lambda a: jnp.sum(a, axis=0), each)
    else:
        zero = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(rays, across, energy))

        def add(total, part):
            return jax.tree.map(jnp.add, total, chunk(*part)), None

        response, fate, scored = lax.scan(add, zero, padded)[0]
    weights, outside = bins.trimmed(response.reshape(materials, count, bins.padded))
    arrived, scattered, escaped = fate
    return FirstOrder(weights, outside, arrived, scattered, escaped, scored)


def _together(slot: Int[Array, "*s"] | int, weight: Float[Array, "*s"]):
    """Slots and weights to add; one sum where all rays have the same slot."""
    return (slot, jnp.sum(weight)) if isinstance(slot, int) else (slot, weight)


def _add(
    into: Float[Array, "slots"], slot: Int[Array, "*s"] | int, weight: Float[Array, "*s"]
) -> Float[Array, "slots"]:
    slot, weight = _together(slot, weight)
    return into.at[slot].add(weight)


class Part(eqx.Module):
    """One material of the medium on a ray: its extinction, intensity factor for backscatter, and letter."""

    extinction: Float[Array, "..."]
    backscatter: Float[Array, "..."] | float
    letter: int = eqx.field(static=True)


def _parts(medium: Medium, plan: TracePlan, stretch: Stretches, w: Vec) -> Iterator[tuple[int, Part]]:
    """Number of each material of the medium, and what it returns from stretches of rays along `w`."""
    back = scale(w, jnp.asarray(-1.0))
    if medium.leaf is not None and plan.leaf is not None:
        k = stretch.extinction if medium.bark is None else medium.leaf_at(stretch.cell, w)
        factor = FACET_BACKSCATTER
        if medium.leaf_phase is not None:
            factor = medium.leaf_phase.intensity_factor(w, back)
        elif medium.angles is not None:
            factor = medium.angles.square_at(w) / medium.angles.projection_at(w)
        yield plan.leaf.material, Part(k, factor, plan.leaf.reflected)
    if medium.bark is not None and plan.bark is not None:
        k = stretch.extinction if medium.leaf is None else medium.bark_at(stretch.cell)
        factor = FACET_BACKSCATTER
        if medium.bark_phase is not None:
            factor = medium.bark_phase.intensity_factor(w, back)
        yield plan.bark.material, Part(k, factor, plan.bark.reflected)
