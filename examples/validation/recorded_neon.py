"""Recorded returns of NEON's airborne lidar against simulated ground, and its product's first returns.

    python examples/validation/recorded_neon.py PATH [--out figures]

PATH is what `jaxlidar.io.read_neon` reads. Ground is simulated at the elevation of every shot's first return,
as the product has it, with the shot's own outgoing pulse: the product says in which sample the record rises
to half, and the simulated echo should rise there too. The product puts it where an echo like the outgoing
pulse would begin; what the receiver blurs rises a little earlier. The echo of a hard target, recorded for
calibration, is simulated from its outgoing pulse: its shape, for strength and place are not known, after a
jitter of 1.9 ns, which was found from this echo."""

import sys

import jax
import numpy as np
from _validation import COLOURS, by_what, draw_differences, finish, options, row, steps

import jaxlidar as jl
from jaxlidar.io import read_neon

# isort: split
# `_validation` has put its folder on the path.
from _airborne import INSTRUMENTS

JITTER = INSTRUMENTS["neon"].jitter
# Half a sample of 1 ns; and of the peak of the hard target's echo.
SAMPLE, SHAPE = 0.5, 0.03
RISES = {"rise of a simulated echo": 0.0, "rise of a simulated echo, blurred by the receiver": JITTER}
WINDOW = {"window": (-60.0, 100.0), "max_orders": 1}


def ground(pulse_time, pulse_power, zenith=0.0, azimuth=0.0, jitter=JITTER):
    """Times and the simulated return of flat ground."""
    pulse = jl.SampledPulse(time=pulse_time, power=pulse_power)
    lidar = jl.Lidar(
        altitude=1000.0, divergence=0.8, zenith=zenith, azimuth=azimuth, pulse=pulse, jitter=jitter
    )
    scene = jl.Scene(ground=jl.Ground(reflectance=0.3))
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), **WINDOW)
    return np.asarray(wave.time, float), np.asarray(wave.reflectance[0], float)


def rise(time, power):
    """When it first rises to half of its largest sample."""
    i = int(np.argmax(power > 0.5 * power.max()))
    before, after = power[i - 1], power[i]
    return time[i - 1] + (time[i] - time[i - 1]) * (0.5 * power.max() - before) / (after - before)


def main(argv=None):
    given = options(__doc__, argv, "path", shots=250)
    record, rows = read_neon(given.path), []
    with np.load(given.path) as archive:
        table = dict(zip(archive["geo_cols"].tolist(), archive["geo"].T))
    first = dict(zip(table["index"].astype(int), zip(table["z"], table["fr"])))
    for shot in steps(given, record.shots[: given.shots]):
        elevation, sample = first[shot.index]
        there = np.interp(sample, np.arange(shot.waveform.size), shot.time_from(elevation))
        for what, jitter in RISES.items():
            here = rise(*ground(shot.pulse_time, shot.pulse_power, shot.zenith, shot.azimuth, jitter))
            case = f"shot {shot.index}"
            rows.append(row(what, "NEON's first return", case, here, there, bound=SAMPLE, unit="ns"))
    impulse = record.impulse
    time, echo = ground(impulse.pulse_time, impulse.pulse_power)
    near = np.abs(impulse.time) < 30

    def fitted(shift):
        shape = np.interp(impulse.time[near] + shift, time, echo)
        return shape * (shape @ impulse.power[near]) / (shape @ shape) / impulse.power.max()

    recorded = impulse.power[near] / impulse.power.max()
    shape = min(map(fitted, np.arange(-2.0, 3.0, 0.02)), key=lambda s: np.sum((s - recorded) ** 2))
    for t, a, b in zip(impulse.time[near], shape, recorded):
        rows.append(row("echo of a hard target, over its peak", "NEON's calibration", f"{t:.0f} ns", a, b,
                        bound=SHAPE, time=float(t)))  # fmt: skip

    def draw(figure):
        left, middle, right = figure.subplots(1, 3)
        *rises, target = by_what(rows).values()
        for group, label, colour in zip(rises, ("as sent", "blurred"), COLOURS):
            left.hist([r["difference"] for r in group], 20, color=colour, alpha=0.7, label=label)
        left.legend()
        left.set(title="rise of the first return", xlabel="simulated less product (ns)", ylabel="shots")
        left.axvline(-SAMPLE, color="0.6", linestyle="--", lw=0.8)
        left.axvline(SAMPLE, color="0.6", linestyle="--", lw=0.8)
        middle.plot(
            [r["time"] for r in target], [r["there"] for r in target], "o", ms=3, mfc="none", label="recorded"
        )
        middle.plot([r["time"] for r in target], [r["here"] for r in target], label="simulated")
        middle.set(title="echo of a hard target", xlabel="time (ns)")
        middle.legend()
        draw_differences(right, target, "time")
        right.set(title="simulated less recorded, over the peak", xlabel="time (ns)")

    return finish(
        given,
        "recorded_neon",
        rows,
        title="Recorded NEON returns",
        seen="""Left, how far the rise of simulated echoes lies from the product's. Middle and right, the echo
        of a hard target and what the simulated one leaves of it. Dashed lines are the bounds.""",
        unchecked="""The canopy: its echoes have no answers here (`fit_airborne.py` fits them). Strength is
        not calibrated; the jitter was found from the same hard target.""",
        draw=draw,
        of_others=True,
        size=(13.0, 4.0),
        shots=min(given.shots, len(record.shots)),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
