"""Fit one recorded GEDI waveform: a layered canopy over sloping ground, with the shot's own transmit pulse.

    python examples/fit_gedi.py GEDI01_B_....h5 [--shot N] [--answers answers.npz] [--out figures]

The canopy is horizontally uniform: ten layers of equal thickness from the ground to the canopy's top. Found
are the elevations of ground and top, the slope (which stands for all that widens the ground's echo), the
plant area density of every layer, and one factor for the receiver's unknown gain. Reflectances are fixed, in
the ratio of the level-2B algorithm, rho_v / rho_g = 0.6 / 0.4; another would scale the densities. First order
only, with the hot spot: light comes back through the gap by which it went in, as gap-probability models have
it.

Beside the fit stand the product's answers, where given: `elev_lowestmode`, `pai`, and `elev_highest`. The
last is where the signal leaves the noise, a metre or two above the canopy as the pulse has a width; the
fitted waveform is read by the same rule. Fits use elevations relative to a bin near the ground, as single
precision would blur absolute ones.

Standard errors are those of the noise. The model's own ambiguity is larger: plants within a pulse's length of
the ground merge with its echo, and the fit then puts the ground lower, and finds more plants, than a product
that takes the last mode for the ground (0.3 m in the median of 15 shots of a savanna).
"""

import argparse
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import inversion
import jaxlidar as jl
from inversion import Unknown
from jaxlidar.io import read_gedi_l1b, whole_file

matplotlib.use("Agg")
import matplotlib.pyplot as plt

LAYERS = 10
ALTITUDE, FOOTPRINT = 400e3, 25.0
# Spherically oriented leaves return two thirds of their reflectance: rho_v = 0.30.
LEAF, GROUND = jl.LeafOptics(reflectance=0.45, transmittance=0.40), 0.20
# Samples above and below the reference: of 1 ns, or 0.15 m.
ABOVE, BELOW = 280, 80
# Records are smoothed as by a Gaussian of this standard deviation, ns; the transmitted pulse is not.
SMOOTHING = 1.7
# Noise is correlated over five neighbouring samples, which then tell as much as one.
CORRELATED = 5
# The receiver has a tail that the transmitted pulse does not show: nothing is fitted beyond so many
# samples below the last mode.
TAIL = 14
# Relative error of the model: the pulse is itself a record, and no canopy is uniform.
MODEL_ERROR = 0.01


def put_ground(scene, height):
    """Move the ground, and the canopy on it."""
    moved = scene.canopy.voxels.origin.at[2].set(height)
    return eqx.tree_at(lambda s: (s.ground.height, s.canopy.voxels.origin), scene, (height, moved))


def put_canopy_height(scene, height):
    """Stretch the canopy."""
    size = scene.canopy.voxels.voxel_size.at[2].set(height / LAYERS)
    return eqx.tree_at(lambda s: s.canopy.voxels.voxel_size, scene, size)


def put_density(scene, log_density):
    """Logarithm of the layers' plant area density in m2/m3, from below."""
    extinction = 0.5 * jnp.exp(log_density).reshape(1, 1, LAYERS)
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, extinction)


def scene_of(height, ground=0.0, slope=5.0):
    """Bare of any shot: heights in m above the reference, slope in degrees."""
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, LAYERS), 0.05), voxel_size=(50.0, 50.0, height / LAYERS), origin=(-25.0, -25.0, ground)
    )
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=LEAF, sides="periodic", hotspot=True),
        ground=jl.Ground(height=ground, reflectance=GROUND, slope=slope),
    )


def lidar_of(pulse):
    """GEDI with a pulse. Its footprint is 25 m wide at 1/e^2."""
    divergence = FOOTPRINT / ALTITUDE * 1e3
    return jl.Lidar(altitude=ALTITUDE, divergence=divergence, aperture=0.8, pulse=pulse, jitter=SMOOTHING)


def common_plan():
    """One plan for all shots, so that they compile once: for the longest pulse and the largest scene."""
    return jl.plan(
        lidar_of(jl.GaussianPulse(fwhm=40.0)),
        scene_of(50.0, -6.0, 25.0),
        max_orders=1,
        window=(-ABOVE, BELOW),
        bin_width=1.0,
        n_rays=256,
        footprint="fixed",
    )


def highest(elevation, waveform, level):
    """Elevation of the uppermost of three samples in a row above `level`; NaN where there are none."""
    above = waveform > level
    lit = np.flatnonzero(above[:-2] & above[1:-1] & above[2:])
    return float(elevation[lit[0]]) if lit.size else np.nan


def guess(shot):
    """Number of the sample of the last mode, and the height (m) of the signal's beginning above it."""
    window = np.hanning(13) / np.hanning(13).sum()
    smooth = np.convolve(shot.signal, window, mode="same")
    inner, level = smooth[1:-1], max(6 * shot.noise_std, 0.2 * smooth.max())
    modes = 1 + np.flatnonzero((inner > smooth[:-2]) & (inner >= smooth[2:]) & (inner > level))
    if modes.size == 0:
        raise ValueError(f"shot {shot.shot_number}: no signal above the noise")
    last = int(modes[-1])
    return last, highest(shot.elevation, shot.signal, 3 * shot.noise_std) - shot.elevation[last]


def fit(shot, progress=None):
    """Fit a shot. Returns the retrieval, the elevation of its reference, and the samples that it saw."""
    last, height = guess(shot)
    number = np.arange(last - ABOVE, last + BELOW + 1)
    if number[0] < 0 or number[-1] >= shot.time.size:
        raise ValueError(f"shot {shot.shot_number}: the record ends within the window about its last mode")
    # Above the canopy there is noise alone.
    quiet = shot.waveform[: max(number[0], 50)]
    signal = shot.waveform[number] - np.mean(quiet)
    noise = np.sqrt(CORRELATED) * np.hypot(np.std(quiet), MODEL_ERROR * np.abs(signal))
    noise[number > last + TAIL] = np.inf
    start = float(np.clip(height - 2.0, 2.0, 35.0))
    unknowns = [
        Unknown(name="ground", bounds=(-3.0, 3.0), prior=(0.0, 1.0), start=0.0, apply=put_ground),
        Unknown(name="canopy height", bounds=(1.0, 42.0), start=start, apply=put_canopy_height),
        Unknown(lambda s: s.ground.slope, bounds=(0.0, 25.0), name="slope", prior=(0.0, 10.0)),
        Unknown(
            name="log density",
            bounds=(np.log(1e-4), np.log(3.0)),
            prior=(np.log(0.03), 0.7),
            start=np.full(LAYERS, np.log(0.05)),
            apply=put_density,
        ),
    ]
    result = inversion.retrieve(
        signal[None, :],
        lidar_of(jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)),
        scene_of(10.0),
        unknowns,
        noise=noise[None, :],
        time=np.arange(-ABOVE, BELOW + 1),
        key=jax.random.key(0),
        plan=common_plan(),
        scale=(0.0, 4.0 * float(np.sum(signal)) / GROUND),
        progress=progress,
    )
    return result, float(shot.elevation[last]), number


def summary(shot, result, reference, number):
    """What is to be compared with the product, and standard errors: elevations (m), plant area index."""
    fitted = float(result.values["scale"]) * np.asarray(result.waveform.reflectance[0])
    ground = reference + float(result.values["ground"])
    height = float(result.values["canopy height"])
    density = np.exp(np.asarray(result.values["log density"]))
    return {
        "ground": (ground, float(result.stderr["ground"])),
        "canopy top": (ground + height, float(result.stderr["canopy height"])),
        "highest return": (highest(shot.elevation[number], fitted, 1.5 * shot.noise_std), np.nan),
        "plant area index": (float(np.mean(density)) * height, np.nan),
    }


def product_answers(path, shot):
    """The product's answers for a shot, by the names of `summary`; empty where it has none."""
    answers = np.load(path)
    (match,) = np.nonzero(answers["shot"] == shot.shot_number)
    names = {"ground": "elev_lowestmode", "highest return": "elev_highest", "plant area index": "pai"}
    return {name: float(answers[field][match[0]]) for name, field in names.items()} if match.size else {}


def draw(shot, result, reference, number, path):
    """Record, fit with its components, residuals and densities against elevation."""
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(9, 5.5), sharey=True, width_ratios=[3, 1, 1], layout="constrained"
    )
    elevation, scale = shot.elevation[number], float(result.values["scale"])
    model = scale * np.asarray(result.waveform.reflectance[0])
    found = summary(shot, result, reference, number)
    signal = shot.signal[number]
    left.plot(signal, elevation, ".", color="0.5", markersize=3, label="recorded")
    for name, label, color in (("leaf", "canopy", "#009e73"), ("ground", "ground", "#d55e00")):
        part = scale * np.asarray(result.waveform.components[name][0])
        left.plot(part, elevation, color=color, label=f"{label} (fit)")
    left.plot(model, elevation, color="black", linewidth=1.2, label="fit")
    for axes in (left, right):
        axes.axhline(found["ground"][0], color="#d55e00", linestyle=":", linewidth=0.8)
        axes.axhline(found["canopy top"][0], color="#009e73", linestyle=":", linewidth=0.8)
    left.set(
        xlabel="signal (counts)", ylabel="elevation above the ellipsoid (m)", title=f"shot {shot.shot_number}"
    )
    left.legend(frameon=False)
    used = np.asarray(result.residuals[0]) != 0
    middle.axvspan(-1, 1, color="0.9")
    middle.plot(np.asarray(result.residuals[0])[used], elevation[used], "k.", markersize=4)
    middle.set(xlabel="residual\n(standard deviations)")
    height = found["canopy top"][0] - found["ground"][0]
    edges = found["ground"][0] + height * np.arange(LAYERS + 1) / LAYERS
    right.stairs(
        np.exp(np.asarray(result.values["log density"])), edges, orientation="horizontal", color="#009e73"
    )
    right.set(xlabel="plant area density\n(m²/m³)", xlim=(0, None))
    left.set_ylim(found["ground"][0] - 6, max(found["highest return"][0], found["canopy top"][0]) + 6)
    with whole_file(path) as draft:
        figure.savefig(draft, format="png", dpi=130)
    plt.close(figure)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="a GEDI L1B file (HDF5)")
    parser.add_argument(
        "--shot", type=int, default=19640521100108408, help="index in the file, or shot number"
    )
    parser.add_argument("--answers", type=Path, help="npz with the product's answers, by shot number")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for the figure")
    options = parser.parse_args(argv)
    (shot,) = read_gedi_l1b(options.file, options.shot)
    result, reference, number = fit(shot)
    found = summary(shot, result, reference, number)
    product = {} if options.answers is None else product_answers(options.answers, shot)
    print(f"shot {shot.shot_number}, {shot.beam}")
    print(f"{'':18}{'fit':>10}{'std. error':>12}{'product':>10}")
    for name, (value, error) in found.items():
        columns = [f"{value:10.2f}", f"{error:12.2f}", f"{product.get(name, np.nan):10.2f}"]
        print(f"{name:18}" + "".join(columns).replace("nan", "  -"))
    print(f"slope {float(result.values['slope']):.1f} degrees, with all else that widens the ground's echo")
    print(f"reduced chi2 {float(result.reduced_chi2):.2f}; {result.status}")
    path = options.out / f"gedi_{shot.shot_number}.png"
    draw(shot, result, reference, number, path)
    print(f"figure: {path}")
    return found, product, result


if __name__ == "__main__":
    main()
    sys.exit(0)
