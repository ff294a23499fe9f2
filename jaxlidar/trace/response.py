"""The response of a scene to a pulse without duration: geometry is traced once, for any optics.

    received[wavelength, bin] = sum over histories h of
        response[bin, h] * prod over channels s of optics_s[wavelength] ** exponent[h, s]

This is known in biomedical optics as white Monte Carlo (Alerstam et al. 2008). Order one is deterministic
(`trace.first.first_order`), orders two and above are a Monte Carlo estimate
(`trace.photons.higher_orders`).

Arrays have an axis `traces`, one run of the tracer for each: usually a single one, of all wavelengths; one
for each wavelength where leaves transmit straight on, because extinction then depends on it; and one for each
wavelength, with one history, where optics are applied while light is traced.
"""

import dataclasses
from collections.abc import Callable
from typing import TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._fields.checks import check_flag, check_key, check_kind
from jaxlidar._jax.mesh_axes import vary_together, vary_with, with_automatic_axes
from jaxlidar._jax.products import einsum, tensordot
from jaxlidar.planning.setup import Setup
from jaxlidar.trace.derivatives.first_order_replay import pull_back_first_order
from jaxlidar.trace.derivatives.higher_order_replay import pull_back_higher_orders
from jaxlidar.trace.derivatives.replay import ExtinctionTables, with_replay
from jaxlidar.trace.device_scene import DeviceScene, build_device_scene
from jaxlidar.trace.first.first_order import FirstOrder, first_order
from jaxlidar.trace.first.footprint import ALL_RAYS, RaySlice, fibonacci_disc, product_rule
from jaxlidar.trace.first.mirror_return import mirror_rays
from jaxlidar.trace.march.thin_voxels import add_tangents_of_thin_voxels
from jaxlidar.trace.photons.higher_orders import (
    HigherOrderTally,
    PhotonBatch,
    trace_higher_orders,
    trace_photons,
)
from jaxlidar.trace.photons.histories import Histories
from jaxlidar.trace.photons.random_numbers import random_words, to_unit

Traced = TypeVar("Traced")
Weights = TypeVar("Weights")
# Order one of a response that has more: its `first` and `first_outside`.
FirstOrderWeights = tuple[
    Float[Array, "traces materials first_histories bins"], Float[Array, "traces materials first_histories"]
]


@final
class Response(eqx.Module):
    """The geometric weight of all paths, by last material, scattering history and fine time bin.

    Multiplied by the optics of each history (see `jaxlidar.waveform_of`) it gives the waveform. The first
    axis has one run of the tracer for all wavelengths; or one for each, where leaves transmit straight on, so
    that extinction depends on the wavelength, and where optics are applied while light is traced, because
    histories would be too many: then there is one history, and its optics are 1. Results of many shots, by
    `jax.vmap`, have an axis of shots before it.

    - `first`: (traces, materials, first histories, bins) order one, apparent reflectance per unit optics.
    - `higher`: (traces, materials, histories, bins) orders two and above, or None where they were not traced.
    - `first_outside`: (traces, materials, first histories), `higher_outside`: (traces, materials, histories)
      returns before the first bin or after the last.
    - `arrived`, `departed`: (traces, materials, histories) weight that reached each material, and that went
      on from it.
    - `escaped`, `flown_outside`, `unfollowed`: (traces, histories) weight that left the scene, that
      outlasted the window, and that was still in flight after the last order.

    **Example:**

    >>> import equinox as eqx
    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene))
    >>> response = eqx.filter_jit(jl.trace_scene)(setup, jax.random.key(0))
    >>> print(response.first.shape[:2], f"{float(response.first.sum()):.3f}")
    (1, 1) 1.000
    """

    first: Float[Array, "*shots traces materials first_histories bins"]
    higher: Float[Array, "*shots traces materials histories bins"] | None
    first_outside: Float[Array, "*shots traces materials first_histories"]
    higher_outside: Float[Array, "*shots traces materials histories"] | None
    arrived: Float[Array, "*shots traces materials histories"]
    departed: Float[Array, "*shots traces materials histories"]
    escaped: Float[Array, "*shots traces histories"]
    flown_outside: Float[Array, "*shots traces histories"]
    unfollowed: Float[Array, "*shots traces histories"]


@with_automatic_axes
def trace_scene(setup: Setup, key: PRNGKeyArray, *, reverse: bool = True) -> Response:
    """Trace the response of one batch: the deterministic first order, and photons for the higher ones.

    The function is pure, to be compiled, batched and differentiated. Wavelengths enter only where leaves
    transmit straight on, and where optics are applied while light is traced, because histories would be too
    many.

    **Arguments:**

    - `setup`: a `Setup` made by `jaxlidar.make_setup`.
    - `key`: a JAX random key.
    - `reverse`: True if the function may be differentiated in reverse, as by `jax.grad`. Without, higher
      orders are faster with JAX before 0.12, and their derivatives leave out what leaves in voxels of zero
      extinction would scatter. Default True.

    **Returns:** a `Response`, for `jaxlidar.waveform_of`.

    **Raises:** TypeError for arguments of another kind.

    **Example:**

    >>> import equinox as eqx
    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene))
    >>> response = eqx.filter_jit(jl.trace_scene)(setup, jax.random.key(0))
    >>> wave = eqx.filter_jit(jl.waveform_of)(response, setup)
    >>> print(f"{float(wave.reflectance.sum()):.4f}")
    0.4000
    """
    check_kind("setup", setup, Setup, "a Setup, as in make_setup(lidar, scene, plan)")
    check_key(key)
    check_flag("reverse", reverse)
    scene = build_device_scene(setup, derivatives="all" if reverse else "forward")
    return trace_device_scene(scene, key)


def trace_device_scene(scene: DeviceScene, key: PRNGKeyArray) -> Response:
    """Trace the response of one batch."""
    scene, key = vary_together((scene, key))
    if scene.config.follows_higher_orders:
        return join_orders(trace_first(scene, key), trace_higher(scene, key))
    return trace_first_only(scene, key)


def trace_with_scores(
    scene: DeviceScene, optics: Float[Array, "channels wavelengths"], key: PRNGKeyArray
) -> tuple[Response, Float[Array, "parameters wavelengths bins"]]:
    """Trace the response of one batch, and its derivatives with respect to the parameters of `scene.slopes`.

    Derivatives are of the sum over histories at the values `optics`, in fine bins; for plans that keep
    histories, and leaves that do not transmit straight on.
    """
    first, weights = _first(scene, key)
    assert first.weight_slopes is not None
    # Derivatives of all materials together: Jacobians are of the recorded sum.
    derivatives = einsum("hw,mhbc->bcw", scene.first_histories.monomials(optics), first.weight_slopes)
    if not scene.config.follows_higher_orders:
        return first_order_response(scene, first, weights), jnp.moveaxis(derivatives, 0, 2)
    higher = trace_higher_orders(scene, key)
    assert higher.weight_slopes is not None
    derivatives = derivatives + higher.weight_slopes
    parts = (weights, first.outside), dataclasses.replace(higher, weight_slopes=None)
    return join_orders(*jax.tree.map(lambda a: a[None], parts)), jnp.moveaxis(derivatives, 0, 2)


def trace_first_only(scene: DeviceScene, key: PRNGKeyArray, ray_slice: RaySlice = ALL_RAYS) -> Response:
    """Trace the response of one batch of a scene that has one order; or of a slice of its rays."""

    def trace(scene: DeviceScene) -> Response:
        response = first_order_response(scene, *_first(scene, key, ray_slice))
        if scene.optics is None:
            return response
        without_traces = jax.tree.map(lambda a: a[0], response)
        return histories_to_traces(without_traces, scene.first_histories, scene.optics)

    return _for_each_trace(trace, scene)


def histories_to_traces(
    weights: Weights, histories: Histories, optics: Float[Array, "channels wavelengths"]
) -> Weights:
    """Sum over histories with their optics: wavelengths become traces, with one history each.

    `weights`: tree of arrays. Histories are the first axis of those with a single axis, else the second,
    after materials.
    """
    monomials = histories.monomials(optics)

    def apply(a: Array) -> Array:
        axis = min(a.ndim - 1, 1)
        return jnp.expand_dims(tensordot(monomials, a, axes=(0, axis)), 1 + axis)

    return jax.tree.map(apply, weights)


# First and higher orders share nothing, so that they can be compiled side by side.
def trace_first(scene: DeviceScene, key: PRNGKeyArray) -> FirstOrderWeights:
    """Trace order one of a batch; traces lie along the first axis."""

    def trace(scene: DeviceScene) -> FirstOrderWeights:
        first, weights = _first(scene, key)
        if scene.optics is None:
            return weights[None], first.outside[None]
        return histories_to_traces((weights, first.outside), scene.first_histories, scene.optics)

    return _for_each_trace(trace, scene)


def trace_higher(scene: DeviceScene, key: PRNGKeyArray) -> HigherOrderTally:
    """Trace orders two and above of a batch, and the energy budget of all light."""

    def trace(scene: DeviceScene) -> HigherOrderTally:
        # The same key as for the footprint: photons leave out the random words with which that is shifted.
        words = random_words(key, PhotonBatch.n_words(scene))
        tally = with_replay(
            trace_photons, pull_back_higher_orders, scene, words, add_tangents=add_tangents_of_thin_voxels
        )
        if scene.optics is None:
            return jax.tree.map(lambda a: a[None], tally)
        return wavelengths_to_traces(tally)

    return _for_each_trace(trace, scene)


def wavelengths_to_traces(tally: HigherOrderTally) -> HigherOrderTally:
    """Make traces of the wavelengths that a tally has in place of histories, with one history each."""

    def move(a: Array) -> Array:
        axis = min(a.ndim - 1, 1)
        return jnp.expand_dims(jnp.moveaxis(a, axis, 0), axis + 1)

    return jax.tree.map(move, tally)


def join_orders(first: FirstOrderWeights, higher: HigherOrderTally) -> Response:
    """Make the response of all orders."""
    weights, outside = first
    return Response(
        first=weights,
        higher=higher.weights,
        first_outside=outside,
        higher_outside=higher.outside,
        arrived=higher.arrived,
        departed=higher.departed,
        escaped=higher.escaped,
        flown_outside=higher.flown_outside,
        unfollowed=higher.unfollowed,
    )


def _for_each_trace(trace: Callable[[DeviceScene], Traced], scene: DeviceScene) -> Traced:
    """Trace once for all wavelengths; or, where leaves transmit straight on, once for each transmittance.

    Traces lie along the first axis.
    """
    if scene.straight_transmittance is None:
        return trace(scene)

    def trace_wavelength(of_wavelength: tuple[Array, Array | None]) -> Traced:
        transmittance, optics = of_wavelength
        optics = None if optics is None else optics[:, None]
        return trace(dataclasses.replace(scene.with_leaf_transmittance(transmittance), optics=optics))

    optics = None if scene.optics is None else scene.optics.T
    traces = jax.lax.map(trace_wavelength, (scene.straight_transmittance, optics))
    return jax.tree.map(lambda a: a[:, 0], traces)


def _first(
    scene: DeviceScene, key: PRNGKeyArray, ray_slice: RaySlice = ALL_RAYS
) -> tuple[FirstOrder, Float[Array, "materials first_histories bins"]]:
    """Trace order one; also return its weights together with the returns of mirrors."""
    shift = footprint_shift(scene, key)
    return with_replay(_first_of_shift, _pull_back_first, scene, (shift, ray_slice))


def _first_of_shift(
    scene: DeviceScene, footprint: tuple[Float[Array, "2"], RaySlice]
) -> tuple[FirstOrder, Float[Array, "materials first_histories bins"]]:
    first = first_order(scene, *vary_with(_footprint_rays(scene, *footprint), scene))
    weights, slopes = first.weights, first.weight_slopes
    for i in _returning_mirrors(scene):
        rays = vary_with(mirror_rays(scene.beam, scene.surfaces[i]), scene)
        mirrored = first_order(scene, *rays, mirror=i)
        weights, slopes = jax.tree.map(jnp.add, (weights, slopes), (mirrored.weights, mirrored.weight_slopes))
    return dataclasses.replace(first, weight_slopes=slopes), weights


def _pull_back_first(
    scene: DeviceScene,
    footprint: tuple[Float[Array, "2"], RaySlice],
    cotangents: tuple[FirstOrder, Float[Array, "materials first_histories bins"]],
) -> ExtinctionTables:
    """Pull cotangents of the results of `_first_of_shift` back to the extinction of voxels."""
    of_first, of_weights = cotangents
    of_first = dataclasses.replace(of_first, weights=of_first.weights + of_weights)
    tables = pull_back_first_order(scene, *_footprint_rays(scene, *footprint), of_first)
    # Nothing but what returns counts of the rays to a mirror.
    of_mirrored = dataclasses.replace(jax.tree.map(jnp.zeros_like, of_first), weights=of_weights)
    for i in _returning_mirrors(scene):
        rays = mirror_rays(scene.beam, scene.surfaces[i])
        tables = jax.tree.map(jnp.add, tables, pull_back_first_order(scene, *rays, of_mirrored, mirror=i))
    return tables


def _returning_mirrors(scene: DeviceScene) -> list[int]:
    """Return the numbers of the surfaces that are mirrors, if these return light to the sensor."""
    if not scene.config.returns_specular:
        return []
    return [i for i, is_mirror in enumerate(scene.config.mirrors) if is_mirror]


def footprint_rays(
    scene: DeviceScene, key: PRNGKeyArray, ray_slice: RaySlice = ALL_RAYS
) -> tuple[tuple[Float[Array, "rays"], Float[Array, "rays"]], Float[Array, "rays"]]:
    """Return the positions of the footprint's rays across the beam, and their fractions of its energy."""
    return _footprint_rays(scene, footprint_shift(scene, key), ray_slice)


def footprint_shift(scene: DeviceScene, key: PRNGKeyArray) -> Float[Array, "2"]:
    """Return the random shift of a footprint's rays, as `fibonacci_disc` takes it."""
    # Shifted at random, rays are an unbiased sample of the footprint; not shifted, they are the same for
    # every key.
    is_random = scene.config.random_footprint and not scene.config.uses_quadrature
    return to_unit(random_words(key, 2)) if is_random else jnp.asarray([0.5, 0.0])


def _footprint_rays(
    scene: DeviceScene, shift: Float[Array, "2"], ray_slice: RaySlice
) -> tuple[tuple[Float[Array, "rays"], Float[Array, "rays"]], Float[Array, "rays"]]:
    if scene.config.uses_quadrature:
        return product_rule(scene.beam)
    return fibonacci_disc(scene.beam, scene.config.n_rays, shift, ray_slice)


def first_order_response(
    scene: DeviceScene, first: FirstOrder, weights: Float[Array, "materials first_histories bins"]
) -> Response:
    """Make the response where nothing is followed beyond the first scattering."""
    departed, escaped, unfollowed = fates_after_first_scattering(
        scene, first.arrived, first.scattered, first.escaped
    )
    # No light flies on outside of the record: none is followed beyond its first scattering.
    budget = (first.arrived, departed, escaped, jnp.zeros_like(unfollowed), unfollowed)
    arrived, departed, escaped, flown_outside, unfollowed = (a[None] for a in budget)
    return Response(
        first=weights[None],
        higher=None,
        first_outside=first.outside[None],
        higher_outside=None,
        arrived=arrived,
        departed=departed,
        escaped=escaped,
        flown_outside=flown_outside,
        unfollowed=unfollowed,
    )


def fates_after_first_scattering(
    scene: DeviceScene,
    arrived: Float[Array, "materials histories"],
    scattered: Float[Array, "materials histories"],
    escaped: Float[Array, "histories"],
) -> tuple[Float[Array, "materials histories"], Float[Array, "histories"], Float[Array, "histories"]]:
    """Return what departs from each material, what escapes, and what is not followed.

    1. For each material and channel: the light that it scatters departs with the next history.
    2. That light is not followed, unless it went straight through a plate.
    3. What one plane alone scatters escapes, as nothing is in its path.
    """
    config, histories = scene.config, scene.first_histories
    departed, unfollowed = jnp.zeros_like(arrived), jnp.zeros_like(escaped)
    scatterers = [(s, False) for s in (config.leaf, config.bark) if s is not None]
    scatterers += [(s, surface.straight) for s, surface in zip(config.surfaces, scene.surfaces)]
    for scatterer, is_straight in scatterers:
        for channel, energy in ((scatterer.reflection, scattered), (scatterer.transmission, arrived)):
            if channel < 0:
                continue
            after = histories.next_history[:, channel]
            # Histories of the largest degree, which have no successor, are not scattered again.
            weight = jnp.where(
                after != jnp.arange(histories.count, dtype=after.dtype), energy[scatterer.material], 0.0
            )
            departed = departed.at[scatterer.material, after].add(weight)
            # Light that goes straight through a plate was followed to what lies behind it.
            if not (is_straight and channel == scatterer.transmission):
                unfollowed = unfollowed.at[after].add(weight)
    lights_itself = any(surface.lights_itself for surface in scene.surfaces)
    if len(scatterers) == 1 and not (config.leaf or config.bark or lights_itself):
        return departed, escaped + unfollowed, jnp.zeros_like(unfollowed)
    return departed, escaped, unfollowed
