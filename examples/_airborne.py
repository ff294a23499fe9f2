"""Airborne records of any format in one form: read by suffix, each with its pulse, amplitudes and noise."""

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
from jaxlidar.io.noise import above_pedestal

# Readers by the suffix of a file.
SUFFIXES = {".npz": read_neon, ".pls": read_pulsewaves, ".las": read_las_waveforms}
# Samples before the return, from which pedestals are taken: this divisor gives their number in the first
# segment; the fewest of them; and their number before a pulse.
QUIET_DIVISOR, FEWEST_QUIET, QUIET_PULSE = 7, 8, 5
# Hard targets that a receiver's response is estimated from: fewest and most, and shots that are searched.
FEWEST_TARGETS, MOST_TARGETS, SEARCHED_SHOTS = 10, 60, 1000
# Errors of pulses, over their peaks, in the decomposition into echoes.
PULSE_ERROR = 0.02
# RIEGL's tables are in decibels, and mark counts without an amplitude by entries below this.
NO_AMPLITUDE = -1000.0
# Full width at half maximum of a Gaussian over its standard deviation.
FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


@dataclasses.dataclass(frozen=True)
class Instrument:
    """Settings of an instrument and of its targets. Options of the command line replace single values.

    - `altitude`: m. `divergence`: full angle at 1/e^2, mrad. `jitter`: standard deviation in ns of the
      blurring of echoes beside that of their pulse.
    - `count_noise`: standard deviation of counts. Default None: that of the samples before the return.
    - `saturation`: counts from which on samples have no weight. Default None: the last of the file's table.
    - `interleaved`: digitisers that take samples in turn, each with its own pedestal.
    - `correlated`: number of neighbouring samples, of correlated noise, with the information of one.
    - `correlation`: of the noise of neighbouring samples in the model of the fit, if `correlated` is 1.
    - `model_error`: of the model, over the largest sample: pulses are records, and canopies not uniform.
    - `pulse_noise`: True if the fit models the noise of recorded pulses.
    - `response`: lags, in samples, before and after time zero of the receiver's response, which is estimated
      from the file's hard targets. Default None: no response.
    - `above`, `below`: range of the fit above and below the last echo, m. `tallest`: height of the tallest
      canopies, m. `clearance`: height of the lowest plants above the ground, m.
    - `fewest`: fewest echoes that separate ground from canopy.
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


# NEON's pulse is 15 ns (2.3 m) long: two echoes cannot separate ground from canopy. Its jitter is that
# of a hard target's echo. LVIS has two digitisers, and footprints of 20 m, which slopes broaden. RIEGL's
# counts are rounded, and its receiver rings.
INSTRUMENTS = {
    "neon": Instrument(divergence=0.8, jitter=1.9, correlated=5, pulse_noise=False, above=25.5, below=7.5,
                       clearance=3.0, fewest=3),
    "riegl": Instrument(altitude=550.0, count_noise=0.9, correlation=0.6, response=(4, 40), below=8.0),
    "lvis": Instrument(altitude=8000.0, divergence=2.5, saturation=215.0, interleaved=2, pulse_noise=False,
                       above=54.0, below=12.0, tallest=48.0),
    "other": Instrument(),
}  # fmt: skip


class AirborneRecord(NamedTuple):
    """A shot in the form that is fitted: amplitudes above the pedestals, in the samples of its clock.

    - `shot`: with the segments of one channel.
    - `signal`, `noise`: (samples,) over the largest sample; noise is infinite for samples that were not
      recorded or are saturated. `quiet`: noise without a signal. `peak`: the largest sample.
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
        """Elevation of the samples, m."""
        return self.shot.elevation * self.shot.metres[2]

    def pulse(self, lags: int, impulse: np.ndarray | None = None) -> np.ndarray:
        """(2 lags + 1,) echo of a hard target, with time zero in the middle, of peak one."""
        edges = self.shot.sampling_interval * (np.arange(-lags, lags + 2) - 0.5)
        fractions = np.diff(np.asarray(_cumulative(self.lidar, edges), float))
        received = fractions if impulse is None else np.convolve(fractions, impulse, "same")
        return received / received.max()


@eqx.filter_jit
def _cumulative(lidar: jl.Lidar, time: np.ndarray) -> jax.Array:
    """Energy of the pulse up to times, blurred by the jitter."""
    return lidar.pulse.cumulative(time, lidar.jitter)


class FlightLine(NamedTuple):
    """The shots of a file and their instrument.

    - `tables`: amplitudes of counts, by the number of the table.
    - `pulse`: time and power of the outgoing pulse of all shots, for files that have none.
    """

    shots: Sequence[AirborneShot]
    tables: dict[int, np.ndarray]
    instrument: Instrument
    pulse: tuple[np.ndarray, np.ndarray] | None = None

    def __getitem__(self, index: int) -> AirborneShot:
        return self.shots[index]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the instrument and of the outgoing pulse."""
    pulse_options = parser.add_mutually_exclusive_group()
    pulse_options.add_argument(
        "--pulse", type=Path, help="outgoing pulse: a table of two columns, time in ns, power"
    )
    pulse_options.add_argument(
        "--pulses", type=Path, help="outgoing pulses of the same shots (.pls), by GPS time"
    )
    pulse_options.add_argument(
        "--pulse-width", type=float, help="Gaussian pulse: full width at half maximum, ns"
    )
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


def read_flight(path: Path, options: argparse.Namespace) -> FlightLine:
    """Read the shots of a file of any format in `SUFFIXES`.

    **Raises:** ValueError, naming the file, for another suffix, for shots without an outgoing pulse if the
    options have none, for shots with one if the options have one, and as the readers do.
    """
    read = SUFFIXES.get(path.suffix.lower())
    if read is None:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; admissible are {', '.join(SUFFIXES)}")
    is_neon = read is read_neon
    content = read(path)
    # NEON's amplitudes are linear in counts: its files have no tables.
    shots, tables = (content.shots, {}) if is_neon else (content, content.tables)
    flight = FlightLine(shots, tables, instrument_of(shots[0], options, neon=is_neon))
    pulse_options = {
        "--pulse": options.pulse,
        "--pulses": options.pulses,
        "--pulse-width": options.pulse_width,
    }
    used = next((name for name, value in pulse_options.items() if value is not None), None)
    if shots[0].outgoing:
        if used:
            raise ValueError(f"{path}: shots have their own outgoing pulses; {used} is for files without")
        return flight
    if used is None:
        raise ValueError(f"{path}: shots have no outgoing pulse; give one with {', '.join(pulse_options)}")
    if options.pulses is not None:
        flight = with_pulses_of(flight, options.pulses)
        # The PulseWaves file names the scanner, which LAS does not.
        return flight._replace(instrument=instrument_of(flight[0], options))
    pulse = gaussian_pulse(options.pulse_width) if options.pulse is None else read_pulse_table(options.pulse)
    return flight._replace(pulse=pulse)


def instrument_of(shot: AirborneShot, options: argparse.Namespace, neon: bool = False) -> Instrument:
    """Settings of a shot's scanner, with single values from the command line."""
    name = "neon" if neon else options.instrument
    if options.instrument is not None:
        name = options.instrument
    elif not neon:
        # PulseWaves names scanners by model, such as RIEGL's Q680i, VQ-480 and LMS-Q780.
        model = "" if shot.scanner is None else shot.scanner.instrument
        name = "lvis" if "LVIS" in model else "riegl" if model.startswith(("Q", "VQ", "LMS")) else "other"
    changes = {f.name: getattr(options, f.name, None) for f in dataclasses.fields(Instrument)}
    return dataclasses.replace(INSTRUMENTS[name], **{k: v for k, v in changes.items() if v is not None})


def gaussian_pulse(width: float) -> tuple[np.ndarray, np.ndarray]:
    """Time, ns, and power of a Gaussian pulse of a full width at half maximum, ns."""
    if not (np.isfinite(width) and width > 0):
        raise ValueError(f"--pulse-width = {width:g}; admissible is (0, inf) ns")
    sigma = width / FWHM
    time = sigma * np.linspace(-5.0, 5.0, 101)
    return time, np.exp(-0.5 * (time / sigma) ** 2)


def read_pulse_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read time, ns, and power of a pulse from a text file. **Raises:** ValueError naming the file."""
    try:
        rows = np.loadtxt(path, ndmin=2, delimiter="," if "," in path.read_text() else None)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise ValueError(f"{rows.shape[-1]} columns; admissible are two, time in ns and power")
        # Its checks are those of a pulse.
        jl.SampledPulse(*rows.T)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return rows[:, 0], rows[:, 1]


def with_pulses_of(flight: FlightLine, path: Path) -> FlightLine:
    """Add the outgoing pulses of the same shots, and the tables of the same samples, of a PulseWaves file."""
    pulses = read_pulsewaves(path)
    # Shots are the same if their GPS times agree to a microsecond.
    number_by_time = {round(1e6 * time): number for number, time in enumerate(pulses.gps_time)}
    shots = []
    for shot in flight.shots:
        number = number_by_time.get(round(1e6 * (shot.gps_time or 0.0)))
        if number is not None:
            pulse = pulses[number]
            shot = dataclasses.replace(
                shot,
                returning=tuple(_with_table(segment, pulse.returning) for segment in shot.returning),
                pedestal=pulse.pedestal,
                outgoing=pulse.outgoing,
                pulse_zero=pulse.pulse_zero,
                scanner=pulse.scanner,
            )
        shots.append(shot)
    if not any(shot.outgoing for shot in shots):
        raise ValueError(f"{path}: it has no pulse at the GPS times of {flight[0].index} and later shots")
    return flight._replace(shots=shots, tables=pulses.tables)


def _with_table(segment: Segment, candidates: Sequence[Segment]) -> Segment:
    """Segment with the table of the candidate that has the same samples."""
    tables = (c.table for c in candidates if np.array_equal(c.samples, segment.samples))
    return segment._replace(table=next(tables, segment.table))


def records_of(shots: Sequence[AirborneShot], flight: FlightLine) -> list[AirborneRecord | ValueError]:
    """Records of shots, or the error of a shot that cannot be fitted."""
    # Pulses of one length: fits with pulses of different shapes would compile separately.
    lags = max((s.outgoing[0].samples.size for s in shots if s.outgoing), default=0)
    records: list[AirborneRecord | ValueError] = []
    for shot in shots:
        try:
            records.append(record_of(shot, flight, lags))
        except ValueError as error:
            records.append(error)
    return records


def record_of(shot: AirborneShot, flight: FlightLine, lags: int) -> AirborneRecord:
    """Record of a shot, with a pulse of `lags` samples.

    1. Take the first channel without saturated samples, or else the first.
    2. Convert counts to amplitudes, and subtract the pedestals of the digitisers.
    3. Divide by the largest sample, and add the error of the model to the noise.

    **Raises:** ValueError for a shot without a pulse, or without a sample above the pedestal that has weight.
    """
    instrument = flight.instrument
    channels = list(dict.fromkeys(segment.channel for segment in shot.returning))
    unsaturated = [c for c in channels if not _count_saturated(shot.of_channel(c), flight)]
    shot = shot.of_channel((unsaturated or channels)[0])
    # Rounding to whole counts alone has a standard deviation of 0.3.
    count_noise = instrument.count_noise or max(shot.noise_std, 0.5)
    segments = sorted(
        (s for s in shot.returning if s.channel == shot.returning[0].channel), key=lambda s: s.start
    )
    amplitudes = [_amplitudes(segment, flight, count_noise) for segment in segments]
    signal, noise = np.zeros(shot.recorded.size), np.full(shot.recorded.size, np.inf)
    signal[shot.recorded] = np.concatenate([a.values for a in amplitudes])
    noise[shot.recorded] = np.concatenate([a.noise for a in amplitudes])
    first_values = amplitudes[0].values
    n_quiet = max(FEWEST_QUIET * instrument.interleaved, first_values.size // QUIET_DIVISOR)
    signal -= _pedestals(first_values[:n_quiet], instrument.interleaved, signal.size)
    is_used = np.isfinite(noise)
    peak = float(np.max(signal, initial=0.0, where=is_used))
    if not peak > 0:
        raise ValueError("no sample above the pedestal has weight")
    pulse, pulse_noise = _pulse(shot, flight, count_noise, lags)
    lidar = jl.Lidar(
        altitude=instrument.altitude,
        divergence=instrument.divergence,
        jitter=instrument.jitter,
        zenith=shot.zenith,
        azimuth=shot.azimuth,
        sampling_interval=shot.sampling_interval,
        pulse=pulse,
    )
    return AirborneRecord(
        shot=shot,
        signal=np.where(is_used, signal / peak, 0.0),
        noise=np.sqrt(instrument.correlated) * np.hypot(noise / peak, instrument.model_error),
        quiet=float(np.min(noise)) / peak,
        peak=peak,
        lidar=lidar,
        pulse_noise=pulse_noise,
        saturated=_count_saturated(shot, flight),
    )


def _saturation(segment: Segment, flight: FlightLine) -> float:
    """Counts from which on samples of a segment are saturated."""
    table, limit = flight.tables.get(segment.table), flight.instrument.saturation
    return min(np.inf if table is None else table.size - 1, np.inf if limit is None else limit)


def _count_saturated(shot: AirborneShot, flight: FlightLine) -> int:
    """Number of saturated samples in the first channel of a shot."""
    segments = (s for s in shot.returning if s.channel == shot.returning[0].channel)
    return int(sum(np.sum(s.samples >= _saturation(s, flight)) for s in segments))


def _amplitudes(segment: Segment, flight: FlightLine, noise: float) -> Amplitudes:
    """Amplitudes of a segment's samples, by its table or, without one, its gain."""
    table, limit = flight.tables.get(segment.table), _saturation(segment, flight)
    if table is None:
        return Amplitudes(segment.values, np.where(segment.samples >= limit, np.inf, noise * segment.gain))
    decibels = bool(table[0] < NO_AMPLITUDE)
    return inversion.amplitudes(segment.samples, table, noise=noise, decibels=decibels, saturation=limit)


def _pedestals(quiet: np.ndarray, interleaved: int, size: int) -> np.ndarray:
    """Pedestal of each sample: the mean of the first samples of its digitiser."""
    return np.resize([np.mean(quiet[i::interleaved]) for i in range(interleaved)], size)


def _pulse(shot: AirborneShot, flight: FlightLine, noise: float, lags: int) -> tuple[jl.SampledPulse, float]:
    """Outgoing pulse of a shot, and its noise over its peak; `noise` is that of counts."""
    if flight.pulse is not None:
        return jl.SampledPulse(*flight.pulse), 0.0
    if not shot.outgoing:
        raise ValueError("no outgoing pulse was recorded")
    segment, instrument = shot.outgoing[0], flight.instrument
    values, sigma = _amplitudes(segment, flight, noise)
    if not np.all(np.isfinite(sigma)):
        raise ValueError("the outgoing pulse is saturated")
    n_digitisers = instrument.interleaved
    pedestals = _pedestals(values[: QUIET_PULSE * n_digitisers], n_digitisers, values.size)
    power = above_pedestal(values - pedestals, 0.0, "outgoing")
    zero = segment.time[np.argmax(power)] if shot.pulse_zero is None else shot.pulse_zero
    time = segment.start - zero + segment.step * np.arange(lags)
    pulse = inversion.recorded_pulse(time, np.pad(power, (0, lags - power.size)))
    is_bright = power > 0.2 * power.max()
    return pulse, float(np.median(sigma[is_bright]) / power.max()) if instrument.pulse_noise else 0.0


def response_of(flight: FlightLine) -> np.ndarray | None:
    """Receiver's response, from the narrowest single echoes among the stronger half of a file's shots.

    Such echoes are of hard flat targets. None for an instrument without a response, and for too few echoes.
    """
    if flight.instrument.response is None:
        return None
    stride = -(-len(flight.shots) // SEARCHED_SHOTS)
    shots = [shot for shot in flight.shots[::stride] if len(shot.returning) == 1]
    records = [r for r in records_of(shots, flight) if isinstance(r, AirborneRecord) and not r.saturated]
    if len(records) < 2 * FEWEST_TARGETS:
        return None
    median_peak = np.median([record.peak for record in records])
    records = [record for record in records if record.peak >= median_peak]
    lags = max(r.shot.outgoing[0].samples.size if r.shot.outgoing else r.signal.size for r in records)
    pulses = [record.pulse(lags) for record in records]
    # Both have a peak of one: the ratio of their sums is the width of the echo over that of the pulse.
    width = [record.signal.sum() / pulse.sum() for record, pulse in zip(records, pulses)]
    chosen = np.argsort(width)[:MOST_TARGETS]
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


def echoes_of(records: Sequence[AirborneRecord], impulse: np.ndarray | None) -> list[np.ndarray]:
    """Elevations of the echoes of every record, from the top down, m, as copies of its pulse."""
    size, step = max(record.signal.size for record in records), records[0].shot.sampling_interval
    signal, noise = np.zeros((len(records), size)), np.full((len(records), size), np.inf)
    for i, record in enumerate(records):
        signal[i, : record.signal.size], noise[i, : record.signal.size] = record.signal, record.noise
    half_length = max(abs(end) for r in records for end in r.lidar.pulse.support(r.lidar.jitter)) / step
    lags = int(np.ceil(half_length)) + (0 if impulse is None else impulse.size // 2)
    pulses = np.stack([record.pulse(lags, impulse) for record in records])
    echoes = inversion.gaussian_decomposition(
        step * np.arange(size), signal, noise=noise, pulse=pulses, pulse_error=PULSE_ERROR
    )
    count, times = np.asarray(echoes.count), np.asarray(echoes.time, float)
    return [
        np.interp(time[:n] / step, np.arange(record.signal.size), record.elevation)
        for time, n, record in zip(times, count, records)
    ]
