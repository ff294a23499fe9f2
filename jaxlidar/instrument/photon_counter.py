r"""The photon counter: single events in place of a waveform, as spaceborne photon counters record them.

The light of one pulse falls evenly on the pixels of the detector. What triggers a pixel is a Poisson process
of rate

.. math:: \lambda(t) = \frac{p\, E'(t)}{(h c / \text{wavelength})\, n} + \frac{b}{n}

for the detected power E', the detection probability p, the background rate b and n pixels. An event makes its
pixel blind for the dead time, and what arrives meanwhile does not lengthen it (a non-paralysable dead time).
A Poisson process has no memory, so the next event after the time t at which a pixel sees again is where the
integral of the rate from t on reaches a number drawn from the exponential distribution. So events are drawn
without drawing what is lost, and any amount of light costs no more than the events that it leaves. How much
was lost is drawn beside: given the events, Poisson with the integral of the rate over the dead times.

Energy is uniform within a sample. The draws are exact for that, and independent from pulse to pulse. Samples
below zero, which noise makes where footprints share light, send no photons.

Sources: Neumann et al. (2019), Remote Sens. Environ. 233, 111325, and Martino et al. (2019), Proc. SPIE
11151, for the receiver of ICESat-2; Gatt, Johnson and Nichols (2009), Appl. Opt. 48, 3261, for
arrivals between dead times.
"""

import os
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._checks import (
    array,
    briefly,
    check_integer,
    check_key,
    check_kind,
    check_range,
    concrete,
    kind_of,
    scalar,
)
from jaxlidar._constants import PLANCK_TIMES_LIGHT, SPEED_OF_LIGHT
from jaxlidar._ranges import FRACTION, Range, check_ranges
from jaxlidar._registry import save_result

# Beyond so many events, memory would end before the draws do; beyond so many arrivals, counts of them would
# have rounding errors.
_MOST_EVENTS = 1e8
_MOST_ARRIVALS = 1e15
# Share of a waveform's energy that noise may have put below zero.
_BELOW_ZERO = 0.01
# Pixels, over all pulses and wavelengths, whose events are drawn at once.
_BLOCK = 2_000_000
# Above this expectation a Poisson count is drawn as a normal variable (skewness below 1e-3).
_POISSON_MAX = 1e6


def _window(x: Any) -> Float[Array, "..."] | None:
    return None if x is None else array("window")(x)


@final
@briefly
class PhotonCounter(eqx.Module):
    """A receiver that counts photons. The default has the 16 pixels and the dead time of ATLAS' strong beams
    (ICESat-2; its weak beams have 4 pixels), detects all photons, and has no background and no jitter.

    Each wavelength has a detector of its own. All pixels see when the record begins.

    **Arguments:**

    - `pixels`: on which the light of a wavelength falls evenly, an integer of at least 1. Default 16.
    - `dead_time`: ns for which a pixel is blind after an event, not negative. Default 3.2.
    - `detection_probability`: of a photon that the waveform's energy counts, in [0, 1], one number or one per
      wavelength. That energy is already reduced by `Lidar.efficiency`. Default 1.
    - `background_rate`: events per second of sunlight and dark counts over all pixels, before dead time, not
      negative, one number or one per wavelength. Default 0; under sunlight ATLAS has some 10^6 to 10^7.
    - `jitter`: standard deviation of a recorded time in ns, not negative. It is beside that of `Lidar`, which
      the waveform holds. Default 0.
    - `window`: (start, end) of the record in ns, on the waveform's time axis. Default None: as long as the
      waveform.

    **Raises:** ValueError for a value outside its range, and for a window that is not two increasing times;
    TypeError for things of another kind.

    **Example:**

    >>> import jaxlidar as jl
    >>> weak_beam_by_day = jl.PhotonCounter(pixels=4, background_rate=5e6, window=(-300.0, 300.0))
    >>> print(f"{1e-9 * 600.0 * float(weak_beam_by_day.background_rate):.0f} background events per pulse")
    3 background events per pulse
    """

    pixels: int = eqx.field(static=True, default=16)
    dead_time: Float[Array, ""] = eqx.field(converter=scalar("dead_time"), default=3.2)
    detection_probability: Float[Array, "..."] = eqx.field(
        converter=array("detection_probability"), default=1.0
    )
    background_rate: Float[Array, "..."] = eqx.field(converter=array("background_rate"), default=0.0)
    jitter: Float[Array, ""] = eqx.field(converter=scalar("jitter"), default=0.0)
    window: Float[Array, "..."] | None = eqx.field(converter=_window, default=None)

    ranges: ClassVar = {
        "dead_time": Range(0.0),
        "detection_probability": FRACTION,
        "background_rate": Range(0.0),
        "jitter": Range(0.0),
        "window": Range(),
    }

    def __check_init__(self):
        check_integer("pixels", self.pixels)
        check_ranges(self)
        if self.window is not None:
            if self.window.shape != (2,):
                raise ValueError(f"window has shape {self.window.shape}; admissible is (start, end)")
            known = concrete(self.window)
            if known is not None and known[1] <= known[0]:
                raise ValueError(
                    f"window = {tuple(known.tolist())} does not increase; admissible is start < end"
                )


@final
@briefly
class PhotonEvents(eqx.Module):
    """Events of a photon counter, in the order of shots, pulses and times. `len(events)` is their number.

    - `time`: (events,) ns, on the waveform's time axis.
    - `height`: (events,) m, the height from which light of order one arrives at that time.
    - `shot`, `pulse`: (events,) numbers, from 0, of the waveform and of the pulse within it.
    - `pixel`: (events,) number of the pixel, from 0. `wavelength`: (events,) nm.
    - `signal`: (events,) whether light of the waveform made the event: the truth, which no instrument knows.
    - `lost`: (shots, wavelengths) what arrived while its pixel was blind, of signal and background, over all
      pulses.
    - `window`: (shots, 2) m, heights between which the record lies, the lower one first. Jitter may carry
      events beyond.
    - `pulses`: number of pulses per shot.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> lidar = jl.Lidar(wavelength=532.0, energy=1e-9)
    >>> wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground(height=3.0)), key=jax.random.key(0))
    >>> events = jl.record(wave, mode="photons", key=jax.random.key(1), pulses=100)
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


class _Light(NamedTuple):
    """What falls on one pixel during one pulse; a row for each shot and wavelength.

    `total` (rows, edges) is the integral of the signal's rate up to each edge of the samples, which lie
    `step` ns apart from `first` on; `background` (rows,) is a rate in 1/ns.
    """

    total: Float[np.ndarray, "rows edges"]
    background: Float[np.ndarray, " rows"]
    first: float
    step: float

    def until(self, row: np.ndarray, time: np.ndarray) -> np.ndarray:
        """The integral of the signal's rate up to a time."""
        samples = self.total.shape[1] - 1
        place = np.clip((time - self.first) / self.step, 0.0, samples)
        k = np.minimum(place.astype(int), samples - 1)
        low = self.total[row, k]
        return low + (place - k) * (self.total[row, k + 1] - low)

    def reaches(self, row: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The time at which the integral reaches a number; infinite where it never does."""
        time = np.full(goal.shape, np.inf)
        (ever,) = np.nonzero(goal < self.total[row, -1])
        row, goal = row[ever], goal[ever]
        # The sample by bisection in each row: low is always reached, high never.
        low, high = np.zeros(row.size, int), np.full(row.size, self.total.shape[1] - 1)
        for _ in range(self.total.shape[1].bit_length()):
            middle = (low + high) // 2
            below = self.total[row, middle] <= goal
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        start = self.total[row, low]
        time[ever] = self.first + self.step * (low + (goal - start) / (self.total[row, low + 1] - start))
        return time


def count_photons(wave: Any, counter: Any, key: Array | None, pulses: int) -> PhotonEvents:
    """The events of `jaxlidar.record(wave, mode="photons")`."""
    check_kind("receiver", counter, PhotonCounter, "a PhotonCounter where mode = 'photons'")
    pulses = check_integer("pulses", pulses)
    check_key(key)
    assert key is not None
    time, wavelength = _known("time", wave), _known("wavelength", wave)
    if time.size < 2:
        raise ValueError("wave has one sample; admissible are two or more, which tell how long they are")
    probability = _per_wavelength("detection_probability", counter.detection_probability, wavelength)
    rate = 1e-9 * _per_wavelength("background_rate", counter.background_rate, wavelength)
    step = float(time[-1] - time[0]) / (time.size - 1)
    first = float(time[0]) - 0.5 * step
    window = concrete(counter.window)
    start, end = (first, first + step * time.size) if window is None else map(float, window)
    per_joule = probability * wavelength / PLANCK_TIMES_LIGHT / counter.pixels

    random = np.random.default_rng(np.asarray(jax.random.bits(key, (8,), jnp.uint32)))
    fall, energies = _fall(wave, time), wave.energy if wave.energy.ndim == 3 else wave.energy[None]
    rows = counter.pixels * pulses
    events, lost = [], []
    for shots in _blocks(len(energies), rows * wavelength.size):
        mean = (_admissible(energies[shots]) * per_joule[:, None]).reshape(-1, time.size)
        total = np.concatenate([np.zeros((len(mean), 1)), np.cumsum(mean, axis=1)], axis=1)
        light = _Light(total, np.tile(rate / counter.pixels, shots.stop - shots.start), first, step)
        _check_amount(light, start, end, float(counter.dead_time), rows)
        channel, *found, missed = _events(light, start, end, float(counter.dead_time), rows, random)
        events.append((channel + shots.start * wavelength.size * rows, *found))
        lost.append(missed.reshape(-1, wavelength.size))

    channel, instant, signal = (np.concatenate(parts) for parts in zip(*events))
    instant = instant + float(counter.jitter) * random.standard_normal(instant.size)
    order = np.lexsort((instant, (channel // counter.pixels) % pulses, channel // (rows * wavelength.size)))
    channel, instant, signal = channel[order], instant[order], signal[order]
    row = channel // rows
    shot = row // wavelength.size
    return PhotonEvents(
        time=instant,
        height=fall[shot] * instant,
        shot=shot,
        pulse=(channel // counter.pixels) % pulses,
        pixel=channel % counter.pixels,
        wavelength=wavelength[row % wavelength.size],
        signal=signal,
        lost=np.concatenate(lost),
        window=np.sort(fall[:, None] * np.array([start, end]), axis=1),
        pulses=pulses,
    )


def _events(
    light: _Light, start: float, end: float, dead_time: float, channels: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixel, time and origin of all events, and how much each row lost; `channels` pixels belong to a row.

    In every round, each pixel that still sees has its next event, of signal or background, or none.
    """
    found, lost = [], np.zeros(len(light.total))
    channel = np.arange(len(light.total) * channels)
    sees = np.full(channel.size, start)
    while True:
        row = channel // channels
        wait = random.standard_exponential(channel.size)
        signal = np.maximum(light.reaches(row, light.until(row, sees) + wait), sees)
        with np.errstate(divide="ignore"):
            background = sees + random.standard_exponential(channel.size) / light.background[row]
        time = np.minimum(signal, background)
        some = time < end
        channel, row, time = channel[some], row[some], time[some]
        found.append((channel, time, (signal <= background)[some]))
        if channel.size == 0:
            channel, time, origin = (np.concatenate(parts) for parts in zip(*found))
            return channel, time, origin, lost.astype(np.int64)
        sees = time + dead_time
        blind = np.minimum(sees, end)
        mean = light.until(row, blind) - light.until(row, time) + light.background[row] * (blind - time)
        lost += np.bincount(row, _poisson(np.maximum(mean, 0.0), random), len(lost))


def _poisson(mean: np.ndarray, random: np.random.Generator) -> np.ndarray:
    many = mean > _POISSON_MAX
    counts = random.poisson(np.where(many, 0.0, mean)).astype(float)
    counts[many] = np.rint(mean[many] + np.sqrt(mean[many]) * random.standard_normal(int(many.sum())))
    return counts


def _check_amount(light: _Light, start: float, end: float, dead_time: float, channels: int) -> None:
    """Refuse more light than can be counted."""
    arrivals = light.total[:, -1] + light.background * (end - start)
    most = (end - start) / dead_time + 1.0 if dead_time > 0 else np.inf
    for what, count, limit in (
        ("photons", arrivals, _MOST_ARRIVALS),
        ("events", np.minimum(arrivals, most), _MOST_EVENTS),
    ):
        if (total := channels * float(np.sum(count))) > limit:
            raise ValueError(f"energy and background give {total:g} {what}; admissible are up to {limit:g}")


def _admissible(energy: Any) -> np.ndarray:
    """Energies, zero where noise made them negative."""
    energy = np.asarray(energy, float)
    check_range("energy", energy)
    sent = np.maximum(energy, 0.0)
    if np.any(np.sum(sent - energy, axis=-1) > _BELOW_ZERO * np.sum(sent, axis=-1)):
        raise ValueError(
            f"energy = {energy.min():g} is too far below zero; admissible are samples that all together "
            f"take up to {_BELOW_ZERO:.0%} from their waveform"
        )
    return sent


def _blocks(shots: int, channels: int) -> Iterator[slice]:
    size = max(1, _BLOCK // channels)
    return (slice(i, min(i + size, shots)) for i in range(0, shots, size))


def _known(field: str, wave: Any) -> np.ndarray:
    """A field of a waveform. **Raises:** TypeError for what is no waveform, or is being traced."""
    if not hasattr(wave, "energy") or (value := concrete(getattr(wave, field, None))) is None:
        raise TypeError(
            f"wave is {kind_of(wave)}; admissible where mode = 'photons' is a Waveform or Waveforms, outside "
            "of JAX transformations"
        )
    return value


def _per_wavelength(field: str, x: Array, wavelength: np.ndarray) -> np.ndarray:
    if x.shape not in ((), (1,), wavelength.shape):
        raise ValueError(
            f"{field} has shape {x.shape}; admissible is one number, or one for each of the "
            f"{wavelength.size} wavelengths of the waveform"
        )
    return np.broadcast_to(np.asarray(x, float), wavelength.shape)


def _fall(wave: Any, time: np.ndarray) -> np.ndarray:
    """Metres of height per ns, (shots,). `Waveforms` have directions, a `Waveform` has heights."""
    if hasattr(wave, "zenith"):
        return -0.5 * SPEED_OF_LIGHT * np.cos(np.deg2rad(np.asarray(wave.zenith, float)))
    far = np.argmax(np.abs(time))
    return np.asarray(wave.height, float)[far : far + 1] / time[far]
