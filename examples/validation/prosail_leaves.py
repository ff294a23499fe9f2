"""PROSPECT against prosail: reflectance and transmittance of leaves from 400 to 2500 nm.

    python examples/validation/prosail_leaves.py [--out figures] [--leaves 100]

Leaves of random traits by versions D and 5 (which prosail stores in single precision), with rays that
fall on within 40 and 59 degrees, in single and in double precision. Both codes have the same coefficients,
so what differs is arithmetic: the exponential integral and the recursion of the plates.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import prosail
from _validation import COLOURS, finish, options, row, steps

import jaxlidar as jl

BANDS = np.arange(400.0, 2501.0)
# Rounding, and that of prosail's tables of version 5.
BOUND = {("D", "float64"): 1e-12, ("5", "float64"): 1e-7, ("D", "float32"): 1e-6, ("5", "float32"): 1e-6}
KINDS = [(version, alpha, precision) for version, precision in BOUND for alpha in (40.0, 59.0)]


def traits(version, count):
    """Random traits, by name."""
    random, high = np.random.default_rng(0), {"Cab": 90, "Car": 20, "Cbrown": 0.5, "Cw": 0.04, "Cm": 0.02}
    if version == "D":
        high |= {"Cant": 10}
    return {"N": random.uniform(1, 3, count), **{n: random.uniform(0, h, count) for n, h in high.items()}}


def theirs(given, version, alpha):
    """R and T by prosail: (2, leaves, bands)."""
    names = {name: "ant" if name == "Cant" else name.lower() for name in given}
    extra = {} if "Cant" in given else {"ant": 0.0}
    leaves = [dict(zip(names.values(), values)) | extra for values in zip(*given.values())]
    runs = [prosail.run_prospect(**leaf, prospect_version=version, alpha=alpha)[1:] for leaf in leaves]
    return np.moveaxis(np.array(runs), 1, 0)


def main(argv=None):
    given = options(__doc__, argv, leaves=100)
    rows, off = [], {}
    for version, alpha, precision in steps(given, KINDS):
        content = traits(version, given.leaves)
        exact = theirs(content, version, alpha)
        with jax.enable_x64(precision == "float64"):
            make = jax.vmap(lambda t, v=version, a=alpha: jl.Prospect(**t, version=v, alpha=a))
            leaves = make({name: jnp.asarray(v) for name, v in content.items()})
            found = np.stack([np.asarray(s, float) for s in jl.prospect_spectra(leaves, BANDS)])
        kind, incidence = f"version {version}, {precision}", f"{alpha:g} degrees"
        off[f"{kind}, {incidence}"] = np.abs(found - exact).max(axis=1)
        for name, ours, other in zip(("reflectance", "transmittance"), found, exact):
            at = np.unravel_index(np.argmax(np.abs(ours - other)), ours.shape)
            values = ours[at], other[at]
            what, case, bound = f"leaf spectra, {kind}", f"{name}, {incidence}", BOUND[version, precision]
            rows.append(row(what, "prosail", case, *values, bound=bound, wavelength=float(BANDS[at[1]])))

    def draw(figure):
        for ax, name, number in zip(
            figure.subplots(1, 2, sharey=True), ("reflectance", "transmittance"), (0, 1)
        ):
            for (case, largest), colour in zip(off.items(), (*COLOURS, "0.5")):
                ax.semilogy(BANDS, np.maximum(largest[number], 1e-18), color=colour, lw=0.7, label=case)
            ax.set(title=name, xlabel="wavelength (nm)")
        ax.figure.axes[0].set_ylabel(f"largest difference of {given.leaves} leaves")
        ax.legend(fontsize=7)

    return finish(
        given,
        "prosail_leaves",
        rows,
        title="PROSPECT against prosail",
        seen="""The largest difference of all leaves, wavelength by wavelength. It is that of stored tables
        and of rounding; no band and no version has another formula.""",
        unchecked="""Both compute the same published model from the same coefficients: whether leaves obey it
        is for the measured leaves below to say.""",
        draw=draw,
        size=(11.0, 4.5),
        packages=["prosail"],
        leaves=given.leaves,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
