"""Figures 11 and 12, Table 4: a leaf plate 1 m above the ground at 532, 1064 and 1550 nm.

The plate returns its reflectance R. Light from the ground (reflectance rho) has crossed the plate twice: T^2
rho, and T^2 rho (R rho), T^2 rho (R rho)^2 ... for each further bounce between the two, 6.7 ns (on slant
paths more) after the one before. The sum is R + T^2 rho / (1 - R rho).

    python examples/paper/figure_12.py [--out figures] [--small]
"""

import jax
import numpy as np
from _common import COLOURS, new_figure, options, save, table

import jaxlidar as jl

WAVELENGTH = (532.0, 1064.0, 1550.0)
LEAF_R, LEAF_T = np.array([0.36, 0.66, 0.57]), np.array([0.08, 0.30, 0.27])
GROUND = np.array([0.10, 0.75, 0.45])
HEIGHT = 1.0


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    scene = jl.Scene(
        plates=(jl.Plate(height=HEIGHT, reflectance=LEAF_R, transmittance=LEAF_T),),
        ground=jl.Ground(reflectance=GROUND),
    )

    # With a pulse so short that the echoes do not overlap: energies of the echoes.
    short = jl.Lidar(wavelength=WAVELENGTH, pulse=jl.GaussianPulse(fwhm=0.5), sampling_interval=0.1)
    first = jl.simulate(short, scene, key=jax.random.key(0), max_orders=1)
    time = np.asarray(first.time)
    echo = np.asarray(first.reflectance, float)
    plate, ground = echo[:, time < -3.3].sum(axis=1), echo[:, time >= -3.3].sum(axis=1)
    # All orders in one long sample: light on slant paths between the two returns late.
    photons = 8 * (4096 if arguments.small else 65536)
    single_sample_lidar = jl.Lidar(wavelength=WAVELENGTH, sampling_interval=2000.0)
    all_orders = jl.simulate(
        single_sample_lidar,
        scene,
        key=jax.random.key(1),
        max_orders=20,
        n_photons=photons,
        window=(900.0, 901.0),
        bin_width=2.0,
    )
    total, stderr = (
        np.asarray(all_orders.reflectance, float)[:, 0],
        np.asarray(all_orders.stderr, float)[:, 0],
    )
    closed = LEAF_R + LEAF_T**2 * GROUND / (1 - LEAF_R * GROUND)

    rows = [
        (f"{w:g}", LEAF_R[i], plate[i], LEAF_T[i] ** 2 * GROUND[i], ground[i], closed[i], total[i], stderr[i])
        for i, w in enumerate(WAVELENGTH)
    ]
    table(("nm", "R", "plate", "T^2 rho", "ground", "all, closed form", "all", "one s.e."), rows)
    results = {f"ground at {w:g} nm": float(g) for w, g in zip(WAVELENGTH, ground)}
    assert np.allclose(plate, LEAF_R, rtol=1e-4)
    assert np.allclose(ground, LEAF_T**2 * GROUND, rtol=1e-4)
    # Orders and times beyond the last add a thousandth at most.
    assert np.all(np.abs(total - closed) < 4 * stderr + 1e-3 * closed)
    # The paper: at 532 nm the peak of the ground is minimal, in this ratio to that at 1064 nm.
    assert np.argmin(ground) == 0
    ratio = (0.08 / 0.30) ** 2 * 0.10 / 0.75
    assert np.isclose(ground[0] / ground[1], ratio, rtol=1e-3)
    print(f"ground at 532 nm / ground at 1064 nm: {ground[0] / ground[1]:.5f}, closed form {ratio:.5f}")

    # One trace for both pulses: the default of 6 ns, and one that resolves the echoes.
    plan = jl.plan(short, scene, max_orders=8, window=(-20.0, 30.0), bin_width=0.1)
    keys = jax.random.split(jax.random.key(2), 2 if arguments.small else 16)
    trace = jax.jit(lambda key: jl.trace_scene(jl.make_setup(short, scene, plan), key))
    traced = [trace(key) for key in keys]
    response = jax.tree.map(lambda *a: sum(a) / len(a), *traced)
    figure, axes = new_figure(2, width=5.0, sharey=True)
    for ax, fwhm in zip(axes, (6.0, 2.0)):
        lidar = jl.Lidar(wavelength=WAVELENGTH, pulse=jl.GaussianPulse(fwhm=fwhm), sampling_interval=0.1)
        wave = jl.waveform_of(response, jl.make_setup(lidar, scene, plan))
        for height in (HEIGHT, 0.0):
            ax.axhline(height, color="0.8", linewidth=0.8, zorder=0)
        for i, w in enumerate(WAVELENGTH):
            ax.plot(wave.reflectance[i] / 0.1, wave.height, color=COLOURS[i], label=f"{w:g} nm")
        ax.set(xlabel="apparent reflectance per ns", ylim=(-3, 2.2), title=f"pulse of {fwhm:g} ns")
        ax.set_xlim(left=0)
    # Label the lines of ground and plate.
    axes[0].set(ylabel="height (m)", yticks=[-3, -2, -1, 0, 1, 2])
    axes[0].set_yticklabels(["-3", "-2", "-1", "ground  0", "plate  1", "2"])
    axes[0].legend(loc="lower right")
    save(figure, arguments.out / "paper_figure_12.png")
    return results


if __name__ == "__main__":
    main()
