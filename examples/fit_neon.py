"""Fit recorded returns of NEON's airborne lidar, several at once, each with its own pulse.

    python examples/fit_neon.py neon.npz [--shots 9] [--out figures]

The file is what `jaxlidar.io.read_neon` reads. Canopies are as in `fit_gedi.py`: horizontally uniform, ten
layers of equal thickness from 3 m above the ground to the top, first order with the hot spot. Found are the
elevations of ground and top, every layer's plant area density, and the receiver's gain. The pulse is 15 ns
(2.3 m) long and a layer 1 to 2 m thick: two crowns within one layer's reach make one echo of the fit.

Fitted are the longest returns that have three echoes or more: one or two echoes cannot tell ground from
canopy, and most returns of a closed forest end within it. The ground's elevation stands beside the last echo
of the Gaussian decomposition; of nine shots of Harvard Forest it lies 0.2 m higher in the median. They differ
where something returns light within a pulse's length of the ground, which the model has no plants for, and
where the ground is hardly seen: one of the nine fits puts it below the record, and does not converge. No
answers are known here.
"""

import argparse
import sys
from pathlib import Path

import jax
import matplotlib
import numpy as np
from fit_gedi import GROUND, LAYERS, put_canopy_height, put_density, put_ground, scene_of

import inversion
import jaxlidar as jl
from inversion import Unknown
from jaxlidar.io import atomic_write, read_neon

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ALTITUDE, DIVERGENCE = 1000.0, 0.8
# What a hard target's echo is blurred by beside its outgoing pulse, ns.
JITTER = 1.9
# Standard deviation of the pulse so blurred, ns.
PULSE_WIDTH = 6.7
# Samples above and below the last echo.
ABOVE, BELOW = 170, 50
# Noise is correlated over so many neighbouring samples, which then tell as much as one.
CORRELATED = 5
# Relative error of the model, of the largest sample: the pulse is itself a record, and no canopy is uniform.
MODEL_ERROR = 0.01
TIME = np.arange(-ABOVE, BELOW + 1)


def noise_of(shot):
    """Standard deviation of the shot's samples, as of independent ones; infinite in gaps."""
    noise = np.sqrt(CORRELATED) * np.hypot(shot.noise_std, MODEL_ERROR * shot.signal.max())
    return np.where(shot.recorded, noise, np.inf)


def echoes_of(shots):
    """Elevations of every shot's Gaussian echoes, from above."""
    # Of one length, so that they compile once; what was not recorded has no weight.
    size = max(shot.waveform.size for shot in shots)
    found = []
    for shot in shots:
        pad = (0, size - shot.waveform.size)
        noise = np.pad(noise_of(shot), pad, constant_values=np.inf)
        echoes = inversion.gaussian_decomposition(
            np.arange(size), np.pad(shot.signal, pad), noise=noise, width=PULSE_WIDTH
        )
        time = np.asarray(echoes.time)[: int(echoes.count)]
        found.append(np.interp(time, np.arange(shot.waveform.size), shot.elevation))
    return found


def lidar_of(shot):
    """NEON's lidar with the shot's pulse and direction. Its footprint is 0.8 m wide."""
    return jl.Lidar(
        altitude=ALTITUDE,
        divergence=DIVERGENCE,
        zenith=shot.zenith,
        azimuth=shot.azimuth,
        pulse=jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power),
        jitter=JITTER,
    )


def window(shot, reference):
    """Signal and noise at times `TIME` from the reference elevation, without weight outside the record."""
    number = np.arange(shot.waveform.size)
    sample = np.round(np.interp(0.0, shot.time_from(reference), number)).astype(int) + TIME
    inside = (sample >= 0) & (sample < number.size)
    sample = np.clip(sample, 0, number.size - 1)
    return np.where(inside, shot.signal[sample], 0.0), np.where(inside, noise_of(shot)[sample], np.inf)


def fit(shots, echoes):
    """Fit all shots at once. Returns the retrievals and the elevation of each one's reference plane."""
    # The sample nearest to the last echo, so that samples lie at whole ns.
    reference = np.array([s.elevation[np.argmin(np.abs(s.elevation - e[-1]))] for s, e in zip(shots, echoes)])
    windows = [window(*pair) for pair in zip(shots, reference)]
    signal, noise = (np.stack(a)[:, None, :] for a in zip(*windows))
    unknowns = [
        Unknown(name="ground", bounds=(-3.0, 3.0), prior=(0.0, 1.0), start=0.0, apply=put_ground),
        Unknown(name="canopy height", bounds=(1.0, 30.0), start=10.0, apply=put_canopy_height),
        Unknown(
            name="log density",
            bounds=(np.log(1e-4), np.log(10.0)),
            prior=(np.log(0.1), 1.0),
            start=np.full(LAYERS, np.log(0.1)),
            apply=put_density,
        ),
    ]
    lidars = [lidar_of(shot) for shot in shots]
    found = inversion.retrieve_many(
        signal,
        lidars,
        scene_of(10.0, slope=0.0),
        unknowns,
        noise=noise,
        time=TIME,
        key=jax.random.key(0),
        plan=jl.plan(
            lidars[0],
            scene_of(30.0, slope=0.0),
            max_orders=1,
            window=(-ABOVE, BELOW),
            bin_width=1.0,
            n_rays=16,
            footprint="fixed",
        ),
        start={"canopy height": np.clip([e[0] - e[-1] + 1.0 for e in echoes], 2.0, 28.0)},
        scale=(0.0, 4.0 * float(signal.sum(axis=-1).max()) / GROUND),
        max_steps=150,
        lanes=4,
    )
    return found, reference


def draw(shots, echoes, found, reference, path):
    """Record and fit of every shot against elevation, with the ground and the last echo."""
    rows = -(-len(shots) // 3)
    figure, axes = plt.subplots(
        rows, min(3, len(shots)), figsize=(9, 3.2 * rows), layout="constrained", squeeze=False
    )
    for ax in axes.flat[len(shots) :]:
        ax.set_axis_off()
    for i, (ax, shot) in enumerate(zip(axes.flat, shots)):
        height = np.interp(TIME, shot.time_from(reference[i]), shot.elevation, np.nan, np.nan)
        ax.plot(
            shot.signal[shot.recorded],
            shot.elevation[shot.recorded],
            ".",
            color="0.6",
            markersize=3,
            label="record",
        )
        ax.plot(
            found.values["scale"][i] * found.fitted[i, 0], height, color="black", linewidth=1.2, label="fit"
        )
        ground = reference[i] + found.values["ground"][i]
        ax.axhline(ground, color="#d55e00", linewidth=1.0, label="ground (fit)")
        top = ground + found.values["canopy height"][i]
        ax.axhline(top, color="#009e73", linestyle="--", linewidth=0.8, label="canopy top (fit)")
        ax.axhline(echoes[i][-1], color="#0072b2", linestyle=":", linewidth=1.0, label="last echo")
        ax.set_title(f"shot {shot.index}", fontsize=10)
    figure.supxlabel("signal (counts)")
    figure.supylabel("elevation (m)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False)
    with atomic_write(path) as draft:
        figure.savefig(draft, format="png", dpi=130)
    plt.close(figure)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="recorded returns (.npz)")
    parser.add_argument("--shots", type=int, default=9, help="how many of the longest returns to fit")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for the figure")
    options = parser.parse_args(argv)
    shots = sorted(read_neon(options.file).shots, key=lambda s: -s.waveform.size)[: 2 * options.shots]
    echoes = echoes_of(shots)
    for shot, few in ((s, e) for s, e in zip(shots, echoes) if len(e) < 3):
        print(f"shot {shot.index} has {len(few)} echoes: ground and canopy cannot be told apart")
    pairs = [(s, e) for s, e in zip(shots, echoes) if len(e) >= 3][: options.shots]
    if not pairs:
        sys.exit(f"{options.file}: none of the longest returns has three echoes")
    shots, echoes = ([p[k] for p in pairs] for k in (0, 1))
    found, reference = fit(shots, echoes)
    ground = reference + found.values["ground"]
    print("shot  echoes  last echo  ground (fit)  std. error  height  plant area  reduced chi2")
    for i, (shot, own) in enumerate(zip(shots, echoes)):
        height = found.values["canopy height"][i]
        area = height * np.exp(found.values["log density"][i]).mean()
        print(
            f"{shot.index:4d}{len(own):8d}{own[-1]:11.2f}{ground[i]:14.2f}{found.stderr['ground'][i]:12.2f}"
            f"{height:8.1f}{area:12.2f}{found.reduced_chi2[i]:14.2f}"
            + ("" if found.converged[i] else f"  {found.status[i]}")
        )
    difference = ground - np.array([e[-1] for e in echoes])
    print(f"ground less last echo: median {np.median(difference):.2f} m, spread {np.std(difference):.2f} m")
    path = options.out / "neon.png"
    draw(shots, echoes, found, reference, path)
    print(f"figure: {path}")
    return found, difference


if __name__ == "__main__":
    main()
    sys.exit(0)
