"""Posterior of seven unknowns by the no-U-turn sampler, beside the standard errors of their fit.

Run it as `python examples/benchmarks/posterior_sampling.py [--out figures] [--photons 1024] [--draws 400]`.

A target of `retrieval_coverage.py`, layers of leaves over ground at three wavelengths, has noise of 2 % of
the peak of each wavelength. Leaf chemistry, two heights, leaf area and the ground's brightness are fitted by
`inversion.retrieve` and sampled by `inversion.log_density` and blackjax (`pip install '.[bayes]'`). The
covariance of the fit is the metric of the sampler, whose step is fixed: nothing is adapted. Random numbers of
the simulation are the same at each evaluation; photons change their paths with the unknowns, so that the
density has small jumps, which lower the acceptance.
"""

import dataclasses
import time

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from _common import machine, new_figure, options, print_table, save_figure, seconds, write_json
from blackjax.diagnostics import effective_sample_size
from retrieval_coverage import LIDAR, NOISE, RANGES, plan_of, scene_of, unknowns
from tqdm import trange

import inversion
import jaxlidar as jl

STEP_SIZE, DRAWS_AT_ONCE = 0.5, 20
TRUE = {name: 0.45 * low + 0.55 * high for name, (_, (low, high)) in RANGES.items()}


def main() -> None:
    arguments = options("Posterior of seven unknowns.", photons=1024, draws=400)
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
        plan=plan_of(arguments.photons),
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
    keys = jax.random.split(jax.random.key(2), (arguments.draws // DRAWS_AT_ONCE, DRAWS_AT_ONCE))
    start = time.perf_counter()
    state = sampler.init(first)
    draw_some = draw_some.lower(state, keys[0]).compile()
    spent["compilation"] = time.perf_counter() - start
    gradient(first)
    spent["gradient"] = min(seconds(gradient, first) for _ in range(5))

    start, blocks = time.perf_counter(), []
    for number in trange(len(keys), unit="block", desc=f"{DRAWS_AT_ONCE} draws a block"):
        state, block = draw_some(state, keys[number])
        blocks.append(jax.tree.map(np.asarray, block))
    spent["sampling"] = time.perf_counter() - start
    positions, acceptance, steps = (np.concatenate(a) for a in zip(*blocks))
    draws = {name: np.asarray(a, float) for name, a in density.to_natural(positions).items()}

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
        for name, a in draws.items()
    ]
    print_table(tuple(rows[0]), [tuple(r.values()) for r in rows])
    record = {
        "machine": machine(),
        "photons": arguments.photons,
        "draws": len(positions),
        "seconds": spent,
        "acceptance": float(acceptance.mean()),
        "gradients per draw": float(steps.mean()),
        "unknowns": rows,
    }
    print(
        f"{spent}; acceptance {record['acceptance']:.2f}, {record['gradients per draw']:.1f} gradients a draw"
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out / "posterior_sampling.json", record)
    save_figure(posteriors(draws, rows), arguments.out / "posterior_sampling.png")


def posteriors(draws: dict[str, np.ndarray], rows: list[dict]):
    """Draw the histogram of each unknown, the normal density of its fit, and the truth."""
    figure, axes = new_figure(4, (11, 4.5), 2)
    for ax, row in zip(axes.flat, rows):
        values = draws[row["name"]]
        ax.hist(values, bins=25, density=True, color="0.75", label="draws")
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


if __name__ == "__main__":
    main()
