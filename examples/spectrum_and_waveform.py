"""A spectrum and a waveform, fitted at once: what each tells of chlorophyll and leaf area.

Run it as `python examples/spectrum_and_waveform.py`. The same canopy is seen by Sentinel-2, in ten bands, and
by a spaceborne lidar at 1064 nm. Bands tell chlorophyll by the red edge. Their leaf area is uncertain, as it
saturates and as leaves and soil change the near infrared too. The waveform separates ground and canopy by
height, and tells leaf area from the light that each returns, but nothing of chlorophyll.

`jaxlidar.reflectance_factor` and `jaxlidar.simulate` trace one scene, so that both records are functions of
the same six unknowns: leaf area index, chlorophyll, leaf structure, water and dry matter of PROSPECT, and the
brightness of the soil. The residuals of both, and of the priors, are stacked and fitted by least squares with
their exact Jacobian. Standard errors are those of its inverse.

**Assumptions.** The shape of the profile, the leaf angles (spherical) and the soil's spectrum up to a factor
are known. Errors of bands are independent, 3 % of the reflectance and 0.003, and there is no error of the
atmosphere. Noise of the waveform is 2 % of its peak.

**Response functions.** Those of Sentinel-2A as ESA measured them (COPE-GSEG-EOPG-TN-15-0007), from the
package pyrsr, if it is installed (`pip install pyrsr`; Apache 2.0). Else Gaussians of the central wavelengths
and widths that ESA publishes for the instrument.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy import optimize

import jaxlidar as jl
from jaxlidar.io import atomic_write

# Bands of Sentinel-2A: central wavelength and full width at half maximum, nm.
BANDS = {
    "2": (492.4, 66.0),
    "3": (559.8, 36.0),
    "4": (664.6, 31.0),
    "5": (704.1, 15.0),
    "6": (740.5, 15.0),
    "7": (782.8, 20.0),
    "8": (832.8, 106.0),
    "8A": (864.7, 21.0),
    "11": (1613.7, 91.0),
    "12": (2202.4, 175.0),
}
# Wavelengths of each band, and how far they reach in widths.
SAMPLES, REACH = 15, 1.2
LAYERS, TOP = 6, 13.0
ANGLES = {"sun": (35.0, 150.0), "view": (5.0, 100.0)}
PHOTONS, WINDOW = 8192, (-110.0, 40.0)
# Errors: of bands relative and absolute, and of the waveform over its peak.
BAND_ERROR, BAND_FLOOR, WAVEFORM_ERROR = 0.03, 0.003, 0.02
LIDAR = {"altitude": 4e5, "divergence": 0.06}
COLOURS = {"spectrum": "#D55E00", "waveform": "#0072B2", "both": "#000000"}


class Quantity(NamedTuple):
    """An unknown: its true value, bounds, and normal prior as mean and standard deviation, or None."""

    truth: float
    low: float
    high: float
    prior: tuple[float, float] | None


UNKNOWNS = {
    "leaf area index": Quantity(2.5, 0.1, 8.0, (3.0, 2.0)),
    "chlorophyll": Quantity(45.0, 5.0, 100.0, (40.0, 20.0)),
    "structure": Quantity(1.6, 1.0, 3.0, (1.5, 0.25)),
    "water": Quantity(0.013, 0.002, 0.05, (0.015, 0.006)),
    "dry matter": Quantity(0.008, 0.002, 0.02, (0.009, 0.003)),
    "soil brightness": Quantity(0.9, 0.2, 1.8, (1.0, 0.25)),
}


def response_functions() -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], str]:
    """Return wavelengths and weights of each band, which sum to one, and where they are from."""
    grids = {
        name: centre + REACH * width * np.linspace(-1, 1, SAMPLES) for name, (centre, width) in BANDS.items()
    }
    try:
        from pyrsr import RSR
    except ImportError:
        source = "Gaussians of published centres and widths"
        responses = {
            name: np.exp(-4 * np.log(2) * ((grids[name] - centre) / width) ** 2)
            for name, (centre, width) in BANDS.items()
        }
    else:
        source, measured = "measured responses", RSR("Sentinel-2A", "MSI")
        responses = {name: np.interp(grid, measured.rsrs_wvl, measured[name]) for name, grid in grids.items()}
    return {name: (grids[name], value / value.sum()) for name, value in responses.items()}, source


def scene_at(x: jax.Array, soil: np.ndarray) -> jl.Scene:
    """Return the scene of the unknowns, with the soil's reflectance at the wavelengths of a sensor."""
    area, chlorophyll, structure, water, dry_matter, brightness = x
    # More leaves above than below.
    shape = np.linspace(0.5, 1.5, LAYERS) / LAYERS
    density = area * shape.reshape(1, 1, LAYERS) / 2.0
    voxels = jl.VoxelMap.from_lad(density, voxel_size=(40.0, 40.0, 2.0), origin=(-20.0, -20.0, 1.0))
    leaf = jl.Prospect(N=structure, Cab=chlorophyll, Cw=water, Cm=dry_matter)
    canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic")
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=brightness * soil))


def make_models() -> tuple[dict[str, Callable[[jax.Array, jax.Array], jax.Array]], np.ndarray, str]:
    """Return the records of each sensor as functions of unknowns and a random key, and two properties.

    These are the times of the waveform's samples, and the source of the response functions.
    """
    responses, source = response_functions()
    # One trace serves all wavelengths, those of overlapping bands once.
    wavelengths = np.unique(np.concatenate([grid for grid, _ in responses.values()]))
    to_bands = np.zeros((len(BANDS), wavelengths.size))
    for row, (grid, weights) in zip(to_bands, responses.values()):
        row[np.searchsorted(wavelengths, grid)] = weights
    spectrum_of_soil, truth = jl.spectrum("soil-medium"), truth_vector()
    soil, lidar = (
        np.asarray(spectrum_of_soil(wavelengths)),
        jl.Lidar(pulse=jl.GaussianPulse(fwhm=14.0), **LIDAR),
    )
    lidar_soil = np.asarray(spectrum_of_soil(np.asarray(lidar.wavelength)))
    passive = {**ANGLES, "wavelengths": wavelengths}
    spectrum_plan = jl.plan_reflectance(scene_at(truth, soil), n_photons=PHOTONS, **passive)
    lidar_scene = scene_at(truth, lidar_soil)
    plan = jl.plan(lidar, lidar_scene, window=WINDOW, n_photons=8 * PHOTONS)

    def bands(x: jax.Array, key: jax.Array) -> jax.Array:
        factor = jl.reflectance_factor(scene_at(x, soil), plan=spectrum_plan, key=key, **passive)
        return jnp.asarray(to_bands, x.dtype) @ factor.reflectance

    def waveform(x: jax.Array, key: jax.Array) -> jax.Array:
        return jl.simulate(lidar, scene_at(x, lidar_soil), key=key, plan=plan).reflectance[0]

    times = plan.sample_start + plan.sample_interval * np.arange(plan.n_samples)
    return {"spectrum": bands, "waveform": waveform}, times, source


def truth_vector() -> jax.Array:
    """Return the true values."""
    return jnp.asarray([quantity.truth for quantity in UNKNOWNS.values()])


class Posterior(NamedTuple):
    """Estimate (n,) of the unknowns, and its covariance (n, n)."""

    estimate: np.ndarray
    covariance: np.ndarray

    @property
    def stderr(self) -> np.ndarray:
        """Standard errors (n,)."""
        return np.sqrt(np.diag(self.covariance))


class JointProblem(NamedTuple):
    """Models of the records with their compiled Jacobians, noise-free records, and standard deviations."""

    models: dict[str, Callable[[jax.Array], tuple[jax.Array, jax.Array]]]
    records: dict[str, np.ndarray]
    noise: dict[str, np.ndarray]
    times: np.ndarray
    source: str


def make_problem() -> JointProblem:
    """Compile the models, and simulate the true records with other random numbers than those of fits."""
    models, times, source = make_models()
    fit_key, truth_key = jax.random.split(jax.random.key(0))

    def with_jacobian(model: Callable) -> Callable:
        def record(x: jax.Array) -> tuple[jax.Array, jax.Array]:
            value = model(x, fit_key)
            return value, value

        # One pass for the record and all of its derivatives.
        compiled = jax.jit(jax.jacfwd(record, has_aux=True))
        return lambda x: compiled(jnp.asarray(x, float))[::-1]

    records = {
        name: np.asarray(jax.jit(model)(truth_vector(), truth_key), float) for name, model in models.items()
    }
    noise = {
        "spectrum": np.hypot(BAND_ERROR * records["spectrum"], BAND_FLOOR),
        "waveform": np.full(records["waveform"].size, WAVEFORM_ERROR * records["waveform"].max()),
    }
    jacobians = {name: with_jacobian(model) for name, model in models.items()}
    return JointProblem(jacobians, records, noise, times, source)


def noisy_records(problem: JointProblem, seed: int) -> dict[str, np.ndarray]:
    """Return one draw of the records with noise."""
    random = np.random.default_rng(seed)
    return {
        name: record + problem.noise[name] * random.normal(size=record.size)
        for name, record in problem.records.items()
    }


def fit(problem: JointProblem, observed: dict[str, np.ndarray]) -> Posterior:
    """Fit the records that are given, together with the priors, by least squares.

    Unknowns are in widths of their bounds, so that all have the same scale.
    """
    quantities = list(UNKNOWNS.values())
    low, high = (np.array([getattr(q, end) for q in quantities]) for end in ("low", "high"))
    width = high - low
    mean, deviation = (np.array([q.prior[i] for q in quantities]) for i in (0, 1))

    def stacked(fraction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals over their standard deviations, and the Jacobian of these."""
        x = low + fraction * width
        residuals, rows = [(x - mean) / deviation], [np.diag(width / deviation)]
        for name, record in observed.items():
            value, jacobian = (np.asarray(a, float) for a in problem.models[name](x))
            residuals.append((value - record) / problem.noise[name])
            rows.append(jacobian * width / problem.noise[name][:, None])
        return np.concatenate(residuals), np.concatenate(rows)

    # The optimiser asks for residuals and Jacobian apart, at the same place.
    last: dict[bytes, Any] = {}

    def part(index: int) -> Callable[[np.ndarray], np.ndarray]:
        def compute(fraction: np.ndarray) -> np.ndarray:
            place = fraction.tobytes()
            if place not in last:
                last.clear()
                last[place] = stacked(fraction)
            return last[place][index]

        return compute

    start = np.clip((mean - low) / width, 0.02, 0.98)
    solution = optimize.least_squares(part(0), start, part(1), bounds=(0.0, 1.0), xtol=1e-6, ftol=1e-8)
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    return Posterior(low + solution.x * width, covariance * np.outer(width, width))


def run(problem: JointProblem, seed: int = 0) -> dict[str, Posterior]:
    """Fit the spectrum, the waveform, and both."""
    observed = noisy_records(problem, seed)
    choices = {"spectrum": ("spectrum",), "waveform": ("waveform",), "both": ("spectrum", "waveform")}
    return {label: fit(problem, {name: observed[name] for name in names}) for label, names in choices.items()}


def draw(problem: JointProblem, posteriors: dict[str, Posterior], seed: int = 0) -> Figure:
    """Draw the two records, and the posteriors of leaf area and chlorophyll."""
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.5), layout="constrained")
    left, middle, right = axes
    observed = noisy_records(problem, seed)
    centres = [centre for centre, _ in BANDS.values()]
    left.errorbar(
        centres, observed["spectrum"], problem.noise["spectrum"], fmt="o", color="0.4", ms=4, label="record"
    )
    height = -0.149896229 * problem.times
    middle.plot(1e3 * observed["waveform"], height, ".", color="0.4", ms=3, label="record")
    x = posteriors["both"].estimate
    spectrum, waveform = (np.asarray(problem.models[name](x)[0]) for name in ("spectrum", "waveform"))
    left.plot(centres, spectrum, "_", ms=12, color="k", label="fit of both")
    middle.plot(1e3 * waveform, height, "k", lw=1.2, label="fit of both")
    left.set(xlabel="wavelength (nm)", ylabel="reflectance factor", ylim=(0, None))
    middle.set(xlabel="apparent reflectance per ns (1e-3)", ylabel="height (m)", ylim=(-5, 17))
    names = list(UNKNOWNS)
    pair = [names.index("leaf area index"), names.index("chlorophyll")]
    for label, posterior in posteriors.items():
        covariance = posterior.covariance[np.ix_(pair, pair)]
        variances, vectors = np.linalg.eigh(covariance)
        angle = np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1]))
        # Two standard deviations along each axis hold 86 % of a normal posterior.
        sizes = 4 * np.sqrt(variances[::-1])
        shape = {"angle": angle, "fill": False, "edgecolor": COLOURS[label], "lw": 1.6}
        right.add_patch(Ellipse(posterior.estimate[pair], *sizes, label=label, **shape))
    right.plot(*np.asarray(truth_vector())[pair], "k+", ms=10, label="truth")
    right.set(xlabel="leaf area index", ylabel="chlorophyll (µg/cm²)", xlim=(1.5, 3.5), ylim=(0, 90))
    for ax in axes:
        ax.legend(frameon=False, fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> tuple[JointProblem, dict[str, Posterior]]:
    """Fit, print estimates, and draw the figure `spectrum_and_waveform.png`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default=".", type=Path, help="folder of the figure")
    folder = parser.parse_args(arguments).out
    problem = make_problem()
    posteriors = run(problem)
    print(f"bands: {problem.source}")
    print(f"{'':16} {'truth':>8}", *(f"{label:>19}" for label in posteriors))
    for i, (name, quantity) in enumerate(UNKNOWNS.items()):
        cells = [f"{p.estimate[i]:8.4g} +- {p.stderr[i]:7.2g}" for p in posteriors.values()]
        print(f"{name:16} {quantity.truth:8.4g}", *cells)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / "spectrum_and_waveform.png") as draft:
        draw(problem, posteriors).savefig(draft, dpi=80, format="png")
    return problem, posteriors


if __name__ == "__main__":
    main()
