"""Batches of photons: the programs that trace them, and what each tells of errors."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

from jaxlidar._programs import Program
from jaxlidar._threads import ONE_CORE
from jaxlidar.planning.setup import Setup
from jaxlidar.trace.colouring import Recording, total_and_balance
from jaxlidar.trace.response import Response, follows, joined, trace_first, trace_higher, trace_setting
from jaxlidar.trace.setting import Setting


class Ready(NamedTuple):
    """A setup as the compiled programs take it: `recording` of means, `brief` of batches for errors."""

    setup: Setup
    setting: Setting
    transmittance: Float[Array, "wavelengths"] | None
    recording: Recording
    brief: Recording


class Known(NamedTuple):
    """What errors are known of, from one batch.

    - `total`: its waveform (see `jaxlidar.trace.colouring.total_and_balance`).
    - `names`, `ledger`: the rows of its ledger, shares of the pulse's energy.
    - `neglected`: the share that orders beyond the last may add.
    """

    total: Float[Array, "kept samples"]
    names: tuple[str, ...]
    ledger: Float[Array, "rows wavelengths"]
    neglected: Float[Array, "wavelengths"]


def _known_of(response: Response, recording: Recording) -> Known:
    total, balance = total_and_balance(response, recording)
    # In the order in which JAX keeps the ledger itself.
    names = tuple(sorted(balance.ledger))
    return Known(total, names, jnp.stack([balance.ledger[name] for name in names]), balance.neglected)


def _sum(a: Any, b: Any) -> Any:
    return jax.tree.map(jnp.add, a, b)


def _numbered(trace: Callable) -> Callable:
    """`trace`, with the key of batch `number`."""

    def batch(
        setting: Setting, transmittance: Array | None, key: PRNGKeyArray, number: UInt32[Array, ""]
    ) -> Any:
        return trace(setting, transmittance, jax.random.fold_in(key, number))

    batch.__name__ = f"batch_of_{trace.__name__}"
    return batch


compiled_trace = Program(trace_setting)
compiled_batch = Program(_numbered(trace_setting), **ONE_CORE)
_compiled_first = Program(_numbered(trace_first), **ONE_CORE)
_compiled_higher = Program(_numbered(trace_higher), **ONE_CORE)
_compiled_known = Program(_known_of, **ONE_CORE)
add_responses = Program(_sum)


def _arguments(setting: Setting, transmittance: Array | None, key: PRNGKeyArray) -> dict[str, Any]:
    """What all batches take."""
    return {"setting": setting, "transmittance": transmittance, "key": key}


def begin_to_compile_traces(
    setting: Setting, transmittance: Array | None, key: PRNGKeyArray
) -> Response | None:
    """What traces batches, side by side; what takes longest first.

    **Returns:** the shapes of a response; None where the program that takes longest is compiled already.
    """
    arguments = _arguments(setting, transmittance, key) | {"number": np.array(0, np.uint32)}
    longest = _compiled_higher if follows(setting) else compiled_batch
    if longest.is_compiled(**arguments):
        # What else may be new compiles fast: looking for it would cost every call.
        return None
    if follows(setting):
        higher = _compiled_higher.begin(**arguments)
        return joined(_compiled_first.begin(**arguments), higher)
    return compiled_batch.begin(**arguments)


def begin_to_compile_sums(response: Response, brief: Recording) -> None:
    """What takes the response of a batch: what is known of its errors, and the sum of two."""
    _compiled_known.begin(response=response, recording=brief)
    add_responses.begin(response, response)


def batch_of(ready: Ready, key: PRNGKeyArray) -> Callable[[int], tuple[Response, Known]]:
    """The function that traces batch `n`: its response and what errors are known of."""
    common, higher = _arguments(ready.setting, ready.transmittance, key), None
    if follows(ready.setting):
        first, higher = _compiled_first.given(**common), _compiled_higher.given(**common)
    else:
        first = compiled_batch.given(**common)
    known = _compiled_known.given(recording=ready.brief)

    def traced(n: int) -> tuple[Response, Known]:
        number = np.array(n, np.uint32)
        response = first(number=number)
        if higher is not None:
            response = joined(response, higher(number=number))
        return response, known(response=response)

    return traced
