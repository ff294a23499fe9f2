"""Train a small detector of ground and canopy top on 10,000 labelled waveforms, and compare it with peaks.

    pip install optax
    python examples/detector.py [--side 100] [--steps 600] [--out figures]

A spaceborne lidar looks straight down on a forest over hills, every 3 m. `simulate_many(truth=True)` gives
the waveforms, to order one, and their labels: the mean height of the ground below each footprint, and the
height above which plants intercept 1 % of the beam. The detector is a convolution over samples that answers
with the mean of a distribution over them. It learns from the western footprints, each time with other noise,
and is tested on eastern ones that share no ground with them, beside `inversion.find_ground` and
`inversion.signal_ends`, which were told the pulse and the noise. Half of its 2,000 answers are within 0.08 m
of the ground and 0.28 m of the top; those of the two tools, 0.13 m and 2.1 m, as the end of a signal is not
the top of a canopy.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

import inversion
import jaxlidar as jl
from jaxlidar.io import atomic_write

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ORBIT = jl.Lidar(altitude=4e5, divergence=0.0625, pulse=jl.GaussianPulse(fwhm=15.6))
SPACING, VOXEL, MARGIN = 3.0, 2.0, 30.0
COLOURS = {"leaf": "#009e73", "bark": "#7f4f1f", "ground": "#e69f00"}
# Standard deviation of noise, in peaks of the median waveform.
NOISE = 0.02
# The most eastern share of footprints tests; the footprints' width in between is left out.
TESTED, BATCH, RATE = 0.2, 64, 3e-3


def scene_of(width: float) -> jl.Scene:
    """A forest over hills: a hectare of trees, laid out side by side."""
    at = np.arange(-MARGIN, width + MARGIN + 4.0, 2.0)
    relief = 6.0 * np.sin(at / 23.0)[:, None] + 5.0 * np.cos(at / 31.0 + 0.5)
    hills = jl.Terrain(relief, spacing=2.0, origin=(-MARGIN, -MARGIN), reflectance=0.2)
    trees = jl.forest([jl.broadleaf(), jl.conifer()], density=150.0, area=(100.0, 100.0), individuals=2)
    hectare = jl.voxelise(trees, VOXEL, leaf_area=0.002)
    side = int(np.ceil((width + 2 * MARGIN) / VOXEL))

    def laid_out(table):
        times = -(-side // min(table.shape[:2]))
        return np.tile(np.asarray(table), (times, times, 1))[:side, :side]

    base = (-MARGIN, -MARGIN, float(hectare.origin[2]))
    stand = jl.VoxelMap(laid_out(hectare.leaf), laid_out(hectare.bark), VOXEL, base).above(hills)
    canopy = jl.Canopy(stand, leaf=jl.Prospect(), bark=jl.spectrum("bark-oak"), hotspot=True)
    return jl.Scene(canopy=canopy, ground=hills)


@final
class Detector(eqx.Module):
    """Heights of ground and top from a record, as means of distributions over its samples."""

    layers: list[eqx.nn.Conv1d]

    def __init__(self, key: PRNGKeyArray, channels: int = 12):
        keys, sizes = jax.random.split(key, 5), [1, *[channels] * 4, 2]
        # Ever wider steps: each sample sees 124 m.
        steps = [1, 3, 9, 27, 1]
        self.layers = [
            eqx.nn.Conv1d(before, after, 11 if step < 27 else 21, padding="SAME", dilation=step, key=k)
            for before, after, step, k in zip(sizes, sizes[1:], steps, keys)
        ]

    def __call__(self, record: Float[Array, " bins"], height: Float[Array, " bins"]) -> Float[Array, "2"]:
        """Heights, m, of ground and top."""
        found = record[None]
        for layer in self.layers[:-1]:
            found = jax.nn.gelu(layer(found))
        return jax.nn.softmax(self.layers[-1](found), axis=-1) @ height


def loss_of(detector: Detector, records: Array, height: Array, labels: Array) -> Array:
    """Mean absolute error, m, smooth below half a metre."""
    off = jax.vmap(lambda record: detector(record, height))(records) - labels
    return jnp.mean(jnp.sqrt(off**2 + 0.25) - 0.5)


@eqx.filter_jit
def step_of(optimiser, detector, state, records, height, labels):
    """One step of training."""
    loss, slope = eqx.filter_value_and_grad(loss_of)(detector, records, height, labels)
    change, state = optimiser.update(slope, state)
    return eqx.apply_updates(detector, change), state, loss


def trained(power: np.ndarray, noise: float, height: np.ndarray, labels: np.ndarray, steps: int) -> Detector:
    """A detector that has learned from waveforms, each time with other noise."""
    random, detector = np.random.default_rng(1), Detector(jax.random.key(1))
    optimiser, z = optax.adam(optax.cosine_decay_schedule(RATE, steps), b2=0.99), jnp.asarray(height)
    state = optimiser.init(eqx.filter(detector, eqx.is_array))
    for n in range(steps):
        some = random.integers(0, len(power), BATCH)
        records = power[some] + noise * random.normal(size=(BATCH, power.shape[1]))
        given = jnp.asarray(records / noise / 10.0, height.dtype), z, jnp.asarray(labels[some])
        detector, state, loss = step_of(optimiser, detector, state, *given)
        if n % max(steps // 10, 1) == 0:
            print(f"step {n}: {float(loss):.2f} m", file=sys.stderr)
    return detector


def table_of(errors: dict[str, np.ndarray]) -> str:
    """How far off each detector is, m."""
    lines = [f"{'':34}{'median':>8}{'|.| median':>12}{'|.| 90 %':>10}{'missed':>8}"]
    for name, error in errors.items():
        known = error[np.isfinite(error)]
        off = np.quantile(np.abs(known), (0.5, 0.9))
        missed = 1.0 - known.size / error.size
        lines.append(f"{name:34}{np.median(known):8.2f}{off[0]:12.2f}{off[1]:10.2f}{missed:8.1%}")
    return "\n".join(lines)


def drawn(many: jl.Waveforms, shot: int, record: np.ndarray, found: dict, errors: dict):
    """One record with its labels, and how often errors are how large."""
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 4.0), layout="constrained", width_ratios=(1, 1, 1.3))
    wave = many[shot]
    truth, height = wave.truth, np.asarray(wave.height)
    assert truth is not None
    axes[0].plot(record / record.max(), height, color="0.6", lw=0.8, label="record")
    whole = sum(np.asarray(a[0]) for a in truth.returns.values())
    for name, a in truth.returns.items():
        share = np.asarray(a[0]) / whole.max()
        axes[0].fill_betweenx(height, share, color=COLOURS[name], alpha=0.6, label=name)
    for (name, z), style in zip(found.items(), ("-", "--")):
        axes[0].axhline(z[shot], color="#0072b2", ls=style, lw=1.0, label=name)
    axes[0].set(xlabel="share of the largest", ylabel="height (m)", title="record, returns of order one")
    axes[0].legend(fontsize=7, loc="upper right")
    axes[1].plot(truth.gap_probability, height, color="#0072b2", label="gap probability")
    axes[1].plot(truth.leaf_area_density, height, color=COLOURS["leaf"], label="leaf area density (m²/m³)")
    axes[1].axhline(float(truth.top_height), color="#d55e00", lw=1.0, label="top")
    axes[1].axhline(float(truth.surface_height["ground"]), color="k", lw=1.0, label="ground")
    axes[1].set(xlabel="truth", title="labels of this footprint")
    axes[1].legend(fontsize=7)
    low, high = float(truth.surface_height["ground"]) - 8.0, float(truth.top_height) + 12.0
    for ax in axes[:2]:
        ax.set_ylim(low, high)
    for name, error in errors.items():
        off = np.sort(np.abs(error[np.isfinite(error)]))
        look = {
            "color": "#0072b2" if "ground" in name else "#d55e00",
            "ls": "-" if "detector" in name else "--",
        }
        axes[2].plot(off, np.arange(1, off.size + 1) / error.size, **look, label=name)
    axes[2].set(xlim=(0.0, 6.0), ylim=(0.0, 1.0), xlabel="error below (m)", ylabel="share of footprints")
    axes[2].set_title(f"{error.size} footprints not learned from")
    axes[2].legend(fontsize=7, loc="lower right")
    return figure


def main(given: list[str] | None = None) -> dict[str, np.ndarray]:
    """Simulate, train, test, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=100, help="footprints along each side")
    parser.add_argument("--steps", type=int, default=600, help="of training")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for the figure")
    options = parser.parse_args(given)
    width, started = SPACING * (options.side - 1), time.perf_counter()
    survey = jl.Survey.grid(ORBIT, low=(0.0, 0.0), high=(width, width), spacing=SPACING)
    key = jax.random.key(0)
    many = jl.simulate_many(survey, scene_of(width), key=key, rtol=0.1, max_orders=1, truth=True)
    assert many.truth is not None
    print(f"{len(many)} waveforms with truth: {time.perf_counter() - started:.0f} s", file=sys.stderr)

    height, power = np.asarray(many[0].height), np.asarray(many.reflectance[:, 0])
    noise = NOISE * float(np.median(power.max(axis=1)))
    labels = np.stack([many.truth.surface_height["ground"], many.truth.top_height], axis=-1)
    east = many.position[:, 0]
    border = (1.0 - TESTED) * width
    apart = 2.0 * float(survey.footprint_radius[0])
    # Where next to nothing grows, there is no top to learn from.
    learned = (east < border - min(apart, 0.2 * width)) & np.isfinite(labels).all(axis=1)
    tested = np.flatnonzero((east >= border) & np.isfinite(labels).all(axis=1))
    detector = trained(power[learned], noise, height, labels[learned], options.steps)

    records = power + noise * np.random.default_rng(2).normal(size=power.shape).astype(power.dtype)
    scaled = jnp.asarray(records[tested] / noise / 10.0, height.dtype)
    answers = jax.lax.map(lambda record: detector(record, jnp.asarray(height)), scaled, batch_size=64)
    told = {"pulse": ORBIT.pulse, "noise": noise}
    peaks = inversion.find_ground(height, records[tested], **told)
    tops = inversion.signal_ends(height, records[tested], **told).top
    found = {
        "ground: detector": answers[:, 0],
        "ground: inversion.find_ground": peaks,
        "top: detector": answers[:, 1],
        "top: inversion.signal_ends": tops,
    }
    truths = (labels[tested, 0 if "ground" in name else 1] for name in found)
    errors = {name: np.asarray(a, float) - t for (name, a), t in zip(found.items(), truths)}
    print(table_of(errors))
    shot = int(tested[len(tested) // 3])
    own = {name: {shot: float(a[len(tested) // 3])} for name, a in found.items() if "ground" in name}
    figure = drawn(many, shot, records[shot], own, errors)
    options.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(options.out / "detector.png") as draft:
        figure.savefig(draft, dpi=80, format="png")
    plt.close(figure)
    return errors


if __name__ == "__main__":
    main()
