r"""First order: every ray of the footprint is marched through the scene, and its expected return deposited.

Nothing is random. With extinction coefficients k_m of the materials m, their sum k, and the optical depth tau
from the sensor, the return from a stretch of the ray is

    f_m * integral of k_m exp(-kappa tau(s)) ds,    kappa = 2, or 1 with the hot spot,

integrated exactly over every piece of the ray that lies within one voxel and one time bin. f_m is the view
factor for backscatter (`jaxlidar.optics.facets`, `jaxlidar.optics.phase`).
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
from jaxlidar._vectors import FAR, Scalar, Vec, along, scale, vec
from jaxlidar.optics.facets import FACET_BACKSCATTER
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.trace_plan import Bins, TracePlan
from jaxlidar.trace.deposit import first_bin, instant_row, scatter_rows, smooth_row
from jaxlidar.trace.histories import Histories
from jaxlidar.trace.march import Medium, advance, begin, cell_of, earlier, later
from jaxlidar.trace.reparametrise import footprint_rays, rays_to_terrain, sees_terrain
from jaxlidar.trace.setting import Setting
from jaxlidar.trace.surfaces import Surface

CHUNK = 512


class Stretches(eqx.Module):
    """Pieces of one ray between faces: start, length (m), depth at its start, voxel, extinction (1/m)."""

    start: Float[Array, "*steps"]
    length: Float[Array, "*steps"]
    depth: Float[Array, "*steps"]
    cell: Int[Array, "*steps"]
    extinction: Float[Array, "*steps"]


def mean_decay(x: Scalar) -> Scalar:
    """(1 - exp(-x)) / x for x >= 0, with its derivative; accurate down to and at zero."""
    return _decay(x)[1]


def _decay(x: Scalar) -> tuple[Scalar, Scalar]:
    """exp(-x) and (1 - exp(-x)) / x, the latter for small x as exp(-x/2) sinh(x/2) / (x/2)."""
    small = x < 1.0
    square = 0.25 * x * x
    series = jnp.ones_like(x)
    # Terms to the last digit at 1.
    for n in range(3 if jnp.finfo(x.dtype).bits == 32 else 7, 0, -1):
        series = 1.0 + square * (1.0 / (2 * n * (2 * n + 1))) * series
    half = jnp.exp(-0.5 * x)
    passing = half * half
    return passing, jnp.where(small, half * series, (1.0 - passing) / jnp.where(small, 1.0, x))


def march_ray(
    medium: Medium, x: Vec, w: Vec, end: Scalar, stops: list[Scalar], steps: int, max_step: Scalar
) -> tuple[Stretches, list[Scalar], Scalar]:
    """All stretches of one ray up to `end`, and the optical depth at each of `stops` and at its end."""
    walk = begin(medium, x, w)
    end = earlier(end, walk.leave)

    def step(state, _):
        distance, depth, voxel, at_stops = state
        faces = lax.optimization_barrier(walk.faces(voxel))
        face = earlier(earlier(faces[0], faces[1]), faces[2])
        to = earlier(end, earlier(face, distance + max_step))
        for stop in stops:
            # Plates lie between stretches, not within one.
            to = jnp.where(stop > distance, earlier(to, stop), to)
        cell = cell_of(medium, voxel)
        k = medium.extinction(cell, w)
        to, cell, k = lax.optimization_barrier((later(distance, to), cell, k))
        length = to - distance
        at_stops = [
            a + k * (later(distance, earlier(stop, to)) - distance) for a, stop in zip(at_stops, stops)
        ]
        moved = advance(walk, voxel, faces, (to >= face) & (to < end))
        return (to, depth + k * length, moved, at_stops), Stretches(distance, length, depth, cell, k)

    zero = jnp.zeros_like(end)
    state = (jnp.minimum(walk.enter, end), zero, walk.voxel, [zero] * len(stops))
    (_, total, _, at_stops), stretches = lax.scan(step, state, None, length=steps)
    return stretches, at_stops, total


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

    `scattered`: how much of the light that arrived is scattered at all, per unit optics.
    """

    weights: Float[Array, "materials histories bins"]
    outside: Float[Array, "materials histories"]
    arrived: Float[Array, "materials histories"]
    scattered: Float[Array, "materials histories"]
    escaped: Float[Array, "histories"]


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
    count = table.count
    out_way, both_ways = Passage(surfaces, plan, 1), Passage(surfaces, plan, 2)
    kappa = 1.0 if plan.hotspot else 2.0
    successor = table.successor
    materials = len(plan.materials)

    def rays(across, energy):
        x, w, excess, energy, met, stop = sent = sent_rays(setting, across, energy)
        visible = energy * beam.in_view(along(x, w, jnp.minimum(stop, plan.upstream)))
        response = jnp.zeros((materials * count, bins.padded), energy.dtype)
        arrived = jnp.zeros((materials * count,), energy.dtype)
        scattered, escaped = arrived, jnp.zeros((count,), energy.dtype)
        at_stops, total = [jnp.zeros_like(energy) for _ in met], jnp.zeros_like(energy)

        if medium is not None:
            stretch, at_stops, total = march_rays(setting, sent)

            def along_rays(a):
                return jnp.broadcast_to(a, stretch.start.shape)

            way, before = vec(along_rays(a) for a in w), [along_rays(m) for m in met]
            k, power = stretch.extinction, along_rays(energy)
            low = bins.position(2.0 * (along_rays(excess) + stretch.start) / SPEED_OF_LIGHT)
            first, pieces = stretch_pieces(bins, low, stretch, kappa)
            passing = jnp.exp(-stretch.depth) * mean_decay(k * stretch.length) * stretch.length
            middle = stretch.start + 0.5 * stretch.length
            for m, part in _parts(medium, plan, stretch, way) if mirror is None else ():
                value = part.extinction * (part.backscatter * along_rays(visible))
                for history, share in both_ways.terms(table, int(successor[0, part.letter]), middle, before):
                    slot = jnp.broadcast_to(m * count + history, first.shape)
                    row = jnp.moveaxis(pieces, 0, -1) * (value * share)[..., None]
                    response = scatter_rows(response, slot, first, row)
                for history, share in out_way.terms(table, 0, middle, before):
                    weight = part.extinction * passing * share * power
                    arrived = _add(arrived, m * count + history, weight)
            # Smoothing is linear, so only the sum is smoothed. All that collides is scattered.
            response, scattered = smooth_row(response, bins.kernel)[:, 1:-1], arrived

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
                seen = s.law.view_factor(w, normal, back, beam.half_angle) * seen
            time = 2.0 * (excess + jnp.minimum(met[i], 1e9)) / SPEED_OF_LIGHT
            first, row = instant_row(bins, time, hit * seen * jnp.exp(-kappa * at_stops[i]))
            for history, share in both_ways.terms(table, int(successor[0, scatterer.reflected]), met[i], met):
                slot = jnp.broadcast_to(scatterer.material * count + history, first.shape)
                response = scatter_rows(response, slot, first, row * share[:, None])

        gone = jnp.where(stop < FAR, 0.0, energy * jnp.exp(-total))
        for history, share in out_way.terms(table, 0, stop, met):
            escaped = _add(escaped, history, gone * share)
        shape = (materials, count)
        return response, arrived.reshape(shape), scattered.reshape(shape), escaped

    n = energy.shape[0]
    fill = -n % CHUNK
    padded = [jnp.pad(a, (0, fill)).reshape(-1, CHUNK) for a in (*across, energy)]

    def chunk(x, y, e):
        return rays((x, y), e)

    if n <= CHUNK:
        response, *fate = rays(across, energy)
    elif medium is None:
        # Without a march all chunks fit into the memory at once, and no loop is compiled.
        each = jax.vmap(chunk)(*padded)
        response, *fate = jax.tree.map(lambda a: jnp.sum(a, axis=0), each)
    else:
        zero = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(rays, across, energy))

        def add(total, part):
            return jax.tree.map(jnp.add, total, chunk(*part)), None

        response, *fate = lax.scan(add, zero, padded)[0]
    weights, outside = bins.trimmed(response.reshape(materials, count, bins.padded))
    return FirstOrder(weights, outside, *fate)


def stretch_pieces(
    bins: Bins, low: Float[Array, "steps rays"], stretch: Stretches, kappa: float
) -> tuple[Int[Array, "steps rays"], Float[Array, "pieces steps rays"]]:
    """First bin of each stretch, and the integrals of exp(-kappa tau) ds over its pieces, bin by bin.

    `low` is the position of the start of each stretch on the axis of bins.
    """
    metres = 0.5 * SPEED_OF_LIGHT * bins.width
    high = low + stretch.length / metres
    number = jnp.round(lax.stop_gradient(low))
    # Rows of an even length are added faster; a piece beyond the end is zero.
    count = bins.row - 2 + bins.row % 2

    def piece(carry, j):
        clear, start = carry
        end = jnp.clip(number + (j + 0.5), low, high)
        length = (end - start) * metres
        passing, mean = _decay(kappa * stretch.extinction * length)
        return (clear * passing, end), clear * mean * length

    # A scan computes each piece once; unrolled, compilers recompute them for every element.
    start = (jnp.exp(-kappa * stretch.depth), low)
    _, pieces = lax.scan(piece, start, jnp.arange(count, dtype=low.dtype))
    return first_bin(bins, number, count), pieces


def _together(slot: Int[Array, "*s"] | int, weight: Float[Array, "*s"]):
    """Slots and weights to add; one sum where all rays have the same slot."""
    return (slot, jnp.sum(weight)) if isinstance(slot, int) else (slot, weight)


def _add(
    into: Float[Array, "slots"], slot: Int[Array, "*s"] | int, weight: Float[Array, "*s"]
) -> Float[Array, "slots"]:
    slot, weight = _together(slot, weight)
    return into.at[slot].add(weight)


class Part(eqx.Module):
    """One material of the medium on a ray: its extinction, view factor for backscatter, and letter."""

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
            factor = medium.leaf_phase.view_factor(w, back)
        elif medium.angles is not None:
            factor = medium.angles.square_at(w) / medium.angles.projection_at(w)
        yield plan.leaf.material, Part(k, factor, plan.leaf.reflected)
    if medium.bark is not None and plan.bark is not None:
        k = stretch.extinction if medium.leaf is None else medium.bark_at(stretch.cell)
        factor = FACET_BACKSCATTER
        if medium.bark_phase is not None:
            factor = medium.bark_phase.view_factor(w, back)
        yield plan.bark.material, Part(k, factor, plan.bark.reflected)
