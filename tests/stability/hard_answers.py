"""Closed forms of the measures of `hard_families`, for numbers of mpmath with any number of digits.

Each function takes the numbers of its family as attributes of `n` and returns one number for every output;
None where an output has no closed form (it must be finite all the same). Lengths in m, times in ns, as in
jaxlidar.
"""

import functools
import itertools

import numpy as np
from mpmath import mp, mpf

from jaxlidar.optics.coefficients import TRAITS, shipped

C = mpf("0.299792458")
DIGITS = 100
STEP = mpf(10) ** -30


def decay(x):
    """(1 - exp(-x)) / x."""
    return -mp.expm1(-x) / x if x else mpf(1)


def normal(t, s):
    """Distribution function of a normal variable; a step of 1/2 at zero for s = 0."""
    return mp.ncdf(t / s) if s else (mp.sign(t) + 1) / 2


def fraction_in_view(n, distance):
    """Fraction of a Gaussian beam within a field of view, whose edge is soft over 2 %."""
    beam, edge = n.divergence * mpf("5e-4") * distance, n.fov * mpf("5e-4") * distance
    if edge > 10 * beam:
        return mpf(1)
    with mp.workdps(40):
        # In the variable x = r / edge; the intervals resolve the soft edge at x = 1.
        a = 2 * (edge / beam) ** 2
        f = lambda x: 2 * a * x * mp.exp(-a * x * x) / (1 + mp.exp((x - 1) / mpf("0.02")))  # noqa: E731
        return mp.quad(f, [0, 0.8, 0.9, 1, 1.1, 1.2, max(mpf("1.5"), mp.sqrt(60 / a))])


def ground(n, times):
    """Samples of a Gaussian pulse under a Gaussian beam from a Lambertian plane tilted to the beam."""
    tilt = abs(mp.radians(n.slope - n.zenith))
    along = n.altitude / mp.cos(mp.radians(n.zenith))
    spread = along * n.divergence * mpf("5e-4") * mp.tan(tilt) / C
    s = mp.sqrt((n.fwhm / mp.sqrt(8 * mp.log(2))) ** 2 + n.jitter**2 + spread**2)
    half, t0 = (times[1] - times[0]) / 2, -2 * n.height / (C * mp.cos(mp.radians(n.zenith)))
    seen = n.rho * mp.cos(tilt) * fraction_in_view(n, along)
    return [seen * (normal(t + half - t0, s) - normal(t - half - t0, s)) for t in times]


def rectangle(n, times):
    """Samples of a rectangular pulse from flat ground; without length, it returns at one instant."""
    half, t0 = (times[1] - times[0]) / 2, -2 * n.height / C

    def cumulative(t):
        if n.length == 0:
            return (mp.sign(t) + 1) / 2
        return min(max(t / n.length + mpf(1) / 2, mpf(0)), mpf(1))

    return [n.rho * (cumulative(t + half - t0) - cumulative(t - half - t0)) for t in times]


def equal_angle(n):
    """Density 1 / (pi^2 sin(theta)), averaged over the aperture: 2 alpha / pi at the normal, over alpha^2."""
    alpha = n.aperture / (2 * n.altitude)
    return [n.rho / (mp.pi * mp.sqrt(mp.sin(mp.radians(n.slope)) ** 2 + alpha**2 / 4)) * alpha]


def mirror(n):
    """Fraction of the mirror image of the beam that falls into the aperture."""
    beam, blur = 2 * n.altitude * n.divergence * mpf("5e-4"), 2 * n.altitude * n.roughness
    if not (beam or blur):
        return [n.rho]
    return [-n.rho * mp.expm1(-2 * (n.aperture / 2) ** 2 / (beam**2 + blur**2))]


def slab(n, kappa):
    """First order from three layers of leaf and bark over ground: leaf, bark, ground, and the energy budget.

    Layers reach from 1 to 4 m; ground at a height between these buries the layers below it. The budget sums
    to 1.
    """
    mu = mp.cos(mp.radians(n.zenith))
    depth = leaf = bark = mpf(0)
    for top, weight in ((4, n.high), (3, n.middle), (2, n.low)):
        path = max(top - max(mpf(top - 1), n.height), mpf(0)) / mu
        leaf_extinction = n.leaf * weight
        transmitted = mp.exp(-kappa * depth) * path * decay(kappa * (leaf_extinction + n.bark) * path)
        leaf, bark = leaf + leaf_extinction * transmitted, bark + n.bark * transmitted
        depth += (leaf_extinction + n.bark) * path
    facets = mpf(2) / 3
    ground_return = n.rho * mp.cos(mp.radians(n.zenith - n.slope)) * mp.exp(-kappa * depth)
    return [facets * n.R * leaf, facets * n.bark_R * bark, ground_return, mpf(1)]


def one_voxel(n):
    """First order from one voxel of optical depth tau over ground, the two crossings independent."""
    return [n.R * 2 / 3 * n.tau * n.size * decay(2 * n.tau * n.size) + n.rho * mp.exp(-2 * n.tau * n.size)]


def crown(n):
    """The energy budget sums to one; a black or empty crown leaves the return of the ground."""
    reflectance = None
    if n.R == n.T == n.bark_R == 0 and n.divergence == 0 and n.fov > 10 and -10 < n.height < 1:
        layer_transmittance = (1 - n.p_leaf) * (1 - n.p_bark) if max(n.p_leaf, n.p_bark) < 1 else mpf(0)
        reflectance = n.rho * mp.cos(mp.radians(n.slope)) * layer_transmittance**6
    return [mpf(1), reflectance]


def many_orders(n):
    """The energy budget sums to one; without absorbers nothing is absorbed."""
    return [mpf(1), mpf(0) if n.albedo == n.rho == 1 else None]


def plate_over_ground(n, orders):
    """Geometric series between plate and ground, cut after `orders` scatterings (ground, plate ...)."""
    r, t = n.coverage * n.R, 1 - n.coverage + n.coverage * n.T
    return [r + t**2 * n.rho * mp.fsum((r * n.rho) ** j for j in range((orders + 1) // 2))]


def probability(n):
    """Extinction coefficients; certainty counts as an optical depth of 40 per edge."""
    return [(mpf(40) if p >= 1 else -mp.log1p(-p)) / n.edge for p in (n.p_leaf, n.p_bark)]


def chord(n, shape, periodic):
    """Optical depth along a straight line through a chequer of voxels of 1 m, one corner at the origin."""
    x, w = (n.x, n.y, n.z), (n.u, n.v, n.w)
    enter, leave = mpf(0), n.limit
    for k in range(3):
        if periodic and k < 2:
            continue
        if w[k] == 0:
            leave = leave if 0 <= x[k] <= shape[k] else enter
        else:
            crossings = sorted((-x[k] / w[k], (shape[k] - x[k]) / w[k]))
            enter, leave = max(enter, crossings[0]), min(leave, crossings[1])
    if enter >= leave:
        return [mpf(0)]
    cuts = {enter, leave}
    for k in range(3):
        if w[k]:
            a, b = sorted((x[k] + w[k] * enter, x[k] + w[k] * leave))
            faces = range(int(mp.ceil(a)), int(mp.floor(b)) + 1)
            cuts |= {min(max((f - x[k]) / w[k], enter), leave) for f in faces}
    depth = mpf(0)
    for a, b in itertools.pairwise(sorted(cuts)):
        cell = [int(mp.floor(x[k] + w[k] * (a + b) / 2)) for k in range(3)]
        depth += n.k * (1 + n.contrast * (-1) ** (sum(cell) % 2)) * (b - a)
    return [depth]


@functools.cache
def cone(index, alpha):
    """Mean transmittance of a leaf's surface over a cone of incidence, by Fresnel's formulas."""
    c = mp.cos(mp.radians(alpha)) if alpha < 90 else mpf(0)

    def transmitted(mu):
        inside = mp.sqrt(1 - (1 - mu**2) / mpf(index) ** 2)
        s_wave, p_wave = (
            (mu - index * inside) / (mu + index * inside),
            (index * mu - inside) / (index * mu + inside),
        )
        return 2 * mu * (1 - (s_wave**2 + p_wave**2) / 2)

    with mp.workdps(30):
        return mp.quad(transmitted, [c, (1 + c) / 2, 1]) / (1 - c**2)


def leaf(n, wavelengths):
    """Reflectance, transmittance and absorptance by the textbook's plates and piles (Stokes)."""
    table, out = shipped("D"), []
    contents = [getattr(n, name) for name in TRAITS["D"]]
    for wavelength in wavelengths:
        index = float(np.interp(wavelength, table.wavelength, table.index))
        columns = [float(np.interp(wavelength, table.wavelength, c)) for c in table.absorption]
        # The formulas divide by zero at k = 0 and at N = 1; in 100 digits, 1e-50 beyond serves as the limit.
        k = max(mp.fsum(a * b for a, b in zip(contents, columns)) / n.N, mpf(10) ** -50)
        n_piled = max(n.N - 1, mpf(10) ** -50)
        t_alpha, t12 = cone(index, 40), cone(index, 90)
        t21, tau = t12 / mpf(index) ** 2, 2 * mp.expint(3, k)
        r21 = 1 - t21
        bounce = 1 - (r21 * tau) ** 2
        first_t, t = t_alpha * tau * t21 / bounce, t12 * tau * t21 / bounce
        first_r, r = 1 - t_alpha + r21 * tau * first_t, 1 - t12 + r21 * tau * t
        root = mp.sqrt((1 + r + t) * (1 + r - t) * (1 - r + t) * (1 - r - t))
        a, b = (1 + r**2 - t**2 + root) / (2 * r), (1 - r**2 + t**2 + root) / (2 * t)
        power = b**n_piled
        denominator = a**2 * power**2 - 1
        pile_r, pile_t = a * (power**2 - 1) / denominator, power * (a**2 - 1) / denominator
        R, T = first_r + first_t * pile_r * t / (1 - pile_r * r), first_t * pile_t / (1 - pile_r * r)
        out += [R, T, 1 - R - T]
    return out


def air(n):
    """Two-way transmittance and backscatter of aerosol at 550 nm."""
    k, scale = mpf("3.912e-3") / n.visibility, mpf(1400)
    path_height = max(n.altitude - n.height, mpf(0))
    depth = (
        k * scale * mp.exp(-n.height / scale) * -mp.expm1(-path_height / scale) / mp.cos(mp.radians(n.zenith))
    )
    clear = mp.exp(-2 * depth)
    return [clear, mp.pi * k / n.lidar_ratio * mp.exp(-n.height / scale) * clear]


def pulses(n, times):
    """Running integrals of a Gaussian, a rectangle and an exponentially modified Gaussian under jitter."""
    s = mp.sqrt((n.width / mp.sqrt(8 * mp.log(2))) ** 2 + n.jitter**2)
    out = []
    for t in times:
        t = t + n.shift
        out.append(normal(t, s))
        if n.width == 0:
            out.append(normal(t, n.jitter))
        else:
            ends = (t + n.width / 2, t - n.width / 2)
            total = [
                e * normal(e, n.jitter) + (n.jitter * mp.npdf(e / n.jitter) if n.jitter else 0) for e in ends
            ]
            out.append((total[0] - total[1]) / n.width)
        # Time zero of the exponentially modified Gaussian is its centroid, `decay` after that of the
        # Gaussian.
        u = t + n.decay
        tail = mpf(0)
        if n.decay and s:
            tail = mp.exp(s**2 / (2 * n.decay**2) - u / n.decay) * mp.ncdf(u / s - s / n.decay)
        elif n.decay:
            tail = mp.exp(-u / n.decay) * normal(u, s)
        out.append(normal(u, s) - tail)
    return out


def value_and_slope(answer, numbers, variable):
    """Return an answer and its one-sided derivative from above with respect to one number, as arrays."""
    with mp.workdps(DIGITS):
        exact = {name: mpf(value) for name, value in numbers.items()}
        h = STEP * max(1, abs(exact[variable]))
        at_value, shifted = (answer(_Numbers(exact | {variable: exact[variable] + s})) for s in (0, h))
        slope = [None if a is None or b is None else (b - a) / h for a, b in zip(at_value, shifted)]
        return tuple(np.array([np.nan if v is None else float(v) for v in x]) for x in (at_value, slope))


class _Numbers:
    def __init__(self, numbers):
        self.__dict__.update(numbers)
