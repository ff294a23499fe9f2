r"""Responses of the scenes of a design, and their derivatives, as functions of the divergence.

The response R and its derivatives dR / dx depend on the divergence g of the beam through the paths of light.
Both are traced at n Chebyshev points of ln g, and interpolated between these by the polynomial

    R(g) = sum_j R(g_j) l_j(u),   u in [-1, 1] linear in ln g,   l(u) = (T_0(u), ..., T_(n-1)(u)) M^-1,

with the Chebyshev polynomials T and M their values at the points. For a smooth function the error falls
exponentially with n. All starts and steps of an optimiser use the same traces, and the gradient of the
polynomial needs no second derivatives of traced paths, which are not unbiased where paths meet edges.

**Source:** Trefethen (2013), Approximation Theory and Approximation Practice, chapters 2 and 8.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from inversion.fit.model import SimulationInputs, Values
from inversion.fit.planning import N_BATCHES
from inversion.fit.prior_residuals import fixed_priors
from inversion.fit.unknowns import BoundUnknown, flat_bounds, flat_start
from jaxlidar import Lidar, Plan, Scene, total_reflectance, trace_scene
from jaxlidar.extend import Program, tensordot
from jaxlidar.spectral.apply_optics import make_free_sampling_model, total_samples
from jaxlidar.trace.response import Response


class DivergenceNodes(eqx.Module):
    """Divergences at which light is traced: Chebyshev points of the logarithm.

    - `low`, `high`: the first and the last, mrad, above 0. - `count`: of them, two or more.
    """

    low: float = eqx.field(static=True)
    high: float = eqx.field(static=True)
    count: int = eqx.field(static=True)

    @property
    def _points(self) -> Float[np.ndarray, " nodes"]:
        return -np.cos(np.pi * np.arange(self.count) / (self.count - 1))

    @property
    def divergences(self) -> Float[np.ndarray, " nodes"]:
        """Divergences in mrad, increasing."""
        return self.low * (self.high / self.low) ** (0.5 * (self._points + 1.0))

    @property
    def refined(self) -> "DivergenceNodes":
        """The nodes with one more in each gap; the first, third and further ones are those of before."""
        return DivergenceNodes(self.low, self.high, 2 * self.count - 1)

    def weights(self, divergence: Float[Array, ""]) -> Float[Array, " nodes"]:
        """Return the weights of the nodes in the polynomial at a divergence."""
        u = 2.0 * jnp.log(divergence / self.low) / np.log(self.high / self.low) - 1.0
        # By recurrence: cos(n arccos u) has no derivative at the ends.
        polynomials = [jnp.ones_like(u), u]
        for _ in range(self.count - 2):
            polynomials.append(2.0 * u * polynomials[-1] - polynomials[-2])
        at_nodes = np.polynomial.chebyshev.chebvander(self._points, self.count - 1)
        return jnp.stack(polynomials) @ jnp.asarray(np.linalg.inv(at_nodes), u.dtype)


class TracedScene(eqx.Module):
    """One scene of a design: its response, the derivatives of that, and what the bound needs besides.

    - `inputs`, `values`, `key`: of the simulation at the unknowns' starting values.
    - `nodes`: divergences of the traces; None for one trace, of the divergence of the lidar.
    - `responses`, `slopes`: the mean response of each node, and its derivatives; the latter with another axis
      of unknowns after that of nodes, zeros for those that do not change it.
    - `n_samples`: number of samples where their interval is that of the lidar; None: they are the plan's.
    - `width`: of the bounds of the flattened unknowns. `prior_rows`: whitened Jacobian of the priors, in
      widths.
    """

    inputs: SimulationInputs
    values: Values
    key: PRNGKeyArray
    n_samples: int | None = eqx.field(static=True)
    nodes: DivergenceNodes | None
    responses: Response
    slopes: Response
    width: Float[Array, " n"]
    prior_rows: Float[Array, "rows n"]

    def at(self, divergence: Float[Array, ""]) -> tuple[Response, Response]:
        """Return response and slopes at a divergence."""
        if self.nodes is None:
            return jax.tree.map(lambda a: a[0], (self.responses, self.slopes))
        weights = self.nodes.weights(divergence)
        return jax.tree.map(lambda a: tensordot(weights, a, 1), (self.responses, self.slopes))

    def record(self, lidar: Lidar, response: Response, values: Values) -> Float[Array, "wavelengths samples"]:
        """Return the apparent reflectance per sample of a response, as a lidar records it."""
        setup = dataclasses.replace(self.inputs, lidar=lidar).setup(values)
        if self.n_samples is None:
            return total_reflectance(response, setup)
        return total_samples(response, make_free_sampling_model(setup, self.n_samples))


def trace_for_design(
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    unknowns: list[BoundUnknown],
    key: PRNGKeyArray,
    *,
    n_samples: int | None,
    nodes: DivergenceNodes | None,
) -> TracedScene:
    """Trace one scene at each node, with derivatives of its response by the unknowns that change it.

    `n_samples`, `nodes`: as of `TracedScene`.
    """
    # Scores do not serve here: they give derivatives of the waveform of one lidar, not of the response.
    setters = tuple(
        u.setter._replace(dependence="geometric") if u.setter.changes_response else u.setter for u in unknowns
    )
    inputs = SimulationInputs(lidar, scene, plan, setters, tangents_per_pass=1).with_room()
    values = tuple(u.start for u in unknowns)
    divergences = [lidar.divergence] if nodes is None else nodes.divergences
    priors, start = fixed_priors(unknowns), flat_start(unknowns)
    low, high = flat_bounds(unknowns)
    width = high - low
    responses, slopes = _trace_divergences(inputs, values, divergences, key)
    return TracedScene(
        inputs,
        values,
        key,
        n_samples,
        nodes,
        responses,
        slopes,
        jnp.asarray(width),
        jnp.asarray(priors(start)[1] * width),
    )


def refine_nodes(traced: TracedScene) -> TracedScene:
    """Return the scene traced at one more node in each gap, with the same random numbers."""
    assert traced.nodes is not None
    nodes = traced.nodes.refined
    new = _trace_divergences(traced.inputs, traced.values, nodes.divergences[1::2], traced.key)

    def merge(before: Array, between: Array) -> Array:
        merged = jnp.zeros((nodes.count, *before.shape[1:]), before.dtype)
        return merged.at[::2].set(before).at[1::2].set(between)

    responses, slopes = jax.tree.map(merge, (traced.responses, traced.slopes), new)
    return dataclasses.replace(traced, nodes=nodes, responses=responses, slopes=slopes)


def _trace_divergences(
    inputs: SimulationInputs, values: Values, divergences: Any, key: PRNGKeyArray
) -> tuple[Response, Response]:
    """Return responses and slopes, stacked over divergences."""
    keys = jax.random.split(key, N_BATCHES if inputs.plan.is_random else 1)
    traces = []
    for divergence in divergences:
        lidar = eqx.tree_at(lambda v: v.divergence, inputs.lidar, jnp.asarray(divergence, float))
        traces.append(_response_and_slopes(dataclasses.replace(inputs, lidar=lidar), values, keys))
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *traces)


@Program
def _response_and_slopes(inputs: SimulationInputs, values: Values, keys: Array) -> tuple[Response, Response]:
    """Return the mean response of all batches, and its derivatives by all flattened unknowns."""
    flat, restore = jax.flatten_util.ravel_pytree(values)
    changes = np.concatenate(
        [np.full(v.size, s.changes_response) for v, s in zip(values, inputs.setters)]
    ).astype(float)

    def response_of(flat: Array) -> Response:
        setup = inputs.setup(restore(flat))
        responses = jax.lax.map(lambda batch_key: trace_scene(setup, batch_key, reverse=False), keys)
        return jax.tree.map(lambda a: jnp.mean(a, axis=0), responses)

    def slope(direction: Array) -> Response:
        return jax.jvp(response_of, (flat,), (direction,))[1]

    # One column after the other: the tangents of a response, with all histories, are large.
    directions = jnp.diag(jnp.asarray(changes, flat.dtype))
    return response_of(flat), jax.lax.map(slope, directions)
