"""Elementary functions and the plate model against mpmath in 60 digits.

    python examples/validation/mpmath_plate.py [--out figures] [--points 60]

The exponential integral in the diffuse transmittance of a layer without surfaces, 2 E3(k), what the
layer absorbs, and the reflectance, transmittance and absorptance of a leaf of N plates (Allen et al. 1969;
Stokes 1862), for absorptions from 1e-8 to 10 and N from 1 to 3. Errors are relative, in single and in double
precision.
"""

import sys

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from _validation import COLOURS, comparison, finish, options, with_progress

from jaxlidar.optics.leaf_surface import leaf_surface
from jaxlidar.optics.plate_model import plate_model

DIGITS, INDEX = 60, 1.42
# In units of rounding. Three opaque plates transmit exp(-30), and rounding of the exponent counts 30 times:
# transmittances in single precision have five digits.
BOUND = {"float32": 8.0, "float64": 16.0}
BOUND_OF_SINGLE_T = 1e-5 / float(np.finfo("float32").eps)
LAYER = {
    "2 E3(k)": lambda k: 2 * mpmath.expint(3, k),
    "1 - 2 E3(k)": lambda k: 1 - 2 * mpmath.expint(3, k),
}


def cone(n, alpha):
    """Return the mean transmittance of a surface over a cone, by quadrature of Fresnel's formulas."""
    c = mpmath.cos(mpmath.radians(alpha))

    def transmitted(mu):
        inside = mpmath.sqrt(1 - (1 - mu**2) / n**2)
        s_wave, p_wave = (mu - n * inside) / (mu + n * inside), (n * mu - inside) / (n * mu + inside)
        return 2 * mu * (1 - (s_wave**2 + p_wave**2) / 2)

    return mpmath.quad(transmitted, [c, (1 + c) / 2, 1]) / (1 - c**2)


def plates(k, N, t_alpha, t12, n):
    """Return reflectance, transmittance and absorptance by the formulas as they are printed."""
    tau, t21 = 2 * mpmath.expint(3, k), t12 / n**2
    r21 = 1 - t21
    bounce = 1 - (r21 * tau) ** 2
    Ta, t = t_alpha * tau * t21 / bounce, t12 * tau * t21 / bounce
    Ra, r = 1 - t_alpha + r21 * tau * Ta, 1 - t12 + r21 * tau * t
    root = mpmath.sqrt((1 + r + t) * (1 + r - t) * (1 - r + t) * (1 - r - t))
    a, b = (1 + r**2 - t**2 + root) / (2 * r), ((1 - r**2 + t**2 + root) / (2 * t)) ** (N - 1)
    Rs, Ts = a * (b**2 - 1) / (a**2 * b**2 - 1), b * (a**2 - 1) / (a**2 * b**2 - 1)
    R, T = Ra + Ta * Rs * t / (1 - Rs * r), Ta * Ts / (1 - Rs * r)
    return R, T, 1 - R - T


def main(argv=None):
    arguments = options(__doc__, argv, points=60)
    rows, absorption = [], np.geomspace(1e-8, 10.0, arguments.points)
    N = np.random.default_rng(0).uniform(1.0, 3.0, arguments.points)
    with mpmath.workdps(DIGITS):
        index = mpmath.mpf(INDEX)
        face = cone(index, 40), cone(index, 90)
        for precision, bound in BOUND.items():
            with jax.enable_x64(precision == "float64"):
                absorptions, plates_of = jnp.asarray(absorption, precision), jnp.asarray(N, precision)
                # One plate of refractive index 1 is a layer without surfaces.
                layer = plate_model(absorptions, jnp.ones_like(absorptions), leaf_surface(1.0))
                ours = dict(zip(LAYER, layer[1:]))
                ours |= zip("RTA", plate_model(absorptions, plates_of, leaf_surface(INDEX)))
            exact = []
            for x, n in with_progress(arguments, list(zip(absorptions, plates_of))):
                x, n = mpmath.mpf(float(x)), mpmath.mpf(float(n))
                exact.append([*(reference(x) for reference in LAYER.values()), *plates(x, n, *face, index)])
            unit = float(np.finfo(precision).eps)
            for (name, values), column in zip(ours.items(), zip(*exact)):
                for x, value, reference in zip(absorptions, np.asarray(values, float), column):
                    x, value = float(x), float(value)
                    off = float((mpmath.mpf(value) - reference) / reference) / unit
                    kind = "leaf of N plates" if name in "RTA" else "exponential integrals"
                    what, case = f"{kind}, {precision}", f"{name} at k = {x:.3g}"
                    rows.append(
                        comparison(
                            what,
                            f"mpmath, {DIGITS} digits",
                            case,
                            off,
                            0.0,
                            bound=BOUND_OF_SINGLE_T if (name, precision) == ("T", "float32") else bound,
                            unit="eps",
                            k=x,
                            function=name,
                        )
                    )

    def draw(figure):
        for ax, precision in zip(figure.subplots(1, 2), BOUND):
            precision_rows = [r for r in rows if r["what"].endswith(precision)]
            for name, colour in zip((*LAYER, *"RTA"), COLOURS):
                k, off = zip(*((r["k"], r["difference"]) for r in precision_rows if r["function"] == name))
                ax.semilogx(k, off, ".", color=colour, ms=3, label=f"leaf: {name}" if name in "RTA" else name)
            ax.set(title=precision, xlabel="absorption k", ylabel="relative error, units of rounding")
            ax.axhline(0.0, color="0.6", lw=0.8)
        ax.legend(fontsize=7)

    return finish(
        arguments,
        "mpmath_plate",
        rows,
        title="Elementary functions against 60 digits",
        caption="""Relative errors in units of rounding (1.2e-7 in single, 2.2e-16 in double precision),
        from leaves that absorb almost nothing to opaque ones. None grows where formulas lose digits by
        cancellation; in single precision, transmittances of opaque leaves have five digits, as rounding of an
        exponent of 30 counts 30 times.""",
        unchecked="""Values, not derivatives (tests check those), and one refractive index; the coefficients
        of absorption are data.""",
        draw=draw,
        size=(11.0, 4.5),
        packages=["mpmath"],
        points=arguments.points,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
