r"""The photon counter: single events in place of a waveform, as spaceborne photon counters record them.

The light of one pulse is spread evenly over the pixels of the detector. The photons and dark counts that
trigger a pixel are a Poisson process of rate

.. math:: \lambda(t) = \frac{p\, E'(t)}{(h c / \text{wavelength})\, n} + \frac{b}{n}

for the detected power E', the detection probability p, the background rate b and n pixels. An event makes its
pixel blind for the dead time, which photons that arrive meanwhile do not lengthen (a non-paralysable dead
time). A Poisson process has no memory. From the end t of a dead time on, the next event is therefore at the
time t' where the integrated rate

.. math:: \Lambda(t, t') = \int_t^{t'} \lambda(u)\, du

reaches a number drawn from the standard exponential distribution. Signal and background are two such
processes, and the earlier of their two next events counts. Lost photons are never drawn one by one, so that
the cost grows with the number of recorded events, not with the amount of light. Their number is drawn
afterwards: given the events, it is Poisson distributed with the rate integrated over the dead times.

Energy is taken as uniform within a sample; for that, the draws are exact. They are independent from pulse to
pulse. Negative samples, which arise where Monte Carlo noise exceeds the signal, send no photons.

Sources: Neumann et al. (2019), Remote Sens. Environ. 233, 111325, and Martino et al. (2019), Proc. SPIE
11151, for the receiver of ICESat-2; Gatt, Johnson and Nichols (2009), Appl. Opt. 48, 3261, for
arrivals between dead times.
"""

import os
from collections.abc import Iterator
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._constants import PLANCK_TIMES_LIGHT, SPEED_OF_LIGHT
from jaxlidar._fields.checks import (
    as_array,
    as_optional_array,
    as_scalar,
    check_integer,
    check_key,
    check_range,
    concrete,
    kind_of,
)
from jaxlidar._fields.ranges import FRACTION, NOT_NEGATIVE, check_ranges, quantity
from jaxlidar._not_kept import check_kept
from jaxlidar._registry import save_result

# More events would exceed the memory; more arrivals could not be counted exactly in double precision.
_MAX_EVENTS = 1e8
_MAX_ARRIVALS = 1e15
# Largest fraction of a waveform's energy by which noise may make samples negative.
MAX_NEGATIVE_FRACTION = 0.01
# Pixels, over all pulses and wavelengths, whose events are drawn at once.
_BLOCK_SIZE = 2_000_000
# Above this expectation a Poisson count is drawn as a normal variable (skewness below 1e-3).
_POISSON_MAX = 1e6


@final
class PhotonCounter(eqx.Module):
    """A receiver that counts photons. The default has the 16 pixels and the dead time of ATLAS' strong beams
    (ICESat-2; its weak beams have 4 pixels), detects all photons, and has no background and no jitter.

    Each wavelength has a separate detector. All pixels are live when the record begins.

    **Arguments:**

    - `pixels`: number of pixels over which the light of a wavelength is spread evenly, an integer of at least
      1. Default 16.
    - `dead_time`: ns for which a pixel is blind after an event, not negative. Default 3.2.
    - `detection_probability`: probability that a photon of the waveform's energy is detected, in [0, 1], one
      number or one per wavelength. That energy is already reduced by `Lidar.efficiency`. Default 1.
    - `background_rate`: events per second of sunlight and dark counts over all pixels, before dead time, not
      negative, one number or one per wavelength. Default 0; under sunlight ATLAS has some 10^6 to 10^7.
    - `jitter`: standard deviation of a recorded time in ns, not negative. It adds to that of `Lidar`, which
      is part of the waveform. Default 0.
    - `window`: (start, end) of the record in ns, on the waveform's time axis. Default None: as long as the
      waveform.

    **Raises:** ValueError for a value outside its range, and for a window that is not two increasing times;
    TypeError for objects of the wrong type.

    **Example:**

    >>> import jaxlidar as jl
    >>> weak_beam_by_day = jl.PhotonCounter(pixels=4, background_rate=5e6, window=(-300.0, 300.0))
    >>> print(f"{1e-9 * 600.0 * float(weak_beam_by_day.background_rate):.0f} background events per pulse")
    3 background events per pulse
    """

    pixels: int = eqx.field(static=True, default=16)
    dead_time: Float[Array, ""] = quantity(unit="ns", range=NOT_NEGATIVE, converter=as_scalar, default=3.2)
    detection_probability: Float[Array, "..."] = quantity(range=FRACTION, converter=as_array, default=1.0)
    background_rate: Float[Array, "..."] = quantity(
        unit="1/s", range=NOT_NEGATIVE, converter=as_array, default=0.0
    )
    jitter: Float[Array, ""] = quantity(unit="ns", range=NOT_NEGATIVE, converter=as_scalar, default=0.0)
    window: Float[Array, "..."] | None = quantity(unit="ns", converter=as_optional_array, default=None)

    def __check_init__(self):
        check_integer("pixels", self.pixels)
        check_ranges(self)
        if self.window is not None:
            if self.window.shape != (2,):
                raise ValueError(f"window has shape {self.window.shape}; admissible is (start, end)")
            window = concrete(self.window)
            if window is not None and window[1] <= window[0]:
                raise ValueError(
                    f"window = {tuple(window.tolist())} does not increase; admissible is start < end"
                )

    def count(self, wave: Any, *, key: Array, pulses: int = 1) -> "PhotonEvents":
        """Draw the events of one or more pulses.

        **Arguments:**

        - `wave`: a `Waveform` or `Waveforms`. Samples that are negative by the noise of the simulation send
          no photons.
        - `key`: a JAX random key.
        - `pulses`: number of pulses, each with the waveform's energy; an integer of at least 1. Default 1.

        **Returns:** `PhotonEvents`: NumPy arrays, without derivatives.

        **Raises:** ValueError for energies that are not finite, where negative ones take more than 1 % from a
        waveform, and where there would be more than 10^8 events; TypeError for an object of the wrong type,
        and within a JAX transformation.

        **Example:** ten pulses over the ground.

        >>> import jax
        >>> import jaxlidar as jl
        >>> lidar = jl.Lidar(wavelength=532.0, energy=1e-9)
        >>> wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
        >>> counter = jl.PhotonCounter(background_rate=5e6)
        >>> print(counter.count(wave, key=jax.random.key(1), pulses=10))
        69 photon events of 1 shot with 10 pulses each: 1 of background; 8 lost to dead time
        """
        return _count_photons(self, wave, key, pulses)


@final
class PhotonEvents(eqx.Module):
    """Events of a photon counter, in the order of shots, pulses and times. `len(events)` is their number.

    - `time`: (events,) ns, on the waveform's time axis.
    - `height`: (events,) m, the height from which light that was scattered once arrives at that time.
    - `shot`, `pulse`: (events,) numbers, from 0, of the waveform and of the pulse within it.
    - `pixel`: (events,) number of the pixel, from 0. `wavelength`: (events,) nm.
    - `signal`: (events,) True if light of the waveform triggered the event, False for background. This is the
      truth, which an instrument does not record.
    - `lost`: (shots, wavelengths) number of photons of signal and background that arrived during dead times,
      over all pulses.
    - `window`: (shots, 2) m, heights between which the record lies, the lower one first. Jitter may move
      events out of it.
    - `pulses`: number of pulses per shot.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> lidar = jl.Lidar(wavelength=532.0, energy=1e-9)
    >>> wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground(height=3.0)), key=jax.random.key(0))
    >>> events = jl.PhotonCounter().count(wave, key=jax.random.key(1), pulses=100)
    >>> print(f"{len(events)} events at a mean height of {events.height.mean():.1f} m")
    694 events at a mean height of 3.0 m
    """

    time: Float[np.ndarray, " events"]
    height: Float[np.ndarray, " events"]
    shot: Int[np.ndarray, " events"]
    pulse: Int[np.ndarray, " events"]
    pixel: Int[np.ndarray, " events"]
    wavelength: Float[np.ndarray, " events"]
    signal: Bool[np.ndarray, " events"]
    lost: Int[np.ndarray, "shots wavelengths"]
    window: Float[np.ndarray, "shots 2"]
    pulses: int = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.time)

    def __str__(self) -> str:
        shots = len(self.lost)
        noise = len(self) - int(self.signal.sum())
        return (
            f"{len(self)} photon events of {shots} shot{'s' * (shots != 1)} with {self.pulses} "
            f"pulse{'s' * (self.pulses != 1)} each: {noise} of background; {int(self.lost.sum())} lost to "
            "dead time"
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the events as a netCDF file, which `jaxlidar.open` reads.

        **Arguments:** `path`: the file to write. It appears when it is whole.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        save_result(self, path)


class _PixelRate(NamedTuple):
    """The rate of photons on one pixel during one pulse; a row for each shot and wavelength.

    - `integral`: (rows, edges) integral of the signal's rate from the start of the record to each edge of the
      samples; piecewise linear in between, as energy is uniform within a sample.
    - `background`: (rows,) rate of the background, 1/ns.
    - `start`, `step`: time of the first edge and length of the samples, ns.
    """

    integral: Float[np.ndarray, "rows edges"]
    background: Float[np.ndarray, " rows"]
    start: float
    step: float

    def integral_until(self, row: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Interpolate the integral of the signal's rate at given times."""
        samples = self.integral.shape[1] - 1
        position = np.clip((time - self.start) / self.step, 0.0, samples)
        k = np.minimum(position.astype(int), samples - 1)
        at_edge = self.integral[row, k]
        return at_edge + (position - k) * (self.integral[row, k + 1] - at_edge)

    def time_of(self, row: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Invert `integral_until`: find the times at which it reaches given levels, infinite if never."""
        time = np.full(level.shape, np.inf)
        (reached,) = np.nonzero(level < self.integral[row, -1])
        row, level = row[reached], level[reached]
        # Bisection for the sample, all rows at once. Invariant: the integral is at most the level at the edge
        # `low` and above it at the edge `high`.
        low, high = np.zeros(row.size, int), np.full(row.size, self.integral.shape[1] - 1)
        for _ in range(self.integral.shape[1].bit_length()):
            middle = (low + high) // 2
            below = self.integral[row, middle] <= level
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        at_edge = self.integral[row, low]
        fraction = (level - at_edge) / (self.integral[row, low + 1] - at_edge)
        time[reached] = self.start + self.step * (low + fraction)
        return time


class _Draws(NamedTuple):
    """Events that were drawn for some shots, in no order.

    - `channel`: number of the pixel, counted over shots, wavelengths, pulses and pixels, the last fastest.
    - `time`: ns, without jitter.
    - `signal`: True for signal, False for background.
    - `lost`: (rows,) photons lost to dead time in each row of `_PixelRate`, over all its pulses and pixels.
    """

    channel: np.ndarray
    time: np.ndarray
    signal: np.ndarray
    lost: np.ndarray


def _count_photons(counter: PhotonCounter, wave: Any, key: Array, pulses: int) -> PhotonEvents:
    """Draw the events of `PhotonCounter.count`.

    1. Convert energies to the expected number of photons per pixel and sample, and integrate them.
    2. Draw the events of all pixels and pulses (`_draw_events`), a block of shots at a time.
    3. Add jitter, sort by shot, pulse and time, and recover shot, pulse, pixel and wavelength from the
       channel.
    """
    pulses = check_integer("pulses", pulses)
    check_key(key)
    sample_time, wavelength = _concrete_field("time", wave), _concrete_field("wavelength", wave)
    check_kept(wave.energy)
    if sample_time.size < 2:
        raise ValueError("wave has one sample; admissible are two or more, which tell how long they are")
    probability = _per_wavelength("detection_probability", counter.detection_probability, wavelength)
    background = 1e-9 * _per_wavelength("background_rate", counter.background_rate, wavelength)
    step = float(sample_time[-1] - sample_time[0]) / (sample_time.size - 1)
    first_edge = float(sample_time[0]) - 0.5 * step
    window = concrete(counter.window)
    start, end = (first_edge, first_edge + step * sample_time.size) if window is None else map(float, window)
    photons_per_joule = probability * wavelength / PLANCK_TIMES_LIGHT / counter.pixels

    random = np.random.default_rng(np.asarray(jax.random.bits(key, (8,), jnp.uint32)))
    height_per_time, height_at_zero = _height_of_time(wave, sample_time)
    energies = wave.energy if wave.energy.ndim == 3 else wave.energy[None]
    pixels_per_row, rows_per_shot = counter.pixels * pulses, wavelength.size
    blocks: list[_Draws] = []
    for shots in _shot_blocks(len(energies), pixels_per_row * rows_per_shot):
        photons = _nonnegative(energies[shots]) * photons_per_joule[:, None]
        photons = photons.reshape(-1, sample_time.size)
        integral = np.concatenate([np.zeros((len(photons), 1)), np.cumsum(photons, axis=1)], axis=1)
        backgrounds = np.tile(background / counter.pixels, shots.stop - shots.start)
        rate = _PixelRate(integral, backgrounds, first_edge, step)
        _check_counts(rate, start, end, float(counter.dead_time), pixels_per_row)
        draws = _draw_events(rate, start, end, float(counter.dead_time), pixels_per_row, random)
        blocks.append(draws._replace(channel=draws.channel + shots.start * rows_per_shot * pixels_per_row))

    draws = _Draws(*(np.concatenate(arrays) for arrays in zip(*blocks)))
    time = draws.time + float(counter.jitter) * random.standard_normal(draws.time.size)
    pulse = (draws.channel // counter.pixels) % pulses
    shot = draws.channel // (pixels_per_row * rows_per_shot)
    order = np.lexsort((time, pulse, shot))
    channel, time, pulse, shot = draws.channel[order], time[order], pulse[order], shot[order]
    return PhotonEvents(
        time=time,
        height=height_at_zero[shot] + height_per_time[shot] * time,
        shot=shot,
        pulse=pulse,
        pixel=channel % counter.pixels,
        wavelength=wavelength[(channel // pixels_per_row) % rows_per_shot],
        signal=draws.signal[order],
        lost=draws.lost.reshape(-1, rows_per_shot),
        window=np.sort(height_at_zero[:, None] + height_per_time[:, None] * np.array([start, end]), axis=1),
        pulses=pulses,
    )


def _draw_events(
    rate: _PixelRate,
    start: float,
    end: float,
    dead_time: float,
    pixels_per_row: int,
    random: np.random.Generator,
) -> _Draws:
    """Draw all events between `start` and `end`, ns, of `pixels_per_row` pixels for each row of `rate`.

    Each round draws the next event of every pixel that is still live before `end`, until none has another
    one.
    """
    rounds: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    lost = np.zeros(len(rate.integral))
    channel = np.arange(len(rate.integral) * pixels_per_row)
    live_from = np.full(channel.size, start)
    while channel.size:
        row = channel // pixels_per_row
        wait = random.standard_exponential(channel.size)
        # Rounding of the interpolation must not place an event before the pixel is live.
        signal_time = np.maximum(rate.time_of(row, rate.integral_until(row, live_from) + wait), live_from)
        with np.errstate(divide="ignore"):
            background_time = live_from + random.standard_exponential(channel.size) / rate.background[row]
        time = np.minimum(signal_time, background_time)
        recorded = time < end
        signal = (signal_time <= background_time)[recorded]
        channel, row, time = channel[recorded], row[recorded], time[recorded]
        rounds.append((channel, time, signal))
        live_from = time + dead_time
        blind_until = np.minimum(live_from, end)
        expected_lost = (
            rate.integral_until(row, blind_until)
            - rate.integral_until(row, time)
            + rate.background[row] * (blind_until - time)
        )
        lost += np.bincount(row, _poisson(np.maximum(expected_lost, 0.0), random), len(lost))
    channel, time, signal = (np.concatenate(arrays) for arrays in zip(*rounds))
    return _Draws(channel, time, signal, lost.astype(np.int64))


def _poisson(mean: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Draw Poisson counts, or their normal limit where the mean is large."""
    use_normal = mean > _POISSON_MAX
    counts = random.poisson(np.where(use_normal, 0.0, mean)).astype(float)
    normal = random.standard_normal(int(use_normal.sum()))
    counts[use_normal] = np.rint(mean[use_normal] + np.sqrt(mean[use_normal]) * normal)
    return counts


def _check_counts(rate: _PixelRate, start: float, end: float, dead_time: float, pixels_per_row: int) -> None:
    """Refuse more arrivals or events than can be counted."""
    arrivals = rate.integral[:, -1] + rate.background * (end - start)
    # A pixel has at most one event in each dead time.
    max_events = (end - start) / dead_time + 1.0 if dead_time > 0 else np.inf
    for name, count, limit in (
        ("photons", arrivals, _MAX_ARRIVALS),
        ("events", np.minimum(arrivals, max_events), _MAX_EVENTS),
    ):
        if (total := pixels_per_row * float(np.sum(count))) > limit:
            raise ValueError(f"energy and background give {total:g} {name}; admissible are up to {limit:g}")


def _nonnegative(energy: Any) -> np.ndarray:
    """Set energies that noise made negative to zero. **Raises:** ValueError where they are too many."""
    energy = np.asarray(energy, float)
    check_range("energy", energy)
    check_negative_energy(energy)
    return np.maximum(energy, 0.0)


def check_negative_energy(energy: np.ndarray) -> None:
    """Refuse waveforms, (..., bins), from which negative samples take more than the noise of a simulation.

    **Raises:** ValueError with the lowest sample.
    """
    positive = np.maximum(energy, 0.0)
    negative_part = np.sum(positive - energy, axis=-1)
    if np.any(negative_part > MAX_NEGATIVE_FRACTION * np.sum(positive, axis=-1)):
        raise ValueError(
            f"energy = {energy.min():g} is too far below zero; admissible are samples that all together "
            f"take up to {MAX_NEGATIVE_FRACTION:.0%} from their waveform"
        )


def _shot_blocks(shots: int, pixels_per_shot: int) -> Iterator[slice]:
    size = max(1, _BLOCK_SIZE // pixels_per_shot)
    return (slice(i, min(i + size, shots)) for i in range(0, shots, size))


def _concrete_field(field: str, wave: Any) -> np.ndarray:
    """Return a field of a waveform. **Raises:** TypeError where `wave` is no waveform, or is being traced."""
    if not hasattr(wave, "energy") or (value := concrete(getattr(wave, field, None))) is None:
        raise TypeError(
            f"wave is {kind_of(wave)}; admissible is a Waveform or Waveforms, outside of JAX transformations"
        )
    return value


def _per_wavelength(field: str, x: Array, wavelength: np.ndarray) -> np.ndarray:
    if x.shape not in ((), (1,), wavelength.shape):
        raise ValueError(
            f"{field} has shape {x.shape}; admissible is one number, or one for each of the "
            f"{wavelength.size} wavelengths of the waveform"
        )
    return np.broadcast_to(np.asarray(x, float), wavelength.shape)


def _height_of_time(wave: Any, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute dz/dt, m/ns, and the height at time zero, m, of light that was scattered once, each (shots,).

    `Waveforms` have the direction of each shot; of a `Waveform`, the farthest height and time give it. Light
    of time zero comes from the reference plane, or from the sensor of a lidar that is placed by it.
    """
    if hasattr(wave, "zenith"):
        slope = -0.5 * SPEED_OF_LIGHT * np.cos(np.deg2rad(np.asarray(wave.zenith, float)))
        position = np.asarray(wave.position, float)
        return slope, position[:, 2] if position.shape[1] == 3 else np.zeros_like(slope)
    heights, farthest = np.asarray(wave.height, float), int(np.argmax(np.abs(time)))
    from_sensor = "altitude" in wave.info and wave.info["altitude"] is None
    # The middle of the time axis differs from its farthest end, whichever that is.
    origin = time.size // 2 if from_sensor else None
    start_time, start_height = (0.0, 0.0) if origin is None else (time[origin], heights[origin])
    slope = (heights[farthest] - start_height) / (time[farthest] - start_time)
    return np.array([slope]), np.array([start_height - slope * start_time])
