"""Plane, line and point pulses in an infinite medium of isotropic scatterers against their closed form.

    python examples/validation/infinite_medium.py [--out figures] [--photons 1000000]

Light without absorption, of one mean free path per unit of time. Of an isotropic plane pulse, the density at
the distance x after the time t is, with e = x / t (Ganapol et al. 1977; the benchmark AZURV1),

    phi(x, t) = exp(-t) / (2 t) [1 + t / (4 pi) (1 - e^2) <integral over (0, pi) of
        sec(u / 2)^2 Re(xi^2 exp(t / 2 (1 - e^2) xi)) du>],
    xi = (log((1 + e) / (1 - e)) + i u) / (e + i tan(u / 2)).

Sources are superpositions of points, so that the density of a point pulse is -1 / (2 pi r) d phi / dr. The
shares of light within a distance of source are, of a plane, a point and a line,

    G(x) = 2 <integral over (0, x) of phi>,    F(r) = G(r) - 2 r phi(r, t),
    1 - S + <integral over (0, S) of F(R / sqrt(1 - s^2)) ds>,    S = sqrt(1 - R^2 / t^2),

the last since a point at r lies farther than R from the axis with the probability sqrt(1 - R^2 / r^2).
An albedo w multiplies the light by exp(-(1 - w) t) for a scattering coefficient of 1.

Photons start at a point in the middle of voxels, which repeat to all sides and are so high that no photon
reaches their top. At the time t a photon is on one of its flights, between two collisions (`photon_paths` of
`examples/paper`, by the tracer's own flights and collisions). Distances along an axis are those of a plane
pulse, and those across it of a line pulse. Shares of light in steps of distance have binomial errors.
"""

import sys

import jax
import numpy as np
from _validation import COLOURS, by_quantity, comparison, draw_differences, finish, options, with_progress

import jaxlidar as jl

# Found by the path that `_validation` has set.
from _analog import photon_paths  # isort: skip

# Times in mean free paths, and steps of distance up to the front of the light.
TIMES, STEPS = (1.0, 2.0, 4.0, 8.0), 10
# Extinction, per m; height of the voxels, mean free paths; collisions that are followed; photons at once.
EXTINCTION, HEIGHT, ORDERS, BATCH = 0.5, 18.0, 36, 50_000
NODES = tuple(np.polynomial.legendre.leggauss(100))


def integral(function, upper):
    """Return integrals from 0 to each of `upper`, by Gaussian quadrature."""
    x, weight = NODES
    half = 0.5 * np.asarray(upper)[..., None]
    return np.sum(function(half * (x + 1.0)) * weight * half, axis=-1)


def plane_density(x, t):
    """Return the density of a plane pulse at distances below t."""
    e = np.asarray(x)[..., None] / t
    log_q, inner = np.log1p(e) - np.log1p(-e), 1.0 - e**2

    def of_angle(u):
        xi = (log_q + 1j * u) / (e + 1j * np.tan(0.5 * u))
        return np.real(xi**2 * np.exp(0.5 * t * inner * xi)) / np.cos(0.5 * u) ** 2

    return np.exp(-t) / (2 * t) * (1.0 + t / (4 * np.pi) * inner[..., 0] * integral(of_angle, np.pi))


def within_plane(x, t):
    """Return the share of a plane pulse within the distance x."""
    return 2.0 * integral(lambda y: plane_density(y, t), x)


def within_point(r, t):
    """Return the share of a point pulse within the distance r < t; unscattered light lies at t."""
    return within_plane(r, t) - 2.0 * r * plane_density(r, t)


def within_line(radius, t):
    """Return the share of a line pulse within the distance `radius`."""
    radius = np.asarray(radius)
    s = np.sqrt(1.0 - (radius / t) ** 2)
    return 1.0 - s + integral(lambda y: within_point(radius[..., None] / np.sqrt(1.0 - y**2), t), s)


SHARES = {"plane pulse": within_plane, "line pulse": within_line, "point pulse": within_point}


def positions(points, t):
    """Return where photons are after the path length t, from the ends of their flights; (photons, 3)."""
    length = np.linalg.norm(np.diff(points, axis=1), axis=2)
    path = np.cumsum(length, axis=1)
    flight = np.argmax(path >= t, axis=1)
    number = np.arange(len(points))
    fraction = 1.0 - (path[number, flight] - t) / length[number, flight]
    start, end = points[number, flight], points[number, flight + 1]
    return start + fraction[:, None] * (end - start)


def count_photons(arguments):
    """Return numbers of photons by source, time and step of distance, and the number of all."""
    side = HEIGHT / EXTINCTION
    # Voxels of leaf have half their area as extinction.
    voxels = jl.VoxelMap.from_lad(np.full((2, 2, 9), 2 * EXTINCTION), voxel_size=(5.0, 5.0, side / 9))
    canopy = jl.Canopy(voxels, leaf=jl.Isotropic(albedo=1.0), sides="periodic", hotspot=False)
    scene, lidar = jl.Scene(canopy=canopy), jl.Lidar(wavelength=532.0, altitude=1000.0)
    plan = jl.plan(lidar, scene, max_orders=ORDERS, window=(-300.0, 300.0), histories=True)
    counts = {name: np.zeros((len(TIMES), STEPS)) for name in SHARES}
    keys = list(jax.random.split(jax.random.key(0), max(1, arguments.photons // BATCH)))
    source = np.array([0.0, 0.0, 0.5 * side])
    for key in with_progress(arguments, keys):
        points = photon_paths(lidar, scene, plan, key=key, n_photons=BATCH, source=source)
        points = EXTINCTION * (np.asarray(points, float) - source)
        for i, t in enumerate(TIMES):
            x, y, z = positions(points, t).T
            distances = np.abs(z), np.hypot(x, y), np.sqrt(x**2 + y**2 + z**2)
            for name, distance in zip(SHARES, distances):
                step = np.minimum((distance / t * STEPS).astype(int), STEPS - 1)
                counts[name][i] += np.bincount(step, minlength=STEPS)
    return counts, BATCH * len(keys)


def main(argv=None):
    arguments = options(__doc__, argv, photons=1_000_000)
    counts, n_photons = count_photons(arguments)
    rows, shares = [], {}
    for name, share_within in SHARES.items():
        for t, count in zip(TIMES, counts[name]):
            edges = t * np.arange(STEPS) / STEPS
            expected = np.diff(share_within(edges, t), append=1.0)
            shares[name, t] = count / n_photons, expected
            for edge, value, share in zip(edges, count / n_photons, expected):
                case, middle = f"time {t:g}, from distance {edge:g}", (edge + 0.5 * t / STEPS) / t
                error = np.sqrt(share * (1.0 - share) / n_photons)
                where = {"time": t, "distance": middle}
                rows.append(comparison(name, "closed form", case, value, share, stderr=error, **where))

    def draw(figure):
        top, low = figure.subplots(2, len(SHARES), sharex=True)
        middle = (np.arange(STEPS) + 0.5) / STEPS
        groups = by_quantity(rows)
        for ax, ax_low, name in zip(top, low, SHARES):
            for t, colour in zip(TIMES, COLOURS):
                value, expected = shares[name, t]
                ax.plot(middle, value, "o", ms=3, color=colour, label=f"time {t:g}")
                ax.plot(middle, expected, "-", lw=0.7, color=colour)
                over_error = [
                    {**row, "difference": row["over error"], "standard error": 1.0}
                    for row in groups[name]
                    if row["time"] == t
                ]
                draw_differences(ax_low, over_error, "distance", color=colour)
            ax.set(title=name, ylabel="share of light")
            ax_low.set(xlabel="distance over path length", ylabel="difference over its error")
        top[0].legend(fontsize=7)

    return finish(
        arguments,
        "infinite_medium",
        rows,
        title="Pulses in an infinite medium of isotropic scatterers",
        caption=f"""Above: shares of the light of a pulse in steps of distance (points), after 1, 2, 4 and 8
        mean free paths, and their closed form (lines). The last step of the point pulse has the unscattered
        light. Below: differences over their standard errors, with bars of two. Of {n_photons:,} photons.""",
        unchecked="""Uniform voxels with isotropic scattering, and photons that are followed one by one:
        how light returns to a lidar, and the stratified random numbers of simulations, are looked at by the
        half-space.""",
        draw=draw,
        size=(12.0, 6.0),
        photons=n_photons,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
