"""A record with two explanations: ground, or a shrub above it. Run it as `python examples/bimodal.py`.

Shrubs 1.5 m high stand on level ground and reflect as much as it does. A pulse of 12 ns, 1.8 m long, does not
resolve the two. One strong echo at 0 m means either bare ground there, or shrubs that hide nearly all of the
ground 1.5 m below. The posterior density of the height of the ground and the cover of the shrubs has two
modes, with a deep valley between them. The truth is a cover of 0.9.

Compared are

- `inversion.retrieve`, from two starts: each ends in the nearest mode, and its standard errors are those of
  the mode;
- the no-U-turn sampler from one start, which stays in its mode;
- sequential Monte Carlo with tempering (Del Moral et al. 2006, J. R. Stat. Soc. B 68, 411), which begins with
  particles of the uniform prior and raises the likelihood to powers from 0 to 1: particles are in both modes
  before the valley deepens;
- the integral of the density over a grid, which is possible for two unknowns, and true.

The samplers are those of blackjax (`pip install '.[bayes]'`). It takes less than a minute.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from blackjax.smc import adaptive_tempered, resampling
from matplotlib.figure import Figure

import inversion
import jaxlidar as jl
from jaxlidar.io import atomic_write

HEIGHT, REFLECTANCE = 1.5, 0.3
TRUTH = {"ground": -1.5, "cover": 0.9}
# Noise over the peak of the record.
NOISE = 0.1
# Between the two modes, m.
VALLEY = -0.75
LIDAR = {"altitude": 4e5, "divergence": 0.06}
OPTIONS = {"max_orders": 1, "n_rays": 16}
WINDOW = (-30.0, 35.0)
KEY = jax.random.key(1)


def shrubs(ground: float, cover: float) -> jl.Scene:
    """Return shrubs over level ground."""
    plate = jl.Plate(height=ground + HEIGHT, reflectance=REFLECTANCE, coverage=cover)
    return jl.Scene(ground=jl.Ground(height=ground, reflectance=REFLECTANCE), plates=(plate,))


def with_ground(scene: jl.Scene, ground: jax.Array) -> jl.Scene:
    """Return the scene with its ground at another height, and the shrubs on it."""
    heights = (ground, ground + HEIGHT)
    return eqx.tree_at(lambda s: (s.ground.height, s.plates[0].height), scene, heights)


# The ground is known to 1 m from elsewhere, the cover is not.
UNKNOWNS = [
    inversion.Unknown(apply=with_ground, name="ground", bounds=(-5.0, 3.0), start=-0.75, prior=(-0.5, 1.0)),
    inversion.Unknown("plates[0].coverage", bounds=(0.0, 1.0), name="cover", start=0.5),
]


class Posterior(NamedTuple):
    """A noisy record with its unknowns, and their log-posterior."""

    problem: inversion.Problem
    density: inversion.LogDensity


def make_posterior(seed: int = 3) -> Posterior:
    """Simulate the record and make the density of its unknowns."""
    lidar = jl.Lidar(pulse=jl.GaussianPulse(fwhm=12.0), **LIDAR)
    scene = shrubs(**TRUTH)
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), window=WINDOW, **OPTIONS)
    noise = NOISE * float(jnp.max(wave.reflectance))
    deviates = np.random.default_rng(seed).normal(size=wave.reflectance.shape)
    record = np.asarray(wave.reflectance) + noise * deviates
    problem = inversion.Problem(record, lidar, scene, UNKNOWNS, noise=noise, time=wave.time, **OPTIONS)
    return Posterior(problem, inversion.log_density(problem, key=KEY))


def fit(posterior: Posterior, ground: float, cover: float) -> inversion.Retrieval:
    """Return the fit from a start."""
    start = {"ground": ground, "cover": cover}
    return inversion.retrieve(dataclasses.replace(posterior.problem, start=start), key=KEY)


def on_grid(posterior: Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Return heights of the ground, and their posterior probabilities, integrated over a grid of covers."""
    ground, cover = np.linspace(-2.2, 0.6, 281), (np.arange(80) + 0.5) / 80
    values = dict(zip(("ground", "cover"), np.meshgrid(ground, cover, indexing="ij")))
    x = posterior.density.to_unconstrained(values)
    log_density = jax.jit(lambda x: jax.lax.map(posterior.density, x, batch_size=256))(x.reshape(-1, 2))
    # The density is one of coordinates; that of values lacks the derivatives of one by the other.
    log_density -= jnp.sum(jax.nn.log_sigmoid(x) + jax.nn.log_sigmoid(-x), axis=-1).ravel()
    weight = np.asarray(jax.nn.softmax(log_density)).reshape(ground.size, cover.size).sum(axis=1)
    return ground, weight


def sample_nuts(posterior: Posterior, start: jax.Array, key: jax.Array, draws: int = 400) -> np.ndarray:
    """Return heights of the ground (draws,) from a chain of the no-U-turn sampler."""
    adaptation = blackjax.window_adaptation(blackjax.nuts, posterior.density)
    adaptation_key, chain_key = jax.random.split(key)
    (state, settings), _ = adaptation.run(adaptation_key, start, 300)
    step = blackjax.nuts(posterior.density, **settings).step
    keys = jax.random.split(chain_key, draws)
    positions = jax.lax.scan(lambda state, key: (step(key, state)[0],) * 2, state, keys)[1].position
    return np.asarray(posterior.density.to_natural(positions)["ground"])


def sample_tempered(
    posterior: Posterior, scale: np.ndarray, key: jax.Array, islands: int = 8, particles: int = 600
) -> np.ndarray:
    """Return heights of the ground (islands, particles) by tempered sequential Monte Carlo.

    Islands are independent of one another, so that their scatter shows the error. The share of a mode in one
    is biased by the inverse of the number of its particles: hundreds are needed.

    `scale`: standard deviations (2,) of a mode in coordinates, from which the random walk has its lengths.
    """
    random_walk = blackjax.additive_step_random_walk.build_kernel()

    def log_prior(x):
        # Uniform within the bounds. Normal priors are part of what is tempered.
        return jnp.sum(jax.nn.log_sigmoid(x) + jax.nn.log_sigmoid(-x))

    def step(key, state, log_density, lengths):
        return random_walk(key, state, log_density, blackjax.mcmc.random_walk.normal(lengths))

    kernel = jax.jit(
        adaptive_tempered.build_kernel(
            log_prior,
            lambda x: posterior.density(x) - log_prior(x),
            step,
            blackjax.additive_step_random_walk.init,
            resampling.systematic,
            target_ess=0.5,
        ),
        static_argnums=2,
    )
    samples = []
    for island_key in jax.random.split(key, islands):
        start_key, end_key, *keys = jax.random.split(island_key, 102)
        uniform = jax.random.uniform(start_key, (particles, 2), minval=1e-6, maxval=1.0 - 1e-6)
        state = adaptive_tempered.init(jnp.log(uniform) - jnp.log1p(-uniform))
        for step_key in keys:
            if float(state.tempering_param) >= 1.0:
                break
            # A tempered mode is wider.
            widening = min(max(float(state.tempering_param), 1e-4) ** -0.5, 20.0)
            state, _ = kernel(step_key, state, 10, {"lengths": jnp.asarray(widening * scale)[None]})
        if float(state.tempering_param) < 1.0:
            raise RuntimeError(f"tempering has not come to its end in {len(keys)} steps")
        # Weights lead from the last power but one to the likelihood itself.
        chosen = resampling.systematic(end_key, state.weights, particles)
        samples.append(np.asarray(posterior.density.to_natural(state.particles[chosen])["ground"]))
    return np.stack(samples)


def scale_of(posterior: Posterior, retrieval: inversion.Retrieval) -> np.ndarray:
    """Return the standard errors (2,) of a fit in coordinates of the density."""
    ends = [
        posterior.density.to_unconstrained(
            {
                name: float(value) + sign * 0.1 * float(retrieval.stderr[name])
                for name, value in retrieval.values.items()
            }
        )
        for sign in (-1.0, 1.0)
    ]
    return np.asarray(ends[1] - ends[0]) / 0.2


class Results(NamedTuple):
    """Fits from two starts, and heights of the ground: on a grid with probabilities, and of two samplers."""

    posterior: Posterior
    fits: list[inversion.Retrieval]
    grid: np.ndarray
    probability: np.ndarray
    nuts: np.ndarray
    tempered: np.ndarray


def run() -> Results:
    """Fit, integrate and sample."""
    posterior = make_posterior()
    fits = [fit(posterior, ground=-1.5, cover=0.8), fit(posterior, ground=0.0, cover=0.2)]
    grid, probability = on_grid(posterior)
    start = posterior.density.to_unconstrained({k: np.asarray(v) for k, v in fits[0].values.items()})
    nuts = sample_nuts(posterior, start, jax.random.key(2))
    tempered = sample_tempered(posterior, scale_of(posterior, fits[0]), jax.random.key(3))
    return Results(posterior, fits, grid, probability, nuts, tempered)


def draw(results: Results) -> Figure:
    """Draw the record with its two explanations, and the posterior of the ground by each method."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    problem = results.posterior.problem
    observed, time = np.asarray(problem.observed)[0], np.asarray(problem.time)
    height = -0.149896229 * time
    left.plot(1e3 * observed, height, ".", color="0.5", ms=4, label="record")
    for retrieval, colour, style in zip(results.fits, ("#0072B2", "#D55E00"), ("-", "--")):
        values = {name: float(value) for name, value in retrieval.values.items()}
        label = f"ground {values['ground']:.2f} m, cover {values['cover']:.2f}"
        left.plot(
            1e3 * np.asarray(retrieval.waveform.reflectance[0]), height, style, color=colour, label=label
        )
        left.axhline(values["ground"], color=colour, lw=0.6, ls=style)
    left.set(xlabel="apparent reflectance per ns (1e-3)", ylabel="height (m)", ylim=(-4.0, 3.0))
    left.legend(frameon=False, fontsize=8, loc="upper right")
    spacing = float(results.grid[1] - results.grid[0])
    bins = np.arange(-2.0, 0.5, 0.04)
    right.hist(results.tempered.ravel(), bins, density=True, color="#009E73", alpha=0.5, label="tempered SMC")
    right.hist(results.nuts, bins, density=True, histtype="step", color="#CC79A7", label="NUTS, one start")
    right.plot(results.grid, results.probability / spacing, "k", lw=1.2, label="grid")
    right.set(xlabel="height of the ground (m)", ylabel="posterior density (1/m)", xlim=(-2.0, 0.5))
    right.legend(frameon=False, fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> Results:
    """Compare the methods, and draw the figure `bimodal.png`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default=".", type=Path, help="folder of the figure")
    folder = parser.parse_args(arguments).out
    results = run()
    for retrieval in results.fits:
        rows = [
            f"{k} {float(v):.2f} +- {float(retrieval.stderr[k]):.2f}" for k, v in retrieval.values.items()
        ]
        print("retrieve:", ", ".join(rows))
    by_island = np.mean(results.tempered < VALLEY, axis=1)
    error = float(np.std(by_island, ddof=1)) / np.sqrt(by_island.size)
    print("probability that the ground is the lower one:")
    print(f"  grid          {results.probability[results.grid < VALLEY].sum():.3f}")
    print(f"  NUTS          {np.mean(results.nuts < VALLEY):.3f}")
    print(f"  tempered SMC  {by_island.mean():.3f} +- {error:.3f}")
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / "bimodal.png") as draft:
        draw(results).savefig(draft, dpi=80, format="png")
    return results


if __name__ == "__main__":
    main()
