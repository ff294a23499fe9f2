r"""Recorder of waveforms: the receiver's response, delay, offsets of digitisers, noise of the pulse.

With w the waveform simulated with the recorded pulse and * the convolution, sample i of a record is

    y_i = scale (r * g * w)(t_i - d) + b_(i mod n) + noise,

with r the receiver's impulse response, g a Gaussian of unknown width, d an unknown delay, and b_j the offset
of digitiser j of n that take samples in turn; one digitiser has a single baseline. Smoothing and delay are
done in the Fourier domain, which is exact for signals that the sampling resolves. Width, delay, offsets and
scale are unknowns of a fit: `inversion.fit.recorder_model`.
"""

from typing import Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar.extend import (
    Range,
    as_numpy,
    as_optional_array,
    as_scalar,
    check_integer,
    check_number,
    check_range,
    check_ranges,
    quantity,
)

# Names of the unknowns that a recorder adds to a fit.
WIDTH_NAME, DELAY_NAME, OFFSET_NAME = "receiver width", "delay", "offset"

BoundPair = tuple[float, float]


@final
class Recorder(eqx.Module):
    """Receiver and digitisers of a recorder, for `retrieve` and `retrieve_many`. Its gain is their `scale`.

    - `width`: (low, high), bounds of a further unknown, "receiver width": standard deviation in ns of the
      Gaussian by which the receiver smooths. It starts at their middle. Default None: no smoothing.
    - `delay`: (low, high), bounds of a further unknown, "delay": time in ns by which the record is late, for
      timing that is not known; the range offset is half of it times the speed of light. It starts at their
      middle. What moves out of the record is lost, and what moves in is dark. The same delay moves the ground
      and everything above it: give heights bounds or priors that tell them apart. Default None: no delay.
    - `impulse`: (lags,) the receiver's response to an impulse at the record's sampling, an odd number of
      lags with time zero in the middle; its scale does not matter. It may be negative for a receiver
      that overshoots. `receiver_impulse` estimates it. Default None: none.
    - `offset`: (low, high), bounds of a further unknown, "offset", added to the record, in its unit. It
      starts from its least-squares value. Default None: no such unknown.
    - `interleaved`: number of digitisers that take samples in turn, each with its own offset: "offset" then
      has that many values. Default 1: one baseline.
    - `pulse_noise`: standard deviation of the noise of the recorded pulse over its peak, independent from
      sample to sample at the record's sampling, 0 or more. `recorded_pulse` gives a pulse with such noise.
      Default 0.
    - `correlation`: rho of the noise of neighbouring samples, in [0, 1); that of samples n apart is rho^n.
      `noise` of a fit is the standard deviation of each sample. Default 0: independent.

    **Raises:** ValueError for a value outside its range, bounds that are not a pair low < high, an impulse
    with an even number of lags or a sum that is not above 0, and `interleaved` without `offset`.

    **Example:** a baseline that differs between odd and even samples, and a slow receiver.

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> import numpy as np
    >>> truth, start = jl.Scene(ground=jl.Ground(height=0.5)), jl.Scene(ground=jl.Ground())
    >>> wave = jl.simulate(jl.Lidar(jitter=2.0), truth, key=jax.random.key(0), window=(-40.0, 40.0))
    >>> pedestals = np.where(np.arange(wave.time.size) % 2, 0.03, 0.02)
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> recorder = inversion.Recorder(width=(0.1, 5.0), offset=(-0.1, 0.1), interleaved=2)
    >>> record = np.asarray(wave.reflectance)[0] + pedestals
    >>> instrument = {"recorder": recorder, "scale": (0.1, 10.0), "noise": 0.001, "time": wave.time}
    >>> problem = inversion.Problem(record, jl.Lidar(), start, [height], **instrument)
    >>> fit = inversion.retrieve(problem, key=jax.random.key(1))
    >>> print(f"{float(fit.values['receiver width']):.1f} ns", fit.values["offset"].round(3))
    2.0 ns [0.02 0.03]
    """

    width: BoundPair | None = eqx.field(static=True, default=None)
    delay: BoundPair | None = eqx.field(static=True, default=None, kw_only=True)
    impulse: Float[Array, " lags"] | None = quantity(converter=as_optional_array, default=None)
    offset: BoundPair | None = eqx.field(static=True, default=None)
    interleaved: int = eqx.field(static=True, default=1)
    pulse_noise: Float[Array, ""] = quantity(range=Range(0.0), converter=as_scalar, default=0.0)
    correlation: Float[Array, ""] = quantity(
        range=Range(0.0, 1.0, high_open=True), converter=as_scalar, default=0.0
    )

    def __check_init__(self):
        for field, low in (("width", 0.0), ("delay", -np.inf), ("offset", -np.inf)):
            bounds = getattr(self, field)
            if bounds is not None:
                bound_pair(field, bounds, low)
        check_integer("interleaved", self.interleaved)
        check_ranges(self)
        if self.interleaved > 1 and self.offset is None:
            raise ValueError(f"interleaved = {self.interleaved}, but offset = None: bounds of the offsets")
        if self.impulse is not None:
            if self.impulse.ndim != 1 or self.impulse.size % 2 == 0:
                raise ValueError(
                    f"impulse has the shape {self.impulse.shape}; admissible is (lags,) with an odd number"
                )
            check_range("sum of impulse", jnp.sum(self.impulse), 0.0, low_open=True)

    def recorded(
        self, reflectance: Float[ArrayLike, "... bins"], values: dict[str, Any], *, step: float = 1.0
    ) -> Float[np.ndarray, "... bins"]:
        """Return the record of a simulated waveform at fitted values.

        **Arguments:** `reflectance`: (..., bins), such as one of `Retrieval.fitted`. `values`: by name, as
        fitted; those of the scene are not used. `step`: the sampling interval, ns. Default 1.

        **Returns:** (..., bins) in the unit of the record.
        """
        waveform = as_numpy(reflectance, "reflectance")
        check_number("step", step, 0.0, low_open=True)
        bins = waveform.shape[-1]
        width, delay = (float(np.asarray(values.get(name, 0.0))) for name in (WIDTH_NAME, DELAY_NAME))
        received = ReceiverResponse(self, bins, step)(waveform, width, delay)
        # Repeats the offsets of the digitisers along the record.
        offset = np.resize(np.asarray(values.get(OFFSET_NAME, 0.0), float).ravel(), bins)
        return float(np.asarray(values.get("scale", 1.0))) * received + offset


class ReceiverResponse:
    """Convolution of the last axis with a receiver's response r * g, and a delay, in the Fourier domain."""

    def __init__(self, recorder: Recorder, bins: int, interval: float):
        self.bins, self.has_delay = bins, recorder.delay is not None
        self.is_identity = recorder.width is None and recorder.delay is None and recorder.impulse is None
        lags = 1 if recorder.impulse is None else recorder.impulse.size
        # Long enough that light smoothed out of the record at one end does not come back at the other.
        self.size = 2 * bins + lags
        self.omega = 2.0 * np.pi * np.fft.rfftfreq(self.size, interval)
        self.impulse_spectrum = np.ones(self.omega.size)
        if recorder.impulse is not None:
            samples = np.zeros(self.size)
            samples[:lags] = np.asarray(recorder.impulse, float) / float(jnp.sum(recorder.impulse))
            # Time zero, the middle lag, becomes the first sample of the transform.
            self.impulse_spectrum = np.fft.rfft(np.roll(samples, -(lags // 2)))

    def __call__(
        self, waveform: Any, width: Any, delay: Any, *, derivative: Literal["width", "delay"] | None = None
    ) -> Any:
        """Return the waveform as received, or its derivative with respect to the width or the delay.

        The Gaussian of width s has the spectrum exp(-(omega s)^2 / 2), with the derivative -omega^2 s times
        that; a delay d has exp(-i omega d), with the derivative -i omega times that. NumPy arrays give NumPy
        arrays, in double precision; JAX arrays may be traced.
        """
        if self.is_identity:
            return waveform
        numpy: Any = jnp if isinstance(waveform, jax.Array) else np
        factors = {None: 1.0, "width": -width * self.omega**2, "delay": -1j * self.omega}
        # A delay of zero keeps real numbers real.
        turned = numpy.exp(-1j * self.omega * delay) if self.has_delay else 1.0
        smoothed = numpy.exp(-0.5 * (self.omega * width) ** 2)
        spectrum = self.impulse_spectrum * smoothed * turned * factors[derivative]
        transformed = numpy.fft.rfft(waveform, self.size)
        # JAX refuses to multiply arrays of unlike rank where a user has told it to.
        spectrum = spectrum.reshape((1,) * (waveform.ndim - 1) + (-1,))
        return numpy.fft.irfft(transformed * spectrum, self.size)[..., : self.bins]


def bound_pair(field: str, bounds: Any, least: float = -np.inf) -> BoundPair:
    """Return bounds as numbers. **Raises:** ValueError unless they are a pair low < high, from `least` on."""
    try:
        low, high = (float(b) for b in bounds)
    except (TypeError, ValueError):
        raise ValueError(f"{field} = {bounds!r} is not a pair (low, high)") from None
    check_range(field, [low, high], least)
    if not low < high:
        raise ValueError(f"{field} = {bounds!r} is not low < high")
    return low, high
