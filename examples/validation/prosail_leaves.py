"""PROSPECT against prosail: reflectance and transmittance of leaves from 400 to 2500 nm.

    python examples/validation/prosail_leaves.py [--out figures] [--leaves 100]

Leaves of random traits by versions D and 5 (which prosail stores in single precision), with rays that arrive
within 40 and 59 degrees, in single and in double precision. Both codes have the same coefficients, so that
only arithmetic differs: the exponential integral and the recursion of the plates.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import prosail
from _validation import COLOURS, comparison, finish, options, with_progress

import jaxlidar as jl

BANDS = np.arange(400.0, 2501.0)
# Rounding, and the single precision of the tables of version 5 in prosail.
BOUND = {("D", "float64"): 1e-12, ("5", "float64"): 1e-7, ("D", "float32"): 1e-6, ("5", "float32"): 1e-6}
KINDS = [(version, alpha, precision) for version, precision in BOUND for alpha in (40.0, 59.0)]


def random_traits(version, count):
    """Return random traits, by name."""
    random, high = np.random.default_rng(0), {"Cab": 90, "Car": 20, "Cbrown": 0.5, "Cw": 0.04, "Cm": 0.02}
    if version == "D":
        high |= {"Cant": 10}
    return {"N": random.uniform(1, 3, count), **{n: random.uniform(0, h, count) for n, h in high.items()}}


def by_prosail(trait_values, version, alpha):
    """Return R and T by prosail, of shape (2, leaves, bands)."""
    names = {name: "ant" if name == "Cant" else name.lower() for name in trait_values}
    extra = {} if "Cant" in trait_values else {"ant": 0.0}
    leaves = [dict(zip(names.values(), values)) | extra for values in zip(*trait_values.values())]
    runs = [prosail.run_prospect(**leaf, prospect_version=version, alpha=alpha)[1:] for leaf in leaves]
    return np.moveaxis(np.array(runs), 1, 0)


def main(argv=None):
    arguments = options(__doc__, argv, leaves=100)
    rows, largest_differences = [], {}
    for version, alpha, precision in with_progress(arguments, KINDS):
        content = random_traits(version, arguments.leaves)
        exact = by_prosail(content, version, alpha)
        with jax.enable_x64(precision == "float64"):
            make = jax.vmap(lambda t, v=version, a=alpha: jl.Prospect(**t, version=v, alpha=a))
            leaves = make({name: jnp.asarray(v) for name, v in content.items()})
            spectra = np.stack([np.asarray(s, float) for s in leaves(BANDS)])
        kind, incidence = f"version {version}, {precision}", f"{alpha:g} degrees"
        largest_differences[f"{kind}, {incidence}"] = np.abs(spectra - exact).max(axis=1)
        for name, our_values, prosail_values in zip(("reflectance", "transmittance"), spectra, exact):
            position = np.unravel_index(np.argmax(np.abs(our_values - prosail_values)), our_values.shape)
            values = our_values[position], prosail_values[position]
            what, case, bound = f"leaf spectra, {kind}", f"{name}, {incidence}", BOUND[version, precision]
            rows.append(
                comparison(what, "prosail", case, *values, bound=bound, wavelength=float(BANDS[position[1]]))
            )

    def draw(figure):
        for ax, name, number in zip(
            figure.subplots(1, 2, sharey=True), ("reflectance", "transmittance"), (0, 1)
        ):
            for (case, largest), colour in zip(largest_differences.items(), (*COLOURS, "0.5")):
                ax.semilogy(BANDS, np.maximum(largest[number], 1e-18), color=colour, lw=0.7, label=case)
            ax.set(title=name, xlabel="wavelength (nm)")
        ax.figure.axes[0].set_ylabel(f"largest difference of {arguments.leaves} leaves")
        ax.legend(fontsize=7)

    return finish(
        arguments,
        "prosail_leaves",
        rows,
        title="PROSPECT against prosail",
        caption="""The largest difference of all leaves, wavelength by wavelength. It is that of stored
        tables and of rounding; no band and no version has another formula.""",
        unchecked="""Both compute the same published model from the same coefficients: whether leaves obey it
        is for the measured leaves below to say.""",
        draw=draw,
        size=(11.0, 4.5),
        packages=["prosail"],
        leaves=arguments.leaves,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
