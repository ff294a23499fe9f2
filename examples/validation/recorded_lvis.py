"""Recorded LVIS shots: a simulated canopy over ground fitted to each, and the residuals.

    python examples/validation/recorded_lvis.py PLS [--out figures] [--shots 40]

PLS is a PulseWaves file (.pls beside .wvs). `--shots` shots that do not saturate, evenly spread, are fitted
by ten layers of leaves over a slope, as in `inversion.metrics.gedi_fit`, with the outgoing pulse of each
shot, starting from the ground of the matched pulse (`find_ground`). The geometry is checked too: the distance
between positions of samples, 2 ns apart, against the speed of light. The two digitisers, which record odd and
even samples, have pedestals of their own.
"""

import sys

import jax
import numpy as np
from _validation import COLOURS, comparison, finish, options

import inversion
import jaxlidar as jl
from inversion.metrics.gedi_fit import CANOPY, canopy_unknowns
from jaxlidar.io import read_pulsewaves

STEP, SATURATED, QUIET = 2.0, 215.0, 60
FOOTPRINT, ALTITUDE = 20.0, 8000.0
# Range of one sample, m: half the path of light in 2 ns, in air.
SAMPLE_RANGE = 0.5 * 0.299792458 * STEP / 1.0003
# Samples above and below the ground; model error and bound on residuals, both of the peak.
ABOVE, BELOW, MODEL, MAX_RESIDUAL = 180, 40, 0.01, 0.03
TIME = STEP * np.arange(-ABOVE, BELOW + 1)


def pedestal_subtracted(shot):
    """Return samples less the pedestal of their digitiser, and the standard deviation of quiet samples."""
    samples = shot.waveform.astype(float)
    for odd in (0, 1):
        samples[odd::2] -= samples[odd:QUIET:2].mean()
    return samples, samples[:QUIET].std()


def lidar_of(pulse):
    """Return LVIS with a given pulse."""
    divergence = 1e3 * FOOTPRINT / ALTITUDE
    return jl.Lidar(altitude=ALTITUDE, divergence=divergence, sampling_interval=STEP, pulse=pulse)


def fit_canopies(shots, signals, noise, middle):
    """Return the fits, signals about the samples `middle` over their peaks, and a mask of used samples."""
    at = np.array(middle)[:, None] + np.arange(-ABOVE, BELOW + 1)
    outside = (at < 0) | (at >= shots[0].waveform.size)
    peak = np.max(signals, axis=1, keepdims=True)
    power = np.take_along_axis(np.array(signals) / peak, np.where(outside, 0, at), axis=1)
    sigma = np.where(outside, np.inf, np.hypot(np.array(noise)[:, None] / peak, MODEL))
    lit = np.argmax((power > 5 * sigma) & ~outside, axis=1)
    pulses = [jl.SampledPulse(time=s.pulse_time, power=s.pulse_power) for s in shots]
    plan = {
        "max_orders": 1,
        "window": (TIME[0], TIME[-1]),
        "bin_width": 2.0,
        "n_rays": 64,
        "footprint": "fixed",
    }
    problem = inversion.Problem(
        np.where(outside, 0.0, power)[:, None],
        [lidar_of(pulse) for pulse in pulses],
        CANOPY.scene(10.0),
        canopy_unknowns(),
        noise=sigma[:, None],
        time=TIME,
        plan=jl.plan(lidar_of(jl.GaussianPulse(fwhm=40.0)), CANOPY.scene(48.0, -3.0, 25.0), **plan),
        start={"canopy height": np.clip((ABOVE - lit) * SAMPLE_RANGE, 2.0, 44.0)},
        scale=(0.0, 1e3),
    )
    fits = inversion.retrieve_many(problem, key=jax.random.key(0), max_steps=100)
    return fits, power, np.isfinite(sigma)


def main(argv=None):
    arguments = options(__doc__, argv, "pls", shots=40)
    unsaturated = [s for s in read_pulsewaves(arguments.pls) if 100.0 < s.waveform.max() < SATURATED]
    shots = unsaturated[:: max(1, len(unsaturated) // arguments.shots)][: arguments.shots]
    signals, noise = zip(*map(pedestal_subtracted, shots))
    rows, middle = [], []
    for shot, samples, sigma in zip(shots, signals, noise):
        metres = np.linalg.norm((shot.position[-1] - shot.position[0]) * shot.metres) / (shot.time.size - 1)
        what, case = "places of two samples apart", f"shot {shot.index}"
        rows.append(comparison(what, "the speed of light", case, metres, SAMPLE_RANGE, bound=5e-4, unit="m"))
        lags = STEP * np.arange(-30, 31)
        pulse = np.interp(lags, shot.pulse_time, shot.pulse_power, left=0.0, right=0.0)
        ground = float(inversion.find_ground(shot.elevation, samples, pulse=pulse, noise=sigma))
        middle.append(int(np.argmin(np.abs(shot.elevation - ground))))
    fits, power, used = fit_canopies(shots, signals, noise, middle)
    model = np.asarray(fits.values["scale"], float).reshape(-1, 1) * np.asarray(fits.fitted, float)[:, 0]
    residuals = np.where(used, model - power, 0.0)
    for i, shot in enumerate(shots):
        rms, noise_rms = np.sqrt(np.mean(residuals[i, used[i]] ** 2)), noise[i] / signals[i].max()
        case = f"shot {shot.index}"
        rows.append(
            comparison(
                "simulation less record, rms over the peak",
                "the record's noise",
                case,
                rms,
                noise_rms,
                bound=MAX_RESIDUAL,
            )
        )

    def draw(figure):
        record_axes, residual_axes = figure.subplots(1, 2)
        worst = np.argsort([np.sum(o**2) for o in residuals])[:: max(1, len(residuals) // 5)]
        for n, i in enumerate(worst):
            record_axes.plot(
                np.where(used[i], power[i], np.nan) + n, TIME, ".", color="0.5", ms=3, label="recorded"
            )
            record_axes.plot(model[i] + n, TIME, color=COLOURS[0], lw=1.0, label="simulated")
        record_axes.invert_yaxis()
        record_axes.set(title="from the best fit to the worst", ylabel="time (ns)", xlabel="over the peak")
        record_axes.legend(*(entries[:2] for entries in record_axes.get_legend_handles_labels()))
        residual_axes.plot(TIME, residuals.T, color="0.8", lw=0.5)
        residual_axes.plot(
            TIME, residuals.mean(axis=0), color=COLOURS[1], label=f"mean of {len(shots)} shots"
        )
        residual_axes.set(title="simulated less recorded, over the peak", xlabel="time (ns)")
        residual_axes.legend()

    return finish(
        arguments,
        "recorded_lvis",
        rows,
        title="Recorded LVIS shots",
        caption="""Left, records and fitted simulations, from the best fit to the worst. Right, what the
        simulation leaves of the records: its mean is below zero after the ground, where receivers have a
        tail and light of higher orders, which the fit leaves out, comes back.""",
        unchecked="""This is the weakest comparison: no answers are known for these shots, and ten layers can
        imitate much. Saturated shots are left out.""",
        draw=draw,
        of_others=True,
        size=(11.0, 5.0),
        shots=len(shots),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
