"""The receiver: detection, noise and digitisation of the energy that arrives.

`record` turns expected energies per sample into a record, with or without one realisation of the noise. For
the detected energy E of a sample, the background b and the photon energy e = h c / wavelength, a sample is

    x = e Poisson((E + b) / e) + s Normal(0, 1)    (or E + b, without noise)
    x = min(x, S)                                  saturation S
    x = 0 where x < D                              detection threshold D
    x = q round(x / q),  q = S / (2^B - 1)         quantisation to B bits

`first_return_window` starts the sampling bins at the first return, as the paper does in its section 2.1.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._constants import PLANCK_TIMES_LIGHT
from jaxlidar._fields.checks import (
    as_array,
    as_numpy,
    as_optional_scalar,
    as_scalar,
    check_choice,
    check_flag,
    check_integer,
    check_key,
    check_kind,
    check_number,
    check_numbers,
    check_range,
    concrete,
    even_step,
    warn_unit,
)
from jaxlidar._fields.ranges import NANOMETRES, NOT_NEGATIVE, POSITIVE, check_ranges, quantity
from jaxlidar._jax.products import einsum
from jaxlidar._not_kept import NotKept, check_kept
from jaxlidar.sensors.photon_counter import MAX_NEGATIVE_FRACTION, PhotonCounter, check_negative_energy

# Above this expectation a Poisson count is drawn as a normal variable of its first three moments. The exact
# sampler of JAX weighs terms of the size m ln m in single precision, whatever the precision of the draws:
# from some 1e5 photons on they are wrong by percents of their variance.
_POISSON_MAX = 1e4
_ENERGY = "J per sample"

Wavelengths: TypeAlias = ArrayLike | Sequence[ArrayLike]
# A function of a key, expected energies and wavelengths, which gives noisy samples.
NoiseModel: TypeAlias = Callable[[Array, Array, Array], Any]


@final
class Receiver(eqx.Module):
    """Detection, noise and digitisation of a waveform. The default is a perfect record.

    All energies are detected energies, that is, after the efficiency of optics and detector.

    **Arguments:**

    - `detection_threshold`: J per sample, not negative; samples below it are recorded as zero. Default 0: no
      sample is set to zero, and electronic noise may make a sample negative.
    - `saturation`: J per sample, positive; larger samples are recorded as this value. Default None: no limit.
    - `bits`: resolution of the digitiser, an integer in [1, 24], over the range [0, `saturation`]; it needs a
      saturation. Default None: not quantised.
    - `background`: J per sample, not negative, added to every sample (sunlight, dark current). Default 0.
    - `photon_noise`: True if a noisy record has the shot noise of signal and background. Default True.
    - `electronic_noise`: standard deviation of additive normal noise in J per sample, not negative. Default
      0.
    - `window`: "fixed": samples at fixed instants; "first return": the sampling bins start at the first
      return, as in the paper (see `first_return_window`). Default "fixed".

    **Raises:** ValueError for a value outside its range, for an unknown window, and for `bits` without
    `saturation`; TypeError for an object of the wrong type.

    **Example:** a digitiser of two bits has four levels.

    >>> import jaxlidar as jl
    >>> import numpy as np
    >>> receiver = jl.Receiver(saturation=3e-15, bits=2)
    >>> recorded = jl.record(np.array([[0.4e-15, 1.2e-15, 5e-15]]), 1064.0, receiver)
    >>> print([f"{x:.1e}" for x in recorded[0]])
    ['0.0e+00', '1.0e-15', '3.0e-15']
    """

    detection_threshold: Float[Array, ""] = quantity(
        unit=_ENERGY, range=NOT_NEGATIVE, converter=as_scalar, default=0.0
    )
    saturation: Float[Array, ""] | None = quantity(
        unit=_ENERGY, range=POSITIVE, converter=as_optional_scalar, default=None
    )
    bits: int | None = eqx.field(static=True, default=None)
    background: Float[Array, ""] = quantity(
        unit=_ENERGY, range=NOT_NEGATIVE, converter=as_scalar, default=0.0
    )
    photon_noise: bool = eqx.field(static=True, default=True)
    electronic_noise: Float[Array, ""] = quantity(
        unit=_ENERGY, range=NOT_NEGATIVE, converter=as_scalar, default=0.0
    )
    window: str = eqx.field(static=True, default="fixed")

    def __check_init__(self):
        check_flag("photon_noise", self.photon_noise)
        check_ranges(self)
        if self.bits is not None:
            check_integer("bits", self.bits, 1, 24)
            if self.saturation is None:
                raise ValueError(f"bits = {self.bits} needs a saturation in (0, inf), but saturation = None")
        check_choice("window", self.window, ("fixed", "first return"))


def record(
    wave: Any,
    wavelength: Wavelengths | None = None,
    receiver: Receiver | None = None,
    *,
    key: Array | None = None,
    noise_model: NoiseModel | None = None,
) -> Float[Array, "*channels wavelengths bins"]:
    """Record a waveform with a receiver. `PhotonCounter.count` records it as photon events.

    Background and noise are added; saturation, detection threshold and quantisation follow in this order.

    **Arguments:**

    - `wave`: a `Waveform` or `Waveforms`, or an array (..., wavelengths, bins) of expected detected energies
      in J per sample, not negative. Samples of NaN stay NaN. Samples of a waveform may be negative by the
      noise of its simulation: they send no photons.
    - `wavelength`: nm, one number or (wavelengths,), where `wave` is an array: a photon carries the energy
      h c / wavelength. Default None: the waveform's.
    - `receiver`: the `Receiver` that records, such as `lidar.receiver`. Default None: one with its defaults,
      which is refused for a waveform that shows another one, by its `recorded` or, of a survey, its noise.
    - `key`: a JAX random key. With a key, samples are one realisation of the noise: the photons of signal and
      background are Poisson counts, or a normal variable of mean, variance and skewness of a Poisson count
      where more than 10,000 are expected; electronic noise is normal. Default None: the samples of the
      expected energies, without noise.
    - `noise_model`: a function of `key`, the expected energies with the background, (..., wavelengths, bins)
      J, and the wavelengths in nm, (..., wavelengths, 1), which broadcast with them, that returns the noisy
      samples, of the shape of the energies, in place of the receiver's photon and electronic noise.
      Saturation, threshold and quantisation follow. Where JAX traces the energies it is to be traceable,
      otherwise NumPy will do. Default None: those of the receiver.

    **Returns:** J per sample, an array shaped as the energies. Derivatives pass through the quantisation as
    if it were absent (a straight-through estimate). They pass through the noise of a realisation with its
    draws held fixed, so not through Poisson counts.

    **Raises:** ValueError for a waveform of another receiver than the default, where none is given; where the
    energies have fewer than two axes, for infinite energies, for negative ones in an array, and where those
    of a waveform take more than 1 % from it; for wavelengths that are not positive, and for neither one nor
    one per row of the energies; for a noise model without a key, or that returns another shape than that of
    the energies; TypeError for an object of the wrong type. Inside a JAX transformation, where values cannot
    be refused, such samples become NaN: the negative or infinite ones of an array, all of a waveform.

    **Example:**

    >>> import jaxlidar as jl
    >>> import numpy as np
    >>> receiver = jl.Receiver(detection_threshold=3e-16, saturation=1e-15)
    >>> recorded = jl.record(np.array([[2e-16, 6e-16, 17e-16]]), 1064.0, receiver)
    >>> print([f"{x:.1e}" for x in recorded[0]])
    ['0.0e+00', '6.0e-16', '1.0e-15']
    """
    check_kind("noise_model", noise_model, Callable | None, "a function, or None")
    if noise_model is not None and key is None:
        raise ValueError("noise_model is given; admissible is one with a key")
    is_waveform = hasattr(wave, "energy")
    if is_waveform and wavelength is not None:
        raise ValueError("wavelength is given, but wave is a waveform, which has its own")
    if is_waveform:
        check_kept(wave.energy)
    energies: Any = wave.energy if is_waveform else wave
    wavelengths: Any = wave.wavelength if is_waveform else wavelength
    check_numbers("wavelength", wavelengths)
    energy, wavelength = as_array(energies, "energy"), as_array(wavelengths, "wavelength")
    if receiver is None:
        receiver = Receiver()
        if is_waveform:
            _check_recorded_by_default(wave, noise_model is not None)
    check_kind("receiver", receiver, Receiver, "a Receiver; a PhotonCounter counts by its method count")
    if energy.ndim < 2:
        raise ValueError(f"energy has shape {energy.shape}; admissible is (..., wavelengths, bins)")
    check_range("wavelength", wavelength, 0.0, low_open=True)
    warn_unit("wavelength", wavelength, NANOMETRES)
    if wavelength.shape not in ((), (1,), energy.shape[-2:-1]):
        raise ValueError(
            f"wavelength has shape {wavelength.shape}; admissible is one number, or one for each of the "
            f"{energy.shape[-2]} wavelengths of energy"
        )
    energy = _admissible_waveform(energy) if is_waveform else _admissible_samples(energy)
    if noise_model is None:
        return digitise(energy, wavelength, receiver, key)
    assert key is not None
    check_key(key)
    wavelengths = jnp.broadcast_to(wavelength, energy.shape[-2:-1])
    wavelengths = wavelengths.reshape((1,) * (energy.ndim - 2) + (-1, 1))
    samples = as_array(
        noise_model(key, energy + receiver.background, wavelengths), "what noise_model returns"
    )
    if samples.shape != energy.shape:
        raise ValueError(f"noise_model returns the shape {samples.shape}; admissible is {energy.shape}")
    return _quantise(samples, receiver)


def _check_recorded_by_default(wave: Any, has_noise_model: bool) -> None:
    """Refuse a waveform that shows a receiver other than the default, as far as its values are known.

    The default one records the energies themselves, and no noise where there is no signal.
    """
    acquisition = getattr(wave, "acquisition", None)
    shows_noise = acquisition is not None and bool(np.any(acquisition.noise > 0)) and not has_noise_model
    recorded = getattr(wave, "recorded", None)
    recorded = None if isinstance(recorded, NotKept) else concrete(recorded)
    energy = concrete(wave.energy)
    is_changed = not (recorded is None or energy is None or np.allclose(recorded, energy, 1e-5, 0.0, True))
    if shows_noise or is_changed:
        raise ValueError(
            "receiver = None, but the waveform was recorded by one that is not the default; admissible is "
            "that of its lidar, lidar.receiver, or another one, such as Receiver()"
        )


def _admissible_samples(energy: Array) -> Array:
    """Refuse negative and infinite energies; where they are traced, return NaN for them. NaN stays NaN."""
    values = concrete(energy)
    if values is not None:
        check_range("energy", values[~np.isnan(values)], 0.0)
        return energy
    return jnp.where((energy >= 0) & (energy < jnp.inf), energy, jnp.nan)


def _admissible_waveform(energy: Array) -> Array:
    """Refuse waveforms that are infinite or too far below zero; where traced, return NaN for them."""
    values = concrete(energy)
    if values is not None:
        check_range("energy", values[~np.isnan(values)])
        check_negative_energy(np.where(np.isnan(values), 0.0, values))
    return _without_negative_waveforms(energy)


@jax.jit
def _without_negative_waveforms(energy: Array) -> Array:
    """Return NaN for waveforms that are infinite or too far below zero."""
    missing = jnp.where(jnp.isnan(energy), 0.0, energy)
    positive = jnp.sum(jnp.maximum(missing, 0.0), axis=-1, keepdims=True)
    negative = jnp.sum(jnp.maximum(-missing, 0.0), axis=-1, keepdims=True)
    is_admissible = (negative <= MAX_NEGATIVE_FRACTION * positive) & (positive < jnp.inf)
    return jnp.where(is_admissible, energy, jnp.nan)


def digitise(
    energy: Array, wavelength: Array, receiver: Receiver | PhotonCounter, key: Array | None = None
) -> Array:
    """Apply background, noise, saturation, threshold and quantisation; without noise if `key` is None.

    For energies of the simulation itself: they are not checked. A `PhotonCounter` has no samples: they are
    the expected energies.
    """
    if isinstance(receiver, PhotonCounter):
        return energy
    if key is not None:
        check_key(key)
    return _digitise(energy, wavelength, receiver, key)


@eqx.filter_jit
def _digitise(energy: Array, wavelength: Array, receiver: Receiver, key: Array | None) -> Array:
    """Apply the steps of `digitise`, in one program."""
    expected = energy + receiver.background
    value = expected
    if key is not None:
        photon_key, electronic_key = jax.random.split(key)
        if receiver.photon_noise:
            value = _shot_noise(expected, wavelength, photon_key)
        noise = jax.random.normal(electronic_key, energy.shape, energy.dtype)
        value = value + receiver.electronic_noise * noise
    return _quantise(value, receiver)


@eqx.filter_jit
def _quantise(value: Array, receiver: Receiver) -> Array:
    """Apply saturation, detection threshold and quantisation to samples with their noise."""
    if receiver.saturation is not None:
        value = jnp.minimum(value, receiver.saturation)
    threshold = receiver.detection_threshold
    value = jnp.where((threshold > 0) & (value < threshold), 0.0, value)
    if receiver.bits is not None and receiver.saturation is not None:
        step = receiver.saturation / (2**receiver.bits - 1)
        level = jnp.clip(jnp.round(value / step), 0, 2**receiver.bits - 1)
        # A straight-through estimate. The difference is exactly zero, so that the value is the level to the
        # bit; the derivative is that of `value`.
        value = jax.lax.stop_gradient(level * step) + (value - jax.lax.stop_gradient(value))
    return value


def _shot_noise(energy: Array, wavelength: Array, key: Array) -> Array:
    """Draw the energy of a Poisson number of photons, or of its normal limit; NaN for energies of NaN.

    With z a normal number, the count of a large mean m is

        m + sqrt(m) z + (z^2 - 1) / 6,

    the first terms of the expansion of Cornish and Fisher (1938): its mean and its third central moment are
    m, its variance is m + 1/18.
    """
    photon_energy = PLANCK_TIMES_LIGHT / wavelength.astype(energy.dtype)
    photon_energy = jnp.broadcast_to(photon_energy.reshape(-1, 1), energy.shape)
    # No photons where noise of the simulation exceeds the signal; the maximum keeps NaN.
    photons = jnp.maximum(energy / photon_energy, 0.0)
    count_key, normal_key = jax.random.split(key)
    use_normal = photons > _POISSON_MAX
    # The sampler has integers, which hold no NaN.
    is_count = ~use_normal & ~jnp.isnan(photons)
    counts = jax.random.poisson(count_key, jax.lax.stop_gradient(jnp.where(is_count, photons, 1.0)))
    normal = jax.random.normal(normal_key, energy.shape, energy.dtype)
    # The square root of samples that do not use it must not reach zero: its derivative is infinite there.
    mean = jnp.where(use_normal, photons, 1.0)
    large_counts = mean + jnp.sqrt(mean) * normal + (normal**2 - 1.0) / 6.0
    counts = jnp.where(use_normal, large_counts, counts.astype(energy.dtype))
    return jnp.where(jnp.isnan(photons), jnp.nan, photon_energy * counts)


def first_return_window(
    time: ArrayLike,
    energy: Float[ArrayLike, "*channels bins"],
    interval: float,
    threshold: ArrayLike = 0.0,
) -> tuple[Float[Array, " samples"], Float[Array, "*channels samples"]]:
    """Sample a finely resolved waveform on coarser bins that start at the first return.

    The paper samples in this way (its section 2.1) and notes the artefact: the position of the bins depends
    on the scene. The first echo always starts at the edge of a bin, where samples at fixed instants would
    split it over two bins. Later echoes fall where their distance from the first puts them, so that a peak
    (the paper's ground) reads too high. Real digitisers sample at instants that do not depend on the scene.
    Use this only to reproduce the paper's figures.

    **Arguments:**

    - `time`: (bins,) centres of the fine bins in ns, evenly spaced, at least two; not traced by JAX.
    - `energy`: (..., bins) J per fine bin, taken as uniform within the bin.
    - `interval`: width of the new bins in ns, positive, not traced by JAX. It need not be a multiple of the
      fine width.
    - `threshold`: J per fine bin; the window starts at the first fine bin in which any channel exceeds it, or
      at the start of the record where none does. Default 0.

    **Returns:** the centres of the new bins in ns, (samples,), and the energy per new bin, (..., samples).
    Energy from the start of the window on is conserved. Earlier energy (none at a threshold of zero) is not
    recorded. There are always ceil(record length / `interval`) bins; the last ones are empty.

    **Raises:** ValueError for an interval that is not positive, and for times that are uneven, fewer than
    two, or not one per bin of `energy`.

    **Example:**

    >>> import jaxlidar as jl
    >>> import numpy as np
    >>> time, energy = np.arange(6.0), np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0])
    >>> centres, samples = jl.first_return_window(time, energy, interval=2.0)
    >>> print(centres, samples)
    [2.5 4.5 6.5] [2. 4. 0.]
    """
    check_number("interval", interval, 0.0, low_open=True)
    check_range("time", time)
    energy, threshold = as_array(energy, "energy"), as_scalar(threshold, "threshold")
    centres = as_numpy(time, "time")
    if centres.ndim != 1 or centres.size < 2 or energy.shape[-1:] != centres.shape:
        raise ValueError(f"time has shape {centres.shape}; admissible is one per bin of energy, two or more")
    step = float(even_step("time", time))
    ratio = interval / step
    # The tolerance keeps rounding of the ratio from adding an empty bin.
    samples = math.ceil(centres.size / ratio - 1e-6)
    # Neighbours share their edges to the last bit.
    edges = (ratio * np.arange(samples + 1)).astype(energy.dtype)
    first, energies = _sample_from_first_return(energy, threshold, edges)
    middle = (ratio * np.arange(samples) + 0.5 * ratio - 0.5).astype(energy.dtype)
    return centres[0] + step * (first + middle), energies


@jax.jit
def _sample_from_first_return(
    energy: Float[Array, "*channels bins"], threshold: Float[Array, ""], edges: Float[Array, " edges"]
) -> tuple[Float[Array, ""], Float[Array, "*channels samples"]]:
    """Return the number of the first bin above the threshold, and energies between edges counted from it."""
    bins = energy.shape[-1]
    exceeds = jnp.any(energy.reshape(-1, bins) > threshold, axis=0)
    first = jnp.argmax(exceeds).astype(energy.dtype)
    edges, fine_edges = edges[:, None], (np.arange(bins) - first)[None, :]
    overlap = jnp.clip(jnp.minimum(edges[1:], fine_edges + 1) - jnp.maximum(edges[:-1], fine_edges), 0.0)
    return first, einsum("...b,sb->...s", energy, overlap)
