"""Posterior of seven unknowns by the no-U-turn sampler, beside the standard errors of their fit.

Needs blackjax (`pip install '.[bayes]'`). Random numbers of the simulation are the same at each evaluation;
photons change their paths with the unknowns, so that the density has small jumps, which lower the acceptance.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
from _common import new_figure, number, page_of, seconds, table
from retrieval_coverage import LIDAR, NOISE, RANGES, plan_of, scene_of, unknowns
from tqdm import tqdm

import inversion
import jaxlidar as jl

TITLE = "Posterior of seven unknowns"
QUICK = {"photons": 64, "draws": 20}
STEP_SIZE, DRAWS_AT_ONCE = 0.5, 20
TRUE = {name: 0.45 * low + 0.55 * high for name, (_, (low, high)) in RANGES.items()}


def measure(photons: int = 1024, draws: int = 400) -> dict:
    """Return the fit, the moments of the draws, and the seconds of all steps."""
    import blackjax
    from blackjax.diagnostics import effective_sample_size

    fine = plan_of(8192, max_step=0.05)
    wave = jl.simulate(LIDAR, scene_of(TRUE), key=jax.random.key(0), plan=fine)
    clean = np.asarray(wave.reflectance, float)
    sigma = NOISE * clean.max(axis=1, keepdims=True) * np.ones_like(clean)
    observed = clean + sigma * np.random.default_rng(0).normal(size=clean.shape)
    middle = scene_of({name: 0.5 * (low + high) for name, ((low, high), _) in RANGES.items()})
    key = jax.random.key(1)

    spent: dict[str, float] = {}
    start = time.perf_counter()
    problem = inversion.Problem(
        observed,
        LIDAR,
        middle,
        unknowns(),
        noise=sigma,
        time=wave.time,
        plan=plan_of(photons),
    )
    fit = inversion.retrieve(problem, key=key)
    spent["fit"] = time.perf_counter() - start

    start = time.perf_counter()
    density = inversion.log_density(dataclasses.replace(problem, scene=fit.scene), key=key)
    spent["density"] = time.perf_counter() - start
    first = density.to_unconstrained(fit.values)
    metric = density.to_unconstrained_covariance(fit.covariance, fit.values)
    sampler = blackjax.nuts(density, step_size=STEP_SIZE, inverse_mass_matrix=metric)

    @jax.jit
    def draw_some(state, keys):
        def draw(state, key):
            state, info = sampler.step(key, state)
            return state, (state.position, info.acceptance_rate, info.num_integration_steps)

        return jax.lax.scan(draw, state, keys)

    gradient = jax.jit(jax.grad(lambda x: density(x)))
    keys = jax.random.split(jax.random.key(2), (draws // DRAWS_AT_ONCE, DRAWS_AT_ONCE))
    start = time.perf_counter()
    state = sampler.init(first)
    draw_some = draw_some.lower(state, keys[0]).compile()
    spent["compilation"] = time.perf_counter() - start
    gradient(first)
    spent["gradient"] = min(seconds(gradient, first) for _ in range(5))

    start, blocks = time.perf_counter(), []
    for block_keys in tqdm(keys, unit="block", desc=f"{DRAWS_AT_ONCE} draws a block"):
        state, block = draw_some(state, block_keys)
        blocks.append(jax.tree.map(np.asarray, block))
    spent["sampling"] = time.perf_counter() - start
    positions, acceptance, steps = (np.concatenate(a) for a in zip(*blocks))
    samples = {name: np.asarray(a, float) for name, a in density.to_natural(positions).items()}

    rows = [
        {
            "name": name,
            "true": TRUE[name],
            "fit": float(fit.values[name]),
            "stderr": float(fit.stderr[name]),
            "mean": float(a.mean()),
            "standard deviation": float(a.std()),
            "effective draws": float(effective_sample_size(jnp.asarray(a[None]))),
        }
        for name, a in samples.items()
    ]
    return {
        "photons": photons,
        "draws": len(positions),
        "seconds": spent,
        "acceptance": float(acceptance.mean()),
        "gradients per draw": float(steps.mean()),
        "unknowns": rows,
        "drawn": samples,
    }


def draw(record: dict):
    """Draw the histogram of each unknown, the normal density of its fit, and the truth."""
    figure, axes = new_figure(4, (11, 4.5), 2)
    for ax, row in zip(axes.flat, record["unknowns"]):
        ax.hist(record["drawn"][row["name"]], bins=25, density=True, color="0.75", label="draws")
        x = np.linspace(row["fit"] - 4 * row["stderr"], row["fit"] + 4 * row["stderr"], 200)
        normal = np.exp(-0.5 * ((x - row["fit"]) / row["stderr"]) ** 2)
        ax.plot(
            x, normal / (np.sqrt(2 * np.pi) * row["stderr"]), label="estimate and standard error of the fit"
        )
        ax.axvline(row["true"], color="k", ls="--", lw=1, label="truth")
        ax.set(xlabel=row["name"], yticks=[])
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(*axes.flat[0].get_legend_handles_labels(), loc="center", frameon=False)
    return figure


def section(record: dict) -> str:
    spent = record["seconds"]
    columns = {
        "unknown": "name",
        "truth": lambda r: number(r["true"], 3),
        "fit": lambda r: f"{number(r['fit'], 3)} ± {number(r['stderr'])}",
        "posterior": lambda r: f"{number(r['mean'], 3)} ± {number(r['standard deviation'])}",
        "effective draws": lambda r: f"{r['effective draws']:.0f}",
    }
    return page_of(
        f"A target of `retrieval_coverage.py`, with {record['photons']:,} photons in each of eight batches: "
        "leaf chemistry, heights, leaf area and brightness of the ground, by `inversion.retrieve`, and by "
        f"`inversion.log_density` and the no-U-turn sampler of blackjax, {record['draws']} draws of "
        f"{record['gradients per draw']:.1f} gradients. The covariance of the fit is the sampler's metric, "
        "and nothing is adapted.",
        table(record["unknowns"], columns),
        f"The fit took {number(spent['fit'])} s with its compilation, the compilation of the sampler "
        f"{number(spent['compilation'])} s, and the draws {number(spent['sampling'])} s: "
        f"{number(1e3 * spent['gradient'])} ms a gradient. {100 * record['acceptance']:.0f} % of the steps "
        "were accepted.",
    )
