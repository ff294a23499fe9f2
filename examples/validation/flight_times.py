"""Times of flight in a half-space of isotropic scatterers, order by order, against their exact distribution.

    python examples/validation/flight_times.py [--out figures] [--photons 1048576]

A plane pulse without duration falls vertically upon a half-space of extinction k, and the light that returns
vertically is recorded (`simulate`). All flights of a path lie within the medium, so that a path of length s
and n scatterings has the attenuation exp(-k s), and the volume of such paths scales as s^(n-1). Order n thus
returns, between s and s + ds,

    a_n w^n (k s)^(n-1) / (n-1)! exp(-k s) k ds

with the albedo w. The sum over s is order n of the reflectance factor, w / 8 H(1)^2 (Chandrasekhar 1960), so
that a_n are the coefficients of its series in w. Those of H follow from its integral equation,

    H(mu) = 1 + w / 2 mu H(mu) <integral over (0, 1) of H(m) / (mu + m) dm>:

a_1 = 1/8, a_2 = log(2) / 8, and so on, by Gaussian quadrature of 200 points. Times scale with 1 / k, and the
albedo weights the orders. The slab of voxels is so deep that no recorded path reaches its end.

A point pulse, a beam without width, returns the same light in all, spread about the beam. Of order 2 with the
path length s, the share that returns within the radius r of it is

    F(q) = 1 / log(2) <integral over (0, 1/2) of log(min(1 - x, sqrt(x^2 + q^2)) / x) dx>,    q = r / s

where s x is the difference in depth of the two scatterings. Narrow fields of view are compared with that.
"""

import sys
import warnings

import jax
import numpy as np
from _validation import COLOURS, by_quantity, comparison, draw_differences, finish, options
from scipy.special import gammainc

import jaxlidar as jl
from jaxlidar.sensors.field_of_view import EDGE_WIDTH

ALBEDOS, WAVELENGTHS = np.array([0.3, 0.6, 0.9, 1.0]), (500.0, 600.0, 700.0, 800.0)
# Extinction, per m; depth of the slab, m; sampling interval, ns; largest optical path length.
EXTINCTION, DEPTH, SAMPLING, LONGEST = 0.5, 20.0, 4.0, 19.0
# Metres per ns.
LIGHT_SPEED = 0.299792458
# Bins of the tracer per sample. They blur path lengths by a triangle as wide as two bins, which makes an
# exponential larger by this share, about 1e-4.
BINS = 16
BLUR = (EXTINCTION * LIGHT_SPEED * SAMPLING / BINS) ** 2 / 12
# Orders of all light: beyond them are less than 1e-6 of the paths that are recorded.
ORDERS = 60
# Standard errors of samples below this share of the largest are underestimated.
FAINTEST = 0.01
# Radii of the field of view about a point pulse, m.
RADII = (1.0, 3.0, 10.0)


def coefficients(count, points=200):
    """Return a_n for n from 1 to `count`."""
    x, weight = np.polynomial.legendre.leggauss(points)
    cosine, weight = np.append(0.5 * (x + 1), 1.0), 0.5 * weight
    kernel = weight / (cosine[:, None] + cosine[:-1])
    terms = np.zeros((count, points + 1))
    terms[0] = 1.0
    for n in range(1, count):
        integrals = terms[:n, :-1] @ kernel.T
        terms[n] = 0.5 * cosine * np.sum(terms[:n] * integrals[::-1], axis=0)
    return np.convolve(terms[:, -1], terms[:, -1])[:count] / 8


def exact(edges):
    """Return the light of albedo 1 that returns between optical path lengths; (orders, samples)."""
    orders = np.arange(1, ORDERS + 1)[:, None]
    return coefficients(ORDERS)[:, None] * np.diff(gammainc(orders, np.maximum(edges, 0.0)), axis=1)


def seen_share(edges, radius, points=400):
    """Return the share of order 2 of a point pulse within a field of view, for samples between the edges."""
    # The fraction of light that is seen falls over a soft edge, as a logistic distribution of radii.
    level = (np.arange(40) + 0.5) / 40
    radii = EXTINCTION * radius * (1.0 + EDGE_WIDTH * np.log(level / (1.0 - level)))
    # Midpoints in the square root of x: the integrand has a logarithm at zero.
    root = (np.arange(points) + 0.5) / points * np.sqrt(0.5)
    x, weight = root**2, 2.0 * root * np.sqrt(0.5) / points
    # Within a sample, by its own distribution of path lengths.
    start, fraction = np.maximum(edges[:-1, None], 0.0), (np.arange(40) + 0.5) / 40
    length = start + fraction * np.maximum(edges[1:, None] - start, 1e-9)
    q = radii / length[..., None]
    farthest = np.sqrt(x**2 + q[..., None] ** 2)
    share = np.log(np.minimum(1.0 - x, farthest) / x) @ weight / np.log(2.0)
    return np.average(share.mean(axis=2), axis=1, weights=length * np.exp(-length))


def simulate_slab(orders, n_photons, radius=None):
    """Return edges of samples, as optical path lengths, and the waveform.

    `radius`: of the field of view, m; None: everything is seen.
    """
    # Voxels of leaf have half their area as extinction.
    voxels = jl.VoxelMap.from_lad(np.full((2, 2, 20), 2 * EXTINCTION), voxel_size=(50.0, 50.0, DEPTH / 20))
    leaf = jl.Isotropic(albedo=tuple(ALBEDOS))
    canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.0))
    # From 400 km all return paths are vertical.
    lidar = jl.Lidar(
        wavelength=WAVELENGTHS,
        altitude=4e5,
        divergence=1e-3 if radius is None else 1e-5,
        field_of_view=None if radius is None else 2e3 * radius / 4e5,
        pulse=jl.GaussianPulse(fwhm=0.0),
        sampling_interval=SAMPLING,
    )
    wave = jl.simulate(
        lidar,
        scene,
        key=jax.random.key(orders),
        n_photons=n_photons,
        max_orders=orders,
        n_rays=256,
        bin_width=SAMPLING / BINS,
    )
    times = np.asarray(wave.time, float)
    edges = np.append(times - 0.5 * SAMPLING, times[-1] + 0.5 * SAMPLING)
    return EXTINCTION * (LIGHT_SPEED * edges + 2 * DEPTH), wave


def main(argv=None):
    arguments = options(__doc__, argv, photons=1_048_576)
    rows, curves = [], {}

    def compare(what, case, edges, values, stderr, reference):
        curves[what, case] = edges, values, reference
        # Bins blur the step at the surface beyond its sample.
        is_compared = (reference > FAINTEST * reference.max()) & (edges[1:] < LONGEST) & (edges[:-1] > 0.0)
        for i in np.flatnonzero(is_compared):
            middle = 0.5 * (edges[i] + edges[i + 1])
            blur = BLUR * reference[i]
            # Nothing is random in the first order.
            error = {"bound": 2 * blur} if stderr is None else {"stderr": np.hypot(stderr[i], blur)}
            name = f"{case}, optical path length {middle:.1f}"
            rows.append(comparison(what, "exact", name, values[i], reference[i], length=middle, **error))

    last = len(ALBEDOS) - 1
    for orders in (2, ORDERS):
        edges, wave = simulate_slab(orders, arguments.photons)
        values, stderr = (np.asarray(a, float) for a in (wave.reflectance, wave.stderr))
        by_order = exact(edges)
        if orders == 2:
            first, second = (np.asarray(wave.components[k], float)[last] for k in ("first", "higher"))
            compare("order 1", "albedo 1", edges, first, None, by_order[0])
            compare("order 2", "albedo 1", edges, second, stderr[last], by_order[1])
        else:
            for j, albedo in enumerate(ALBEDOS):
                reference = albedo ** np.arange(1, ORDERS + 1) @ by_order
                compare("all orders", f"albedo {albedo:g}", edges, values[j], stderr[j], reference)

    # A beam of 4 mm from 400 km.
    warnings.simplefilter("ignore", jl.UnitWarning)
    for radius in RADII:
        edges, wave = simulate_slab(2, arguments.photons, radius)
        share = seen_share(edges, radius)
        second, error = (np.asarray(a, float)[last] for a in (wave.components["higher"], wave.stderr))
        compare(
            "order 2 of a point pulse",
            f"seen within {radius:g} m",
            edges,
            second,
            error,
            share * exact(edges)[1],
        )

    def draw(figure):
        left, *rest = figure.subplots(1, 3)
        for ((what, case), (edges, values, reference)), colour in zip(curves.items(), COLOURS):
            middle = 0.5 * (edges[1:] + edges[:-1])
            left.semilogy(middle, values, ".", ms=3, color=colour, label=f"{what}, {case}")
            left.semilogy(middle, reference, "-", lw=0.7, color=colour)
        left.set(xlabel="optical path length", ylabel="reflectance per sample", ylim=(1e-7, 0.1))
        left.set(xlim=(0.0, LONGEST))
        left.legend(fontsize=6)
        groups = by_quantity(rows)
        for ax, what in zip(rest, ("order 2", "all orders")):
            relative = [
                {**row, **{k: 100 * row[k] / row["there"] for k in ("difference", "standard error")}}
                for row in groups[what]
                if what == "order 2" or row["case"].startswith("albedo 1,")
            ]
            draw_differences(ax, relative, "length")
            ax.set(title=f"{what}, albedo 1", xlabel="optical path length", ylabel="difference (%)")

    return finish(
        arguments,
        "flight_times",
        rows,
        title="Times of flight in a half-space of isotropic scatterers",
        caption="""Left: light returned by path length (points) and its exact distribution (lines). Middle and
        right: differences with bars of two standard errors. The first order is exact to the blur of
        bins; the second, of plane and of point pulses, and the sum of all keep to their errors.""",
        unchecked="""One medium without ends, lit and seen vertically, and samples above 1 % of the largest.
        Not looked at are paths that leave the medium and enter it again, slant light and other phase
        functions.""",
        draw=draw,
        size=(13.0, 4.5),
        photons=arguments.photons,
        coefficients=[float(a) for a in coefficients(4)],
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
