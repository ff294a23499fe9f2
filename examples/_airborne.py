"""Airborne records of any format as one kind: read by suffix, each with its pulse, amplitudes and noise."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

import inversion
import jaxlidar as jl
from inversion.receiver.digitiser import Amplitudes
from jaxlidar.io import AirborneShot, Segment, read_las_waveforms, read_neon, read_pulsewaves
from jaxlidar.io.pedestal import above_pedestal

SUFFIXES = {".npz": read_neon, ".pls": read_pulsewaves, ".las": read_las_waveforms}
# Of the first segment, the part that precedes the return, and its fewest samples; fewest of a pulse.
QUIET, FEWEST_QUIET, QUIET_PULSE = 7, 8, 5
# Hard targets that a receiver's response is estimated from: fewest, most, and of how many shots.
TARGETS, AMONG = (10, 60), 1000
# Errors of pulses, over their peaks, where echoes are told apart.
PULSE_ERROR = 0.02
# Full width at half maximum of a Gaussian over its standard deviation.
FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


@dataclasses.dataclass(frozen=True)
class Instrument:
    """How an instrument records, and over what it flies. Options of the command line replace single values.

    - `altitude`: m. `divergence`: full angle at 1/e^2, mrad. `jitter`: what echoes are blurred by beside
      their pulse, ns.
    - `count_noise`: standard deviation of counts. Default None: of what precedes the file's returns.
    - `saturation`: counts from which on samples have no weight. Default None: the last of the file's table.
    - `interleaved`: digitisers that take samples in turn, each with its own pedestal.
    - `correlated`: so many neighbouring samples, whose noise is correlated, tell as much as one.
    - `correlation`: of the noise of neighbouring samples, told to the fit, where `correlated` is 1.
    - `model_error`: of the model, over the largest sample: pulses are records, and canopies not uniform.
    - `pulse_noise`: whether the noise of recorded pulses is told apart from that of returns.
    - `response`: lags, in samples, before and after time zero of the receiver's response, which is estimated
      from the file's hard targets. Default None: none.
    - `above`, `below`: m about the last echo that are fitted. `tallest`: of canopies, m. `clearance`: of the
      lowest plants from the ground, m.
    - `fewest`: echoes that tell ground from canopy.
    """

    altitude: float = 1000.0
    divergence: float = 0.5
    jitter: float = 0.0
    count_noise: float | None = None
    saturation: float | None = None
    interleaved: int = 1
    correlated: int = 1
    correlation: float = 0.0
    model_error: float = 0.01
    pulse_noise: bool = True
    response: tuple[int, int] | None = None
    above: float = 30.0
    below: float = 5.0
    tallest: float = 30.0
    clearance: float = 1.0
    fewest: int = 2

    @property
    def footprint(self) -> float:
        """Diameter on the ground, m."""
        return 1e-3 * self.altitude * self.divergence


# NEON's pulse is 15 ns (2.3 m) long: two echoes cannot tell ground from canopy. Its jitter is what a hard
# target's echo is blurred by. LVIS has two digitisers, and footprints of 20 m, in which slopes show. RIEGL's
# counts are rounded, and its receiver rings.
INSTRUMENTS = {
    "neon": Instrument(divergence=0.8, jitter=1.9, correlated=5, pulse_noise=False, above=25.5, below=7.5,
                       clearance=3.0, fewest=3),
    "riegl": Instrument(altitude=550.0, count_noise=0.9, correlation=0.6, response=(4, 40), below=8.0),
    "lvis": Instrument(altitude=8000.0, divergence=2.5, saturation=215.0, interleaved=2, pulse_noise=False,
                       above=54.0, below=12.0, tallest=48.0),
    "other": Instrument(),
}  # fmt: skip


class Record(NamedTuple):
    """A shot as it is fitted: amplitudes above the pedestals, in the samples of its clock.

    - `shot`: of the channel that was taken.
    - `signal`, `noise`: (samples,) over the largest sample; noise is infinite where nothing was recorded and
      where samples are saturated. `quiet`: noise without a signal. `peak`: the largest sample.
    - `lidar`: with the shot's pulse and direction. `pulse_noise`: of the pulse, over its peak.
    - `saturated`: number of samples without weight.
    """

    shot: AirborneShot
    signal: np.ndarray
    noise: np.ndarray
    quiet: float
    peak: float
    lidar: jl.Lidar
    pulse_noise: float
    saturated: int

    @property
    def elevation(self) -> np.ndarray:
        """Of the samples, m."""
        return self.shot.elevation * self.shot.metres[2]

    def pulse(self, lags: int, impulse: np.ndarray | None = None) -> np.ndarray:
        """(2 lags + 1,) what a hard target returns, with time zero in the middle, of peak one."""
        edges = self.shot.sampling_interval * (np.arange(-lags, lags + 2) - 0.5)
        shares = np.diff(np.asarray(_cumulative(self.lidar, edges), float))
        received = shares if impulse is None else np.convolve(shares, impulse, "same")
        return received / received.max()


@eqx.filter_jit
def _cumulative(lidar: jl.Lidar, time: np.ndarray) -> jax.Array:
    """Energy of the pulse up to times, blurred by the jitter."""
    return lidar.pulse.cumulative(time, lidar.jitter)


class Flight(NamedTuple):
    """The shots of a file, amplitudes by table, what recorded them, and the Gaussian pulse sent, if any."""

    shots: Sequence[AirborneShot]
    tables: dict[int, np.ndarray]
    instrument: Instrument
    pulse: tuple[np.ndarray, np.ndarray] | None = None

    def __getitem__(self, index: int) -> AirborneShot:
        return self.shots[index]


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that say what recorded a file, and what was sent."""
    sent = parser.add_mutually_exclusive_group()
    sent.add_argument("--pulse", type=Path, help="outgoing pulse: a table of two columns, time in ns, power")
    sent.add_argument("--pulses", type=Path, help="outgoing pulses of the same shots (.pls), by GPS time")
    sent.add_argument("--pulse-width", type=float, help="Gaussian pulse: full width at half maximum, ns")
    parser.add_argument("--instrument", choices=list(INSTRUMENTS), help="default: as the file says")
    settings = parser.add_argument_group("settings of the instrument; defaults are its own")
    for name in (
        "altitude",
        "divergence",
        "jitter",
        "count_noise",
        "saturation",
        "correlation",
        "model_error",
        "tallest",
    ):
        settings.add_argument(f"--{name.replace('_', '-')}", type=float)
    for name in ("interleaved", "correlated", "fewest"):
        settings.add_argument(f"--{name}", type=int)


def read_flight(path: Path, given: argparse.Namespace) -> Flight:
    """The shots of a file of any format that `SUFFIXES` has.

    **Raises:** ValueError, naming the file, for another suffix, for shots without an outgoing pulse where
    none is given, and for those that have their own where one is given; and as the readers do.
    """
    read = SUFFIXES.get(path.suffix.lower())
    if read is None:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; admissible are {', '.join(SUFFIXES)}")
    found = read(path)
    shots, tables = (found.shots, {}) if read is read_neon else (found, found.tables)
    flight = Flight(shots, tables, instrument_of(shots[0], given, neon=read is read_neon))
    ways = {"--pulse": given.pulse, "--pulses": given.pulses, "--pulse-width": given.pulse_width}
    used = next((name for name, value in ways.items() if value is not None), None)
    if shots[0].outgoing:
        if used:
            raise ValueError(f"{path}: shots have their own outgoing pulses; {used} is for files without")
        return flight
    if used is None:
        raise ValueError(f"{path}: shots have no outgoing pulse; give one with {', '.join(ways)}")
    if given.pulses is not None:
        flight = with_pulses_of(flight, given.pulses)
        return flight._replace(instrument=instrument_of(flight[0], given))
    return flight._replace(pulse=gaussian(given.pulse_width) if given.pulse is None else table(given.pulse))


def instrument_of(shot: AirborneShot, given: argparse.Namespace, neon: bool = False) -> Instrument:
    """The settings for a shot's scanner, with those of the command line."""
    name = "neon" if neon else given.instrument
    if given.instrument is not None:
        name = given.instrument
    elif not neon:
        said = "" if shot.scanner is None else shot.scanner.instrument
        name = "lvis" if "LVIS" in said else "riegl" if said.startswith(("Q", "VQ", "LMS")) else "other"
    changes = {f.name: getattr(given, f.name, None) for f in dataclasses.fields(Instrument)}
    return dataclasses.replace(INSTRUMENTS[name], **{k: v for k, v in changes.items() if v is not None})


def gaussian(width: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and power of a Gaussian pulse of that full width at half maximum, ns."""
    if not (np.isfinite(width) and width > 0):
        raise ValueError(f"--pulse-width = {width:g}; admissible is (0, inf) ns")
    sigma = width / FWHM
    time = sigma * np.linspace(-5.0, 5.0, 101)
    return time, np.exp(-0.5 * (time / sigma) ** 2)


def table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times and power of a pulse in a text file. **Raises:** ValueError naming it."""
    try:
        rows = np.loadtxt(path, ndmin=2, delimiter="," if "," in path.read_text() else None)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise ValueError(f"{rows.shape[-1]} columns; admissible are two, time in ns and power")
        jl.SampledPulse(*rows.T)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return rows[:, 0], rows[:, 1]


def with_pulses_of(flight: Flight, path: Path) -> Flight:
    """The shots with outgoing pulses, and tables of the same samples, of a PulseWaves file."""
    others = read_pulsewaves(path)
    by_time = {round(1e6 * time): number for number, time in enumerate(others.gps_time)}
    found = []
    for shot in flight.shots:
        number = by_time.get(round(1e6 * (shot.gps_time or 0.0)))
        if number is None:
            found.append(shot)
            continue
        other = others[number]
        own = tuple(_with_table(segment, other.returning) for segment in shot.returning)
        changes = {"outgoing": other.outgoing, "pulse_zero": other.pulse_zero, "scanner": other.scanner}
        found.append(dataclasses.replace(shot, returning=own, pedestal=other.pedestal, **changes))
    if not any(shot.outgoing for shot in found):
        raise ValueError(f"{path}: it has no pulse at the GPS times of {flight[0].index} and later shots")
    return flight._replace(shots=found, tables=others.tables)


def _with_table(segment: Segment, others: Sequence[Segment]) -> Segment:
    same = (o.table for o in others if np.array_equal(o.samples, segment.samples))
    return segment._replace(table=next(same, segment.table))


def records_of(shots: Sequence[AirborneShot], flight: Flight) -> list[Record | ValueError]:
    """Shots as they are fitted, or why a shot cannot be."""
    lags = max((s.outgoing[0].samples.size for s in shots if s.outgoing), default=0)
    found: list[Record | ValueError] = []
    for shot in shots:
        try:
            found.append(record_of(shot, flight, lags))
        except ValueError as error:
            found.append(error)
    return found


def record_of(shot: AirborneShot, flight: Flight, lags: int) -> Record:
    """A shot as it is fitted; its pulse has so many samples.

    **Raises:** ValueError where it has no pulse, or no sample above the pedestal that has weight.
    """
    own = flight.instrument
    channels = list(dict.fromkeys(segment.channel for segment in shot.returning))
    clear = [c for c in channels if not _saturated(shot.of_channel(c), flight)]
    shot = shot.of_channel((clear or channels)[0])
    counts = own.count_noise or max(shot.noise_std, 0.5)
    segments = sorted(
        (s for s in shot.returning if s.channel == shot.returning[0].channel), key=lambda s: s.start
    )
    parts = [_amplitudes(segment, flight, counts) for segment in segments]
    signal, noise = np.zeros(shot.recorded.size), np.full(shot.recorded.size, np.inf)
    signal[shot.recorded] = np.concatenate([part.values for part in parts])
    noise[shot.recorded] = np.concatenate([part.noise for part in parts])
    quiet = max(FEWEST_QUIET * own.interleaved, parts[0].values.size // QUIET)
    signal -= _pedestals(parts[0].values[:quiet], own.interleaved, signal.size)
    used = np.isfinite(noise)
    peak = float(np.max(signal, initial=0.0, where=used))
    if not peak > 0:
        raise ValueError("no sample above the pedestal has weight")
    pulse, pulse_noise = _pulse(shot, flight, counts, lags)
    lidar = jl.Lidar(
        altitude=own.altitude,
        divergence=own.divergence,
        jitter=own.jitter,
        zenith=shot.zenith,
        azimuth=shot.azimuth,
        sampling_interval=shot.sampling_interval,
        pulse=pulse,
    )
    return Record(
        shot,
        np.where(used, signal / peak, 0.0),
        np.sqrt(own.correlated) * np.hypot(noise / peak, own.model_error),
        float(np.min(noise)) / peak,
        peak,
        lidar,
        pulse_noise,
        _saturated(shot, flight),
    )


def _saturation(segment: Segment, flight: Flight) -> float:
    known, most = flight.tables.get(segment.table), flight.instrument.saturation
    return min(np.inf if known is None else known.size - 1, np.inf if most is None else most)


def _saturated(shot: AirborneShot, flight: Flight) -> int:
    own = (s for s in shot.returning if s.channel == shot.returning[0].channel)
    return int(sum(np.sum(s.samples >= _saturation(s, flight)) for s in own))


def _amplitudes(segment: Segment, flight: Flight, noise: float) -> Amplitudes:
    """Of a segment's samples: by its table, or their values."""
    known, most = flight.tables.get(segment.table), _saturation(segment, flight)
    if known is None:
        return Amplitudes(segment.values, np.where(segment.samples >= most, np.inf, noise * segment.gain))
    # Those of RIEGL are in decibels, and mark counts without an amplitude.
    decibels = bool(known[0] < -1000.0)
    return inversion.amplitudes(segment.samples, known, noise=noise, decibels=decibels, saturation=most)


def _pedestals(quiet: np.ndarray, interleaved: int, size: int) -> np.ndarray:
    """Of each sample, from the mean of what its digitiser recorded first."""
    return np.resize([np.mean(quiet[i::interleaved]) for i in range(interleaved)], size)


def _pulse(shot: AirborneShot, flight: Flight, noise: float, lags: int) -> tuple[jl.SampledPulse, float]:
    """The outgoing pulse, and its noise over its peak."""
    if flight.pulse is not None:
        return jl.SampledPulse(*flight.pulse), 0.0
    if not shot.outgoing:
        raise ValueError("no outgoing pulse was recorded")
    segment, own = shot.outgoing[0], flight.instrument
    values, spread = _amplitudes(segment, flight, noise)
    if not np.all(np.isfinite(spread)):
        raise ValueError("the outgoing pulse is saturated")
    pedestals = _pedestals(values[: QUIET_PULSE * own.interleaved], own.interleaved, values.size)
    power = above_pedestal(values - pedestals, 0.0, "outgoing")
    zero = segment.time[np.argmax(power)] if shot.pulse_zero is None else shot.pulse_zero
    time = segment.start - zero + segment.step * np.arange(lags)
    pulse = inversion.recorded_pulse(time, np.pad(power, (0, lags - power.size)))
    lit = power > 0.2 * power.max()
    return pulse, float(np.median(spread[lit]) / power.max()) if own.pulse_noise else 0.0


def response_of(flight: Flight) -> np.ndarray | None:
    """The receiver's response, from the narrowest single echoes among the stronger half of a file's shots.

    None where the instrument asks for none, or there are too few such echoes.
    """
    if flight.instrument.response is None:
        return None
    shots = [s for s in flight.shots[:: -(-len(flight.shots) // AMONG)] if len(s.returning) == 1]
    records = [r for r in records_of(shots, flight) if isinstance(r, Record) and not r.saturated]
    if len(records) < 2 * TARGETS[0]:
        return None
    strong = np.median([record.peak for record in records])
    records = [record for record in records if record.peak >= strong]
    lags = max(r.shot.outgoing[0].samples.size if r.shot.outgoing else r.signal.size for r in records)
    pulses = [record.pulse(lags) for record in records]
    length = [record.signal.sum() / pulse.sum() for record, pulse in zip(records, pulses)]
    chosen = np.argsort(length)[: TARGETS[1]]
    before, after = flight.instrument.response
    size = max(records[i].signal.size for i in chosen)
    return inversion.receiver_impulse(
        [pulses[i] for i in chosen],
        [np.pad(records[i].signal, (0, size - records[i].signal.size)) for i in chosen],
        noise=[
            np.pad(records[i].noise, (0, size - records[i].noise.size), constant_values=np.inf)
            for i in chosen
        ],
        before=before,
        after=after,
        interleaved=flight.instrument.interleaved,
    )


def echoes_of(records: Sequence[Record], impulse: np.ndarray | None) -> list[np.ndarray]:
    """Elevations of the echoes of every record, from above, m: of copies of its pulse."""
    size, step = max(record.signal.size for record in records), records[0].shot.sampling_interval
    signal, noise = np.zeros((len(records), size)), np.full((len(records), size), np.inf)
    for i, record in enumerate(records):
        signal[i, : record.signal.size], noise[i, : record.signal.size] = record.signal, record.noise
    reach = max(abs(end) for r in records for end in r.lidar.pulse.support(r.lidar.jitter)) / step
    lags = int(np.ceil(reach)) + (0 if impulse is None else impulse.size // 2)
    pulses = np.stack([record.pulse(lags, impulse) for record in records])
    found = inversion.gaussian_decomposition(
        step * np.arange(size), signal, noise=noise, pulse=pulses, pulse_error=PULSE_ERROR
    )
    count, times = np.asarray(found.count), np.asarray(found.time, float)
    numbers = [np.arange(record.signal.size) for record in records]
    return [
        np.interp(time[:n] / step, number, record.elevation)
        for time, n, number, record in zip(times, count, numbers, records)
    ]
