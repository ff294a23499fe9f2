"""Recorded RIEGL shots of flat hard ground: the fit of flat ground beside the best sum of pulses.

    python examples/validation/recorded_flat.py PLS [--out figures] [--shots 30]

PLS is a PulseWaves file (.pls beside .wvs). Among its strong single echoes the 120 narrowest stand for flat
hard ground. Half of them serve to estimate the corrected table of amplitudes (`corrected_table`) and the
response of the receiver (`receiver_impulse`); `--shots` of the others are fitted by flat ground. The reduced
chi-squared is compared with that of the best sum of a baseline and non-negative pulses shifted by quarters of
a sample. As sums adapt to noise, their chi-squared is divided by that of the best sums for synthetic records,
the fitted ground plus noise. The noise is that of quiet samples, 0.9 counts with a correlation of 0.6 from
sample to sample, and that of the recorded pulse.
"""

import sys

import jax
import numpy as np
from _validation import COLOURS, comparison, finish, options, with_progress
from scipy.optimize import nnls

import inversion
import jaxlidar as jl
from inversion.fit.data import SampleNoise, neighbour_correlation
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.retrieval import scale_unknown
from inversion.receiver.digitiser import amplitude_table
from jaxlidar.formats.noise import above_pedestal
from jaxlidar.io import read_pulsewaves

COUNTS, CORRELATED = 0.9, 0.6
STRONG, NARROWEST = (120, 200), 120
KNOTS = (100.0, 120.0, 140.0, 150.0, 160.0, 170.0, 180.0, 190.0, 200.0)
AFTER, SCALE = 40, (0.0, 3e4)
TIME = np.arange(-14.0, 41.0)
# Bound on the excess over the best sum; synthetic records for each shot; shift between pulses, ns.
WITHIN, DRAWS, SHIFT = 0.1, 10, 0.25


class FlatShot:
    """A shot whose pulse and echo are converted by one table of amplitudes."""

    def __init__(self, shot, table):
        self.counts = shot.outgoing[0].samples, shot.returning[0].samples
        self.read(table)

    def read(self, table):
        """Convert counts to amplitudes by a table."""
        sent, echo = self.counts
        self.echo, self.noise = inversion.amplitudes(echo, table, noise=COUNTS)
        power, noise = inversion.amplitudes(sent, table, noise=COUNTS)
        self.power = above_pedestal(power - np.median(power[:5]), 0.0, "outgoing")
        self.pulse_noise = float(np.median(noise[self.power > 0.2 * self.power.max()]) / self.power.max())

    @property
    def length(self):
        """Equivalent width of the echo, in widths of the pulse."""
        above = self.echo - np.median(self.echo[:8])
        return (above.sum() / above.max()) / (self.power.sum() / self.power.max())

    def window(self):
        """Return echo and noise about the largest sample."""
        at = int(np.argmax(self.echo)) + TIME.astype(int)
        inside = (at >= 0) & (at < self.echo.size)
        at = np.clip(at, 0, self.echo.size - 1)
        return np.where(inside, self.echo[at], 0.0), np.where(inside, self.noise[at], np.inf)

    def lidar(self):
        time = np.arange(self.power.size) - float(np.argmax(self.power))
        return jl.Lidar(divergence=0.5, altitude=500.0, pulse=inversion.recorded_pulse(time, self.power))


def fit_flat_ground(shots, response):
    """Return the fits of flat ground, their recorders and lidars."""
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
    problem = inversion.Problem(
        np.stack(signal)[:, None],
        lidars,
        start,
        [inversion.Unknown("ground.height", bounds=(-1.0, 1.0), name="ground")],
        noise=np.stack(noise)[:, None],
        time=TIME,
        plan=jl.plan(lidars[0], top, footprint="fixed", **plan),
        scale=SCALE,
        recorder=recorders,
    )
    fits = inversion.retrieve_many(problem, key=jax.random.key(0), lanes=4)
    return fits, recorders, lidars


def shifted_echoes(lidar, recorder):
    """Return the recorded echoes of the pulse at all shifts, one a column."""
    fine = np.arange(TIME[0] - 60.0, TIME[-1] + 60.0, 0.05)
    energy = np.asarray(lidar.pulse.cumulative(fine), float)
    edges = np.append(TIME - 0.5, TIME[-1] + 0.5)
    shifts = np.arange(TIME[0], TIME[-1] + 1e-9, SHIFT)
    echoes = np.stack([np.diff(np.interp(edges - shift, fine, energy)) for shift in shifts])
    return recorder.recorded(echoes, {}).T


def best_pulse_sum(shot, columns, model, noise, random):
    """Return the chi-squared of the best sum, and its mean for synthetic records of the model plus noise."""
    signal, sigma = shot.window()
    used = np.isfinite(sigma)
    baseline = np.linalg.qr(noise.whiten(np.ones((used.sum(), 1))))[0]
    projected = noise.whiten(columns[used])
    projected = projected - baseline @ (baseline.T @ projected)
    projected = projected / np.maximum(np.linalg.norm(projected, axis=0), 1e-9)

    def residual_chi2(record):
        white = noise.whiten(record)
        return nnls(projected, white - baseline @ (baseline.T @ white), maxiter=20000)[1] ** 2

    # The inverse of the whitening matrix correlates independent numbers like the noise.
    unwhitening = np.linalg.inv(noise.whiten(np.eye(used.sum())))
    drawn = [residual_chi2(model[used] + unwhitening @ random.normal(size=used.sum())) for _ in range(DRAWS)]
    return residual_chi2(signal[used]), float(np.mean(drawn))


def main(argv=None):
    arguments = options(__doc__, argv, "pls", shots=30)
    record = read_pulsewaves(arguments.pls)
    raw = amplitude_table(np.asarray(record.tables[1], float), True)
    strong = [
        FlatShot(shot, raw)
        for shot in record
        if len(shot.returning) == 1 and STRONG[0] < shot.returning[0].samples.max() < STRONG[1]
    ]
    narrow = sorted(strong, key=lambda shot: shot.length)[:NARROWEST]
    pulses, echoes = zip(*(shot.counts for shot in narrow[::2]))
    table = inversion.corrected_table(raw, pulses, echoes, noise=COUNTS, knots=KNOTS, after=AFTER)
    for shot in narrow:
        shot.read(table)
    train, test_shots = narrow[::2], narrow[1::2]
    shots = test_shots[:: max(1, len(test_shots) // arguments.shots)][: arguments.shots]
    response = inversion.receiver_impulse(
        [shot.power for shot in train],
        [shot.echo for shot in train],
        noise=[np.hypot(s.noise, s.pulse_noise * max(s.echo.max(), 0.0)) for s in train],
        after=AFTER,
    )
    fits, recorders, lidars = fit_flat_ground(shots, response)
    random, sums, residuals = np.random.default_rng(0), [], []
    for i, shot in enumerate(with_progress(arguments, shots)):
        fit_values = {name: values[i] for name, values in fits.values.items()}
        model = recorders[i].recorded(fits.fitted[i, 0], fit_values)
        signal, sigma = shot.window()
        used = np.isfinite(sigma)
        terms = RecorderModel(recorders[i], [scale_unknown(SCALE, [])], lidars[i], TIME.size)
        flat = np.concatenate([np.ravel(fit_values[name]) for name in ("receiver width", "offset", "scale")])
        common = terms.pulse_noise(fits.fitted[i], flat)
        noise = SampleNoise(sigma[used], common[0][used], neighbour_correlation(CORRELATED, used[None]))
        sums.append(best_pulse_sum(shot, shifted_echoes(lidars[i], recorders[i]), model, noise, random))
        residuals.append(np.where(used, signal - model, np.nan) / np.nanmax(model))
    best, expected = np.sum(sums, axis=0)
    fit_chi2, best_chi2 = float(fits.reduced_chi2.mean()), float(best / expected)
    what = "reduced chi-squared of flat ground"
    rows = [
        comparison(
            what, "the best sum of pulses", "mean of all shots", fit_chi2, best_chi2, bound=WITHIN * best_chi2
        )
    ]

    def draw(figure):
        table_axes, residual_axes = figure.subplots(1, 2)
        gain = table / raw
        table_axes.plot(np.arange(60, 201), gain[60:201], color=COLOURS[0])
        table_axes.set(title="corrected table over the file's", xlabel="counts")
        residual_axes.plot(TIME, np.array(residuals).T, color="0.8", lw=0.5)
        residual_axes.plot(
            TIME, np.nanmean(residuals, axis=0), color=COLOURS[1], label=f"mean of {len(shots)} shots"
        )
        residual_axes.set(title="recorded less fitted, over the peak", xlabel="time (ns)")
        residual_axes.legend()

    return finish(
        arguments,
        "recorded_flat",
        rows,
        title="Recorded RIEGL shots of flat hard ground",
        caption="""Left, what hard targets make of the file's table of amplitudes: strong samples are less
        than it says. Right, what the fit of flat ground leaves of records.""",
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
