"""Figures 13 and 14: pulses of 2 to 14 ns, and their returns from a leaf plate 0.24 m above the ground.

A pulse of n ns lasts n ns in total, like the pieces from 0 to n ns of the paper: a Gaussian of six standard
deviations. Plate and ground are 1.6 ns apart; the script searches for the longest pulse that shows two peaks.
The shortest shows a weak third one as well: light that has bounced once between the ground and the plate.

    python examples/paper/figures_13_14.py [--out figures] [--small]
"""

import jax
import numpy as np
from _common import COLOURS, new_figure, options, peaks, save, table

import jaxlidar as jl

LENGTHS = (2.0, 6.0, 10.0, 14.0)
HEIGHT = 0.24
WINDOW = (-16.0, 24.0)
INTERVAL = 0.1


def lidar_of(length: float) -> jl.Lidar:
    fwhm = length / 6 * 2 * np.sqrt(2 * np.log(2))
    return jl.Lidar(wavelength=1064.0, pulse=jl.GaussianPulse(fwhm=float(fwhm)), sampling_interval=INTERVAL)


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    scene = jl.Scene(
        plates=(jl.Plate(height=HEIGHT, reflectance=0.66, transmittance=0.30),),
        ground=jl.Ground(reflectance=0.75),
    )
    # Geometry is traced once; the pulses are convolved with the same response.
    plan = jl.plan(
        lidar_of(1.0), scene, max_orders=4 if arguments.small else 12, window=WINDOW, bin_width=INTERVAL
    )
    keys = jax.random.split(jax.random.key(0), 2 if arguments.small else 16)
    trace = jax.jit(lambda key: jl.trace_scene(jl.make_setup(lidar_of(1.0), scene, plan), key))
    traced = [trace(key) for key in keys]
    response = jax.tree.map(lambda *a: sum(a) / len(a), *traced)

    def recorded(length: float) -> np.ndarray:
        setup = jl.make_setup(lidar_of(length), scene, plan)
        return np.asarray(jl.waveform_of(response, setup).reflectance[0], float)

    def resolved(length: float) -> bool:
        return len(peaks(recorded(length))) >= 2

    waves = {length: recorded(length) for length in LENGTHS}
    rows = [(length, len(peaks(w)), w.sum(), w.max() / INTERVAL) for length, w in waves.items()]
    table(("length (ns)", "peaks", "sum", "peak per ns"), rows)
    low, high = 2.0, 14.0
    assert resolved(low)
    assert not resolved(high)
    for _ in range(3 if arguments.small else 10):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if resolved(middle) else (low, middle)
    print(f"two peaks are resolved by pulses up to {low:.2f} ns ({low / 6 * 2.355:.2f} ns at half maximum)")
    two = plan.sample_start + INTERVAL * peaks(waves[2.0])[:2]
    assert np.allclose(two, [-2 * HEIGHT / 0.299792458, 0.0], atol=0.2)
    assert len(peaks(waves[14.0])) == 1
    # The returned energy does not depend on the length of the pulse.
    assert np.ptp([w.sum() for w in waves.values()]) < 0.01 * waves[2.0].sum()

    figure, (sent_axes, received_axes) = new_figure(2, height=2.5, width=5.0)
    time = plan.sample_start + INTERVAL * np.arange(plan.n_samples)
    edges = np.append(time, time[-1] + INTERVAL) - 0.5 * INTERVAL
    for colour, (length, wave) in zip(COLOURS, waves.items()):
        sent = np.diff(np.asarray(lidar_of(length).pulse.cumulative(jax.numpy.asarray(edges), 0.0)))
        sent_axes.plot(time, sent / INTERVAL, color=colour, label=f"{length:g} ns")
        received_axes.plot(time, wave / INTERVAL, color=colour)
    sent_axes.set(xlabel="time (ns)", ylabel="power (1/ns)", title="transmitted (figure 13)", xlim=(-8, 8))
    received_axes.set(
        xlabel="time (ns)", ylabel="apparent reflectance per ns", title="received (figure 14)", xlim=(-10, 12)
    )
    for at in (-2 * HEIGHT / 0.299792458, 0.0):
        received_axes.axvline(at, color="0.8", linewidth=0.8, zorder=0)
    for ax in (sent_axes, received_axes):
        ax.set_ylim(0, None)
    sent_axes.legend()
    save(figure, arguments.out / "paper_figures_13_14.png")
    return {"resolving pulse length": low}


if __name__ == "__main__":
    main()
