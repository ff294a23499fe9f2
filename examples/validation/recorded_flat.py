"""Recorded RIEGL shots of flat hard ground: the fit of flat ground beside the best sum of pulses.

    python examples/validation/recorded_flat.py PLS [--out figures] [--shots 30]

PLS is a PulseWaves file (.pls beside .wvs). Among its strong single echoes the 120 narrowest stand for flat
hard ground. From half of them come the corrected table of amplitudes (`corrected_table`) and the receiver's
response (`receiver_impulse`); so many of the others are fitted by flat ground. Its reduced chi-squared is
compared with what sums of pulses shifted by quarters of a sample, none negative, and a baseline reach at
best. Sums adapt to noise: their chi-squared is over that of as good a fit to records that are the fitted
ground and noise. Noise is as the quiet parts of the records have it: 0.9 counts, correlated by 0.6 from
sample to sample, and the pulse's own.
"""

import sys

import jax
import numpy as np
from _validation import COLOURS, finish, options, row, steps
from scipy.optimize import nnls

import inversion
import jaxlidar as jl
from inversion.fit.data import SampleNoise, neighbour_correlation
from inversion.fit.retrieval import scale_unknown
from inversion.receiver.digitiser import amplitude_table
from inversion.receiver.recorder import RecorderModel
from jaxlidar.io import read_pulsewaves
from jaxlidar.io.pedestal import above_pedestal

COUNTS, CORRELATED = 0.9, 0.6
STRONG, NARROWEST = (120, 200), 120
KNOTS = (100.0, 120.0, 140.0, 150.0, 160.0, 170.0, 180.0, 190.0, 200.0)
AFTER, SCALE = 40, (0.0, 3e4)
TIME = np.arange(-14.0, 41.0)
# The fit may lie so far above the best sum; records drawn for each shot; shifts of pulses, ns.
WITHIN, DRAWS, SHIFT = 0.1, 10, 0.25


class Shot:
    """A shot with one table for its pulse and its echo."""

    def __init__(self, shot, table):
        self.counts = shot.outgoing[0].samples, shot.returning[0].samples
        self.read(table)

    def read(self, table):
        """Amplitudes by a table."""
        sent, echo = self.counts
        self.echo, self.noise = inversion.amplitudes(echo, table, noise=COUNTS)
        power, noise = inversion.amplitudes(sent, table, noise=COUNTS)
        self.power = above_pedestal(power - np.median(power[:5]), 0.0, "outgoing")
        self.pulse_noise = float(np.median(noise[self.power > 0.2 * self.power.max()]) / self.power.max())

    @property
    def length(self):
        """Of the echo, in lengths of the pulse."""
        above = self.echo - np.median(self.echo[:8])
        return (above.sum() / above.max()) / (self.power.sum() / self.power.max())

    def window(self):
        """Echo and noise about the largest sample."""
        at = int(np.argmax(self.echo)) + TIME.astype(int)
        inside = (at >= 0) & (at < self.echo.size)
        at = np.clip(at, 0, self.echo.size - 1)
        return np.where(inside, self.echo[at], 0.0), np.where(inside, self.noise[at], np.inf)

    def lidar(self):
        time = np.arange(self.power.size) - float(np.argmax(self.power))
        return jl.Lidar(divergence=0.5, altitude=500.0, pulse=inversion.recorded_pulse(time, self.power))


def fitted(shots, response):
    """The fits of flat ground, their recorders and lidars."""
    recorders = [
        inversion.Recorder(
            impulse=response,
            width=(0.05, 2.0),
            offset=(-5.0, 5.0),
            pulse_noise=shot.pulse_noise,
            correlation=CORRELATED,
        )
        for shot in shots
    ]
    lidars = [shot.lidar() for shot in shots]
    start, top = (jl.Scene(ground=jl.Ground(height=z, reflectance=0.3)) for z in (0.0, 1.0))
    plan = {"max_orders": 1, "window": (TIME[0], TIME[-1]), "bin_width": 1.0, "n_rays": 16}
    signal, noise = zip(*(shot.window() for shot in shots))
    fits = inversion.retrieve_many(
        np.stack(signal)[:, None],
        lidars,
        start,
        [inversion.Unknown("ground.height", bounds=(-1.0, 1.0), name="ground")],
        noise=np.stack(noise)[:, None],
        time=TIME,
        key=jax.random.key(0),
        plan=jl.plan(lidars[0], top, footprint="fixed", **plan),
        scale=SCALE,
        recorder=recorders,
        lanes=4,
    )
    return fits, recorders, lidars


def columns_of(lidar, recorder):
    """Echoes of the pulse at all shifts, as the receiver records them."""
    fine = np.arange(TIME[0] - 60.0, TIME[-1] + 60.0, 0.05)
    energy = np.asarray(lidar.pulse.cumulative(fine), float)
    edges = np.append(TIME - 0.5, TIME[-1] + 0.5)
    shifts = np.arange(TIME[0], TIME[-1] + 1e-9, SHIFT)
    echoes = np.stack([np.diff(np.interp(edges - shift, fine, energy)) for shift in shifts])
    return recorder.recorded(echoes, {}).T


def best_sum(shot, columns, model, noise, random):
    """Chi-squared of the best sum, and its mean for records that are the model and noise."""
    signal, sigma = shot.window()
    used = np.isfinite(sigma)
    base = np.linalg.qr(noise.whiten(np.ones((used.sum(), 1))))[0]
    parts = noise.whiten(columns[used])
    parts = parts - base @ (base.T @ parts)
    parts = parts / np.maximum(np.linalg.norm(parts, axis=0), 1e-9)

    def left(record):
        white = noise.whiten(record)
        return nnls(parts, white - base @ (base.T @ white), maxiter=20000)[1] ** 2

    # What whitens records makes noise of numbers, turned round.
    colour = np.linalg.inv(noise.whiten(np.eye(used.sum())))
    drawn = [left(model[used] + colour @ random.normal(size=used.sum())) for _ in range(DRAWS)]
    return left(signal[used]), float(np.mean(drawn))


def main(argv=None):
    given = options(__doc__, argv, "pls", shots=30)
    record = read_pulsewaves(given.pls)
    raw = amplitude_table(np.asarray(record.tables[1], float), True)
    strong = [
        Shot(shot, raw)
        for shot in record
        if len(shot.returning) == 1 and STRONG[0] < shot.returning[0].samples.max() < STRONG[1]
    ]
    narrow = sorted(strong, key=lambda shot: shot.length)[:NARROWEST]
    pulses, echoes = zip(*(shot.counts for shot in narrow[::2]))
    table = inversion.corrected_table(raw, pulses, echoes, noise=COUNTS, knots=KNOTS, after=AFTER)
    for shot in narrow:
        shot.read(table)
    train, others = narrow[::2], narrow[1::2]
    shots = others[:: max(1, len(others) // given.shots)][: given.shots]
    response = inversion.receiver_impulse(
        [shot.power for shot in train],
        [shot.echo for shot in train],
        noise=[np.hypot(s.noise, s.pulse_noise * max(s.echo.max(), 0.0)) for s in train],
        after=AFTER,
    )
    fits, recorders, lidars = fitted(shots, response)
    random, sums, residuals = np.random.default_rng(0), [], []
    for i, shot in enumerate(steps(given, shots)):
        own = {name: values[i] for name, values in fits.values.items()}
        model = recorders[i].recorded(fits.fitted[i, 0], own)
        signal, sigma = shot.window()
        used = np.isfinite(sigma)
        terms = RecorderModel(recorders[i], [scale_unknown(SCALE, [])], lidars[i], TIME.size)
        flat = np.concatenate([np.ravel(own[name]) for name in ("receiver width", "offset", "scale")])
        common = terms.pulse_noise(fits.fitted[i], flat)
        noise = SampleNoise(sigma[used], common[0][used], neighbour_correlation(CORRELATED, used[None]))
        sums.append(best_sum(shot, columns_of(lidars[i], recorders[i]), model, noise, random))
        residuals.append(np.where(used, signal - model, np.nan) / np.nanmax(model))
    best, expected = np.sum(sums, axis=0)
    here, there = float(fits.reduced_chi2.mean()), float(best / expected)
    what = "reduced chi-squared of flat ground"
    rows = [row(what, "the best sum of pulses", "mean of all shots", here, there, bound=WITHIN * there)]

    def draw(figure):
        left, right = figure.subplots(1, 2)
        gain = table / raw
        left.plot(np.arange(60, 201), gain[60:201], color=COLOURS[0])
        left.set(title="corrected table over the file's", xlabel="counts")
        right.plot(TIME, np.array(residuals).T, color="0.8", lw=0.5)
        right.plot(TIME, np.nanmean(residuals, axis=0), color=COLOURS[1], label=f"mean of {len(shots)} shots")
        right.set(title="recorded less fitted, over the peak", xlabel="time (ns)")
        right.legend()

    return finish(
        given,
        "recorded_flat",
        rows,
        title="Recorded RIEGL shots of flat hard ground",
        seen="""Left, what hard targets make of the file's table of amplitudes: strong samples are less than
        it says. Right, what the fit of flat ground leaves of records.""",
        unchecked="""Nothing says that the narrowest echoes are of flat hard ground: some have a weak return
        before or after, which sums of pulses follow and flat ground does not.""",
        draw=draw,
        of_others=True,
        size=(11.0, 4.0),
        shots=len(shots),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
