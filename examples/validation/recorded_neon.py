"""Recorded returns of NEON's airborne lidar against simulated ground, and its product's first returns.

    python examples/validation/recorded_neon.py PATH [--out figures]

PATH is what `jaxlidar.io.read_neon` reads. Ground is simulated at the elevation of every shot's first return,
as in the product, with the outgoing pulse of the shot: the product gives the sample where the record rises to
half, and the simulated echo should rise there too. The product places it where an echo like the outgoing
pulse would begin; an echo blurred by the receiver rises a little earlier. The echo of a hard target, recorded
for calibration, is simulated from its outgoing pulse. Only its shape is compared, as strength and position
are unknown, with a jitter of 1.9 ns that was estimated from this echo.
"""

import sys

import jax
import numpy as np
from _validation import COLOURS, by_quantity, comparison, draw_differences, finish, options, with_progress

import jaxlidar as jl
from jaxlidar.io import read_neon

# Of the receiver, ns: found from the hard target.
JITTER = 1.9
# Bounds: half a sample of 1 ns; a fraction of the peak of the hard target's echo.
SAMPLE, SHAPE = 0.5, 0.03
RISES = {"rise of a simulated echo": 0.0, "rise of a simulated echo, blurred by the receiver": JITTER}
WINDOW = {"window": (-60.0, 100.0), "max_orders": 1}


def simulate_ground(pulse_time, pulse_power, zenith=0.0, azimuth=0.0, jitter=JITTER):
    """Return times and the simulated waveform of flat ground."""
    pulse = jl.SampledPulse(time=pulse_time, power=pulse_power)
    lidar = jl.Lidar(
        altitude=1000.0, divergence=0.8, zenith=zenith, azimuth=azimuth, pulse=pulse, jitter=jitter
    )
    scene = jl.Scene(ground=jl.Ground(reflectance=0.3))
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), **WINDOW)
    return np.asarray(wave.time, float), np.asarray(wave.reflectance[0], float)


def rise_time(time, power):
    """Return the time of the first rise to half of the largest sample."""
    i = int(np.argmax(power > 0.5 * power.max()))
    before, after = power[i - 1], power[i]
    return time[i - 1] + (time[i] - time[i - 1]) * (0.5 * power.max() - before) / (after - before)


def main(argv=None):
    arguments = options(__doc__, argv, "path", shots=250)
    record, rows = read_neon(arguments.path), []
    with np.load(arguments.path) as archive:
        table = dict(zip(archive["geo_cols"].tolist(), archive["geo"].T))
    first = dict(zip(table["index"].astype(int), zip(table["z"], table["fr"])))
    for shot in with_progress(arguments, record.shots[: arguments.shots]):
        elevation, sample = first[shot.index]
        product_time = np.interp(sample, np.arange(shot.waveform.size), shot.time_from(elevation))
        for what, jitter in RISES.items():
            simulated_time = rise_time(
                *simulate_ground(shot.pulse_time, shot.pulse_power, shot.zenith, shot.azimuth, jitter)
            )
            case = f"shot {shot.index}"
            rows.append(
                comparison(
                    what, "NEON's first return", case, simulated_time, product_time, bound=SAMPLE, unit="ns"
                )
            )
    impulse = record.impulse
    time, echo = simulate_ground(impulse.pulse_time, impulse.pulse_power)
    near = np.abs(impulse.time) < 30

    def fitted(shift):
        shape = np.interp(impulse.time[near] + shift, time, echo)
        return shape * (shape @ impulse.power[near]) / (shape @ shape) / impulse.power.max()

    recorded = impulse.power[near] / impulse.power.max()
    shape = min(map(fitted, np.arange(-2.0, 3.0, 0.02)), key=lambda s: np.sum((s - recorded) ** 2))
    for t, a, b in zip(impulse.time[near], shape, recorded):
        rows.append(
            comparison(
                "echo of a hard target, over its peak",
                "NEON's calibration",
                f"{t:.0f} ns",
                a,
                b,
                bound=SHAPE,
                time=float(t),
            )
        )

    def draw(figure):
        rise_axes, echo_axes, residual_axes = figure.subplots(1, 3)
        *rises, target = by_quantity(rows).values()
        for group, label, colour in zip(rises, ("as sent", "blurred"), COLOURS):
            rise_axes.hist([r["difference"] for r in group], 20, color=colour, alpha=0.7, label=label)
        rise_axes.legend()
        rise_axes.set(title="rise of the first return", xlabel="simulated less product (ns)", ylabel="shots")
        rise_axes.axvline(-SAMPLE, color="0.6", linestyle="--", lw=0.8)
        rise_axes.axvline(SAMPLE, color="0.6", linestyle="--", lw=0.8)
        echo_axes.plot(
            [r["time"] for r in target], [r["there"] for r in target], "o", ms=3, mfc="none", label="recorded"
        )
        echo_axes.plot([r["time"] for r in target], [r["here"] for r in target], label="simulated")
        echo_axes.set(title="echo of a hard target", xlabel="time (ns)")
        echo_axes.legend()
        draw_differences(residual_axes, target, "time")
        residual_axes.set(title="simulated less recorded, over the peak", xlabel="time (ns)")

    return finish(
        arguments,
        "recorded_neon",
        rows,
        title="Recorded NEON returns",
        caption="""Left, how far the rise of simulated echoes lies from the product's. Middle and right, the
        echo of a hard target and what the simulated one leaves of it. Dashed lines are the bounds.""",
        unchecked="""The canopy: its echoes have no answers here. Strength is not
        calibrated; the jitter was found from the same hard target.""",
        draw=draw,
        of_others=True,
        size=(13.0, 4.0),
        shots=min(arguments.shots, len(record.shots)),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
