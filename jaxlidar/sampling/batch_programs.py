"""Batches of photons: the programs that trace them, and what is taken of each batch for standard errors.

`make_batch_tracer` compiles these programs while other work is done: on a first call compilation takes most
of the time. First and higher orders share nothing, and are compiled side by side; programs of the sums are
compiled beside them, from shapes alone.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

from jaxlidar._fields.checks import as_array, has_tracers
from jaxlidar._jax.programs import Program
from jaxlidar.planning.setup import Setup
from jaxlidar.spectral.apply_optics import (
    WaveformModel,
    make_padded_waveform_model,
    make_waveform_model,
    pad_wavelengths,
    samples_and_budget,
)
from jaxlidar.spectral.waveform import Waveform, remove_padding, waveform_of_model
from jaxlidar.trace.device_scene import (
    DeviceScene,
    build_device_scene,
    compiled_geometry,
    complete_device_scene,
    geometry_arguments,
)
from jaxlidar.trace.response import (
    Response,
    join_orders,
    trace_device_scene,
    trace_first,
    trace_higher,
)


class BatchEstimate(NamedTuple):
    """The quantities of one batch from whose spread standard errors are computed.

    - `samples`: apparent reflectance, in rows of wavelengths or of pivots (see
      `jaxlidar.spectral.apply_optics.samples_and_budget`).
    - `budget_names`, `budget`: terms of the energy budget, fractions of the pulse's energy.
    - `unfollowed`: apparent reflectance that orders beyond the last may add.
    """

    samples: Float[Array, "rows samples"]
    budget_names: tuple[str, ...]
    budget: Float[Array, "terms wavelengths"]
    unfollowed: Float[Array, "wavelengths"]


def _estimate(response: Response, model: WaveformModel) -> BatchEstimate:
    samples, terms = samples_and_budget(response, model)
    # In the order in which JAX keeps the dict itself.
    names = tuple(sorted(terms.energy_budget))
    return BatchEstimate(samples, names, jnp.stack([terms.energy_budget[n] for n in names]), terms.unfollowed)


def _add(a: Any, b: Any) -> Any:
    return jax.tree.map(jnp.add, a, b)


def _mean_waveform(total: Response, batches: Array, model: WaveformModel) -> Waveform:
    """Make the waveform of the mean of the responses of `batches` batches."""
    return waveform_of_model(total, model.for_sum_of(batches))


def _with_batch_number(trace: Callable) -> Callable:
    """Return `trace`, with the key of batch `number`: the key is folded in within the program."""

    def trace_batch(scene: DeviceScene, key: PRNGKeyArray, number: UInt32[Array, ""]) -> Any:
        return trace(scene, jax.random.fold_in(key, number))

    trace_batch.__name__ = f"batch_of_{trace.__name__}"
    return trace_batch


_compiled_trace = Program(trace_device_scene)
_compiled_batch = Program(_with_batch_number(trace_device_scene), one_core=True)
_compiled_first = Program(_with_batch_number(trace_first), one_core=True)
_compiled_higher = Program(_with_batch_number(trace_higher), one_core=True)
_compiled_estimate = Program(_estimate, one_core=True)
_compiled_sum = Program(_add)
_compiled_waveform = Program(_mean_waveform)


class BatchTracer(NamedTuple):
    """Traces batches of one setup, and makes waveforms of their sums. Made by `make_batch_tracer`.

    - `setup`: what is simulated. `scene`: the same on the device.
    - `model`: makes waveforms of mean responses. `error_model`: estimates from single batches, at pivot
      wavelengths where wavelengths are many.
    """

    setup: Setup
    scene: DeviceScene
    model: WaveformModel
    error_model: WaveformModel

    def batch_function(self, key: PRNGKeyArray) -> Callable[[int], tuple[Response, BatchEstimate]]:
        """Return the function that traces batch `n`; shared arguments are flattened once."""
        common = {"scene": self.scene, "key": key}
        if self.scene.config.follows_higher_orders:
            trace_first_order, trace_higher_orders = (
                _compiled_first.bind(**common),
                _compiled_higher.bind(**common),
            )
        else:
            trace_first_order, trace_higher_orders = _compiled_batch.bind(**common), None
        make_estimate = _compiled_estimate.bind(model=self.error_model)

        def trace_batch(n: int) -> tuple[Response, BatchEstimate]:
            number = np.array(n, np.uint32)
            response = trace_first_order(number=number)
            if trace_higher_orders is not None:
                response = join_orders(response, trace_higher_orders(number=number))
            return response, make_estimate(response=response)

        return trace_batch

    def trace(self, key: PRNGKeyArray) -> Response:
        """Trace a single response on all cores."""
        return _compiled_trace(self.scene, key)

    def add(self, total: Response | None, response: Response) -> Response:
        """Return the sum of responses; `total` None is an empty sum."""
        return response if total is None else _compiled_sum(total, response)

    def waveform(self, total: Response, batches: int) -> Waveform:
        """Make the waveform of the sum of the responses of some batches, without padding."""
        wave = _compiled_waveform(total, as_array(batches), self.model)
        return remove_padding(wave, self.setup.lidar.wavelength.size, self.setup.plan.n_samples)


def make_batch_tracer(setup: Setup, key: PRNGKeyArray) -> BatchTracer:
    """Make the tracer of a setup, and begin to compile its programs.

    Sizes are rounded up to buckets, so that most changes of a scene compile nothing; not where a trace takes
    long for each wavelength, or within a JAX transformation.

    1. Begin to compile the programs that trace, from the shapes of the device scene: they take longest.
    2. Make the numbers of the waveform model meanwhile.
    3. Begin to compile the programs of estimates, sums and waveforms.
    """
    is_transformed = has_tracers((setup, key))
    canopy = setup.scene.canopy
    exact_sizes = is_transformed or (canopy is not None and canopy.is_straight)
    make_model = make_waveform_model if exact_sizes else make_padded_waveform_model
    if is_transformed or not setup.plan.is_random:
        scene = build_device_scene(setup, derivatives="all" if is_transformed else "none")
        model = make_model(setup)
        return BatchTracer(setup, scene, model, model)
    scene_or_shapes, finish_scene = _begin_device_scene(setup, exact_sizes)
    response_shapes = _begin_traces(scene_or_shapes, key)
    model = make_model(setup)
    error_model = model if exact_sizes else model.at_pivots()
    if response_shapes is not None:
        _compiled_waveform.compile_ahead(response_shapes, as_array(1.0), model)
        _compiled_estimate.compile_ahead(response=response_shapes, model=error_model)
        _compiled_sum.compile_ahead(response_shapes, response_shapes)
    return BatchTracer(setup, finish_scene(), model, error_model)


def _begin_device_scene(setup: Setup, exact_sizes: bool) -> tuple[DeviceScene, Callable[[], DeviceScene]]:
    """Begin to build a device scene without derivatives; unless `exact_sizes`, with room for wavelengths.

    **Returns:** the scene, with shapes in place of arrays while the program that makes these is being
    compiled, and a function that waits for its numbers.
    """
    arguments = geometry_arguments(setup, "none")

    def complete(geometry: DeviceScene) -> DeviceScene:
        scene = complete_device_scene(geometry, setup, "none")
        if exact_sizes or scene.optics is None:
            return scene
        return eqx.tree_at(lambda s: s.optics, scene, pad_wavelengths(scene.optics))

    def finish() -> DeviceScene:
        return complete(compiled_geometry(*arguments))

    if compiled_geometry.is_compiled(*arguments):
        scene = finish()
        return scene, lambda: scene
    return complete(compiled_geometry.compile_ahead(*arguments)), finish


def _begin_traces(scene: DeviceScene, key: PRNGKeyArray) -> Response | None:
    """Begin to compile the programs that trace batches, the one that takes longest first.

    **Returns:** the shapes of a response; None where the longest program is compiled already. Others that may
    be new then compile fast: looking for them would cost every call.
    """
    arguments = {"scene": scene, "key": key, "number": np.array(0, np.uint32)}
    has_higher_orders = scene.config.follows_higher_orders
    longest = _compiled_higher if has_higher_orders else _compiled_batch
    if longest.is_compiled(**arguments):
        return None
    if has_higher_orders:
        higher = _compiled_higher.compile_ahead(**arguments)
        return jax.eval_shape(join_orders, _compiled_first.compile_ahead(**arguments), higher)
    return _compiled_batch.compile_ahead(**arguments)
