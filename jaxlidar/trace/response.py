"""The response of a scene to a pulse without duration: geometry is traced once, for any optics.

    received[wavelength, bin] = sum over histories h of
        response[bin, h] * prod over letters s of optics_s[wavelength] ** exponent[h, s]

This is known in biomedical optics as white Monte Carlo (Alerstam et al. 2008).
"""

import dataclasses
from collections.abc import Callable
from typing import TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._checks import briefly, check_flag, check_key, check_kind
from jaxlidar.planning.setup import Setup
from jaxlidar.trace.first_order import FirstOrder, first_order
from jaxlidar.trace.footprint import WHOLE, Slice, lattice, product_rule, scattered
from jaxlidar.trace.higher_orders import HigherOrders, higher_orders
from jaxlidar.trace.mirror import mirror_rays
from jaxlidar.trace.random_numbers import to_unit, words
from jaxlidar.trace.setting import Setting, setting_of, straight_transmittance

Traced = TypeVar("Traced")


@final
@briefly
class Response(eqx.Module):
    """The geometric weight of all paths, by last material, scattering history and fine time bin.

    Multiplied by the optics of each history (see `jaxlidar.waveform_of`) it gives the waveform. The first
    axis has one trace for all wavelengths; or one for each, where leaves transmit straight on, so that
    extinction depends on the wavelength, and where optics are applied while light is traced, because
    histories would be too many: then there is one history, and its optics are 1.

    - `first`: (traces, materials, first histories, bins) order one, apparent reflectance per unit optics.
    - `higher`: (traces, materials, histories, bins) orders two and above, or None where they were not traced.
    - `first_outside`: (traces, materials, first histories), `higher_outside`: (traces, materials, histories)
      what arrives before the first bin or after the last.
    - `arrived`, `left`: (traces, materials, histories) weight that reached each material, and that went on.
    - `escaped`, `late`, `remaining`: (traces, histories) weight that left the scene, that outlasted the
      window, and that had scatterings left when the last order was reached.

    **Example:**

    >>> import equinox as eqx
    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> setup = jl.reduce(lidar, scene, jl.plan(lidar, scene))
    >>> response = eqx.filter_jit(jl.trace_scene)(setup, jax.random.key(0))
    >>> print(response.first.shape[:2], f"{float(response.first.sum()):.3f}")
    (1, 1) 1.000
    """

    first: Float[Array, "traces materials short bins"]
    higher: Float[Array, "traces materials histories bins"] | None
    first_outside: Float[Array, "traces materials short"]
    higher_outside: Float[Array, "traces materials histories"] | None
    arrived: Float[Array, "traces materials histories"]
    left: Float[Array, "traces materials histories"]
    escaped: Float[Array, "traces histories"]
    late: Float[Array, "traces histories"]
    remaining: Float[Array, "traces histories"]


def trace_scene(setup: Setup, key: PRNGKeyArray, *, reverse: bool = True) -> Response:
    """The response of one batch: the deterministic first order, and photons for the higher ones.

    A batch has `plan.n_photons` photons. The function is pure, to be compiled, batched and differentiated.
    Wavelengths enter only where leaves transmit straight on.

    **Arguments:**

    - `setup`: a `Setup` made by `jaxlidar.reduce`.
    - `key`: a JAX random key.
    - `reverse`: whether the function may be differentiated in reverse, as by `jax.grad`. Without, higher
      orders are faster with JAX before 0.12. Default True.

    **Returns:** a `Response`, for `jaxlidar.waveform_of`.

    **Raises:** TypeError for things of another kind.

    **Example:**

    >>> import equinox as eqx
    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> setup = jl.reduce(lidar, scene, jl.plan(lidar, scene))
    >>> response = eqx.filter_jit(jl.trace_scene)(setup, jax.random.key(0))
    >>> wave = eqx.filter_jit(jl.waveform_of)(response, setup)
    >>> print(f"{float(wave.reflectance.sum()):.4f}")
    0.4000
    """
    check_kind("setup", setup, Setup, "a Setup, as in reduce(lidar, scene, plan)")
    check_key(key)
    check_flag("reverse", reverse)
    return trace_setting(
        setting_of(setup, derivatives="all" if reverse else "forward"), straight_transmittance(setup), key
    )


def trace_setting(
    setting: Setting, transmittance: Float[Array, "wavelengths"] | None, key: PRNGKeyArray
) -> Response:
    """The response of one batch. `transmittance`: see `straight_transmittance`."""
    if follows(setting):
        return joined(trace_first(setting, transmittance, key), trace_higher(setting, transmittance, key))
    return trace_only_first(setting, transmittance, key)


def trace_scored(
    setting: Setting, optics: Float[Array, "letters wavelengths"], key: PRNGKeyArray
) -> tuple[Response, Float[Array, "columns wavelengths bins"]]:
    """The response of one batch, and what its `scores` make of it at these optics, in fine bins.

    For plans that keep histories, and leaves that do not transmit straight on.
    """
    first, weights = _first(setting, key)
    assert first.scored is not None
    fine = jnp.einsum("hw,mhbc->bcw", setting.short.monomials(optics), first.scored)
    if not follows(setting):
        return only_first(setting, first, weights), jnp.moveaxis(fine, 0, 2)
    higher = higher_orders(setting, _keys(setting, key)[1])
    assert higher.scored is not None
    fine = fine + higher.scored
    own = jax.tree.map(lambda a: a[None], eqx.tree_at(lambda h: h.scored, higher, None))
    return joined(First(weights[None], first.outside[None]), own), jnp.moveaxis(fine, 0, 2)


def trace_only_first(
    setting: Setting,
    transmittance: Float[Array, "wavelengths"] | None,
    key: PRNGKeyArray,
    part: Slice = WHOLE,
) -> Response:
    """The response of one batch of a setting that has one order; or of a part of its rays (see `lattice`)."""

    def trace(setting: Setting) -> Response:
        return only_first(setting, *_first(setting, key, part))

    return _for_each(trace, setting, transmittance)


def follows(setting: Setting) -> bool:
    """Whether light is followed beyond its first scattering."""
    return setting.plan.order_steps >= 2 or setting.plan.drawn_first


class First(eqx.Module):
    """Order one of a response that has more: `first` and `first_outside` of `Response`."""

    weights: Float[Array, "traces materials short bins"]
    outside: Float[Array, "traces materials short"]


# First and higher orders share nothing, so that they can be compiled side by side.
def trace_first(
    setting: Setting, transmittance: Float[Array, "wavelengths"] | None, key: PRNGKeyArray
) -> First:
    """Order one of a batch."""

    def trace(setting: Setting) -> First:
        first, weights = _first(setting, key)
        if setting.optics is None:
            return First(weights[None], first.outside[None])
        monomials = setting.short.monomials(setting.optics)
        coloured = (jnp.einsum("hw,mh...->wm...", monomials, a) for a in (weights, first.outside))
        return First(*(jnp.expand_dims(a, 2) for a in coloured))

    return _for_each(trace, setting, transmittance)


def trace_higher(
    setting: Setting, transmittance: Float[Array, "wavelengths"] | None, key: PRNGKeyArray
) -> HigherOrders:
    """Orders two and above of a batch, and the fate of all light."""

    def trace(setting: Setting) -> HigherOrders:
        found = higher_orders(setting, _keys(setting, key)[1])
        if setting.optics is None:
            return jax.tree.map(lambda a: a[None], found)
        # Wavelengths, in place of histories, become traces with one history each.
        return jax.tree.map(lambda a: _as_traces(a, min(a.ndim - 1, 1)), found)

    return _for_each(trace, setting, transmittance)


def _as_traces(a: Array, wavelengths: int) -> Array:
    """With the axis of wavelengths in front, and one history in its place."""
    return jnp.expand_dims(jnp.moveaxis(a, wavelengths, 0), wavelengths + 1)


def joined(first: First, higher: HigherOrders) -> Response:
    """The response of all orders."""
    fate = (higher.arrived, higher.left, higher.escaped, higher.late, higher.remaining)
    return Response(first.weights, higher.weights, first.outside, higher.outside, *fate)


def _for_each(
    trace: Callable[[Setting], Traced], setting: Setting, transmittance: Float[Array, "wavelengths"] | None
) -> Traced:
    """One trace for all wavelengths, or one for each transmittance, along the first axis."""
    if transmittance is None:
        return trace(setting)

    def one(given: tuple[Array, Array | None]) -> Traced:
        t, optics = given
        own = None if optics is None else optics[:, None]
        return trace(dataclasses.replace(setting.thinned(t), optics=own))

    each = jax.lax.map(one, (transmittance, None if setting.optics is None else setting.optics.T))
    return jax.tree.map(lambda a: a[:, 0], each)


def _keys(setting: Setting, key: PRNGKeyArray) -> tuple[PRNGKeyArray, PRNGKeyArray]:
    """Keys of the footprint and of photons.

    Photons leave out the words with which the footprint is shifted: one key serves both.
    """
    if not setting.plan.independent:
        return key, key
    shift, photons = jax.random.split(key)
    return shift, photons


def _first(
    setting: Setting, key: PRNGKeyArray, part: Slice = WHOLE
) -> tuple[FirstOrder, Float[Array, "materials short bins"]]:
    """Order one, and its weights together with what mirrors return; none where the order is drawn."""
    across, energy = footprint_of(setting, _keys(setting, key)[0], part)
    first = first_order(setting, across, energy)
    weights, scored = first.weights, first.scored
    if setting.plan.drawn_first:
        weights, scored = jax.tree.map(jnp.zeros_like, (weights, scored))
    for i, is_mirror in enumerate(setting.plan.mirrors):
        if is_mirror and setting.sizes.specular:
            rays = mirror_rays(setting.beam, setting.surfaces[i])
            mirrored = first_order(setting, *rays, mirror=i)
            weights, scored = jax.tree.map(jnp.add, (weights, scored), (mirrored.weights, mirrored.scored))
    return eqx.tree_at(lambda f: f.scored, first, scored, is_leaf=lambda a: a is None), weights


def footprint_of(
    setting: Setting, key: PRNGKeyArray, part: Slice = WHOLE
) -> tuple[tuple[Float[Array, "rays"], Float[Array, "rays"]], Float[Array, "rays"]]:
    """Places of the footprint's rays across the beam, and their shares of its energy."""
    beam, sizes = setting.beam, setting.sizes
    if sizes.smooth:
        return product_rule(beam)
    if setting.plan.independent:
        assert part is WHOLE, "independent rays have no parts"
        return scattered(beam, sizes.rays, key)
    shift = to_unit(words(key, 2)) if sizes.shifted else jnp.asarray([0.5, 0.0])
    return lattice(beam, sizes.rays, shift, part)


def only_first(
    setting: Setting, first: FirstOrder, weights: Float[Array, "materials short bins"]
) -> Response:
    """The response where nothing is followed beyond the first scattering: what is scattered remains."""
    plan, table = setting.plan, setting.short
    left = jnp.zeros_like(first.arrived)
    remaining = jnp.zeros_like(first.escaped)
    scatterers = [(s, False) for s in (plan.leaf, plan.bark) if s is not None]
    scatterers += [(s, surface.straight) for s, surface in zip(plan.surfaces, setting.surfaces)]
    for s, passes in scatterers:
        for letter, share in ((s.reflected, first.scattered), (s.transmitted, first.arrived)):
            if letter < 0:
                continue
            after = table.successor[:, letter]
            grown = jnp.where(after != jnp.arange(table.count), share[s.material], 0.0)
            left = left.at[s.material, after].add(grown)
            # What goes straight through a plate was followed to what lies behind it.
            if not (passes and letter == s.transmitted):
                remaining = remaining.at[after].add(grown)
    escaped, late = first.escaped, jnp.zeros_like(remaining)
    lights_itself = any(surface.shape.lights_itself for surface in setting.surfaces)
    if len(scatterers) == 1 and not (plan.leaf or plan.bark or lights_itself):
        # Nothing is in the way of what one plane scatters.
        escaped, remaining = escaped + remaining, late
    fate = (first.arrived, left, escaped, late, remaining)
    return Response(weights[None], None, first.outside[None], None, *(a[None] for a in fate))
