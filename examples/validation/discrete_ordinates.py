"""Slabs of leaves over ground, all orders, against discrete ordinates (PythonicDISORT).

    python examples/validation/discrete_ordinates.py [--out figures] [--rtol 0.002]

Plane-parallel slabs lit from straight above over Lambertian ground: the bidirectional reflectance factor at
nadir is the sum of a waveform (`simulate`), and the returned, transmitted and absorbed fractions are those of
the energy budget (`energy_budget`). The reference is solved with 48 and 64 streams; their difference is part
of the error. At albedo 1, where the solver fails, it is extrapolated linearly from 1e-5 and 2e-5 below.
"""

import sys
import warnings

import jax
import numpy as np
from _validation import by_quantity, comparison, draw_differences, finish, options, with_progress
from PythonicDISORT import pydisort, subroutines

import jaxlidar as jl

STREAMS = (48, 64)
# Rounding error of the reference near albedo 1.
ROUNDING = 1e-6
# Optical depth, scattering (albedo or R and T; g of Henyey and Greenstein), ground, orders of the waveform.
SLABS = {
    "0.1, isotropic 0.5, black": (0.1, jl.Isotropic(albedo=0.5), 0.0, 8),
    "1, isotropic 0.9, 0.2": (1.0, jl.Isotropic(albedo=0.9), 0.2, 40),
    "1, forward (g 0.5) 0.9, 0.2": (1.0, jl.HenyeyGreenstein(albedo=0.9, g=0.5), 0.2, 40),
    "1, backward (g -0.3) 0.9, 0.2": (1.0, jl.HenyeyGreenstein(albedo=0.9, g=-0.3), 0.2, 40),
    "2, leaves 0.4 + 0.3, 0.2": (2.0, jl.LeafOptics(0.4, 0.3), 0.2, 30),
    "5, leaves 0.1 + 0.6, 0.3": (5.0, jl.LeafOptics(0.1, 0.6), 0.3, 30),
    "10, isotropic 0.95, 0.3": (10.0, jl.Isotropic(albedo=0.95), 0.3, 160),
    "10, isotropic 1, black": (10.0, jl.Isotropic(albedo=1.0), 0.0, 400),
}
# One sample that takes in all light; from 400 km every return path is vertical.
LIDAR = jl.Lidar(altitude=4e5, divergence=1e-3, sampling_interval=1e4)
SINGLE_SAMPLE = {"window": (4900.0, 4901.0), "bin_width": 20.0}


def moments(leaf, count):
    """Return albedo and Legendre moments of the phase function; of leaves that of Ross, 8 Gamma / (R + T)."""
    if isinstance(leaf, jl.Isotropic):
        return float(leaf.albedo), np.eye(count)[0]
    if isinstance(leaf, jl.HenyeyGreenstein):
        return float(leaf.albedo), float(leaf.g) ** np.arange(count)
    x, weight = np.polynomial.legendre.leggauss(2000)
    angle, R, T = np.arccos(x), float(leaf.reflectance), float(leaf.transmittance)
    phase = 8 * ((R + T) / (3 * np.pi) * (np.sin(angle) - angle * x) + T / 3 * x) / (R + T)
    basis = np.polynomial.legendre.Legendre.basis
    return R + T, np.array([0.5 * np.sum(weight * phase * basis(n)(x)) for n in range(count)])


def solve(tau, leaf, ground, streams):
    """Return the reflectance factor, and the fractions returned, transmitted and absorbed by leaves."""
    albedo, legendre = moments(leaf, streams)

    def solve_albedo(albedo):
        inputs = np.array([tau]), np.array([albedo]), streams, legendre[None], 1.0, 1.0, 0.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            _, up, down, radiance = pydisort(*inputs, BDRF_Fourier_modes=[ground], NFourier=1, NLeg=streams)[
                :4
            ]
            factor = np.pi * float(subroutines.interpolate(radiance)(1.0, 0.0))
        through = float(np.sum(down(tau)))
        return np.array([factor, up(0.0), through, 1 - up(0.0) - (1 - ground) * through], float)

    return solve_albedo(albedo) if albedo < 1 else 2 * solve_albedo(1 - 1e-5) - solve_albedo(1 - 2e-5)


def simulate_slab(tau, leaf, ground, orders, rtol, key):
    """Return the same four, their standard errors, and the bound on neglected orders of the first."""
    voxels = jl.VoxelMap.from_lad(np.full((2, 2, 20), tau / 5), voxel_size=(5.0, 5.0, 0.5))
    canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=ground))
    first, second = jax.random.split(key)
    wave = jl.simulate(LIDAR, scene, key=first, rtol=rtol, max_orders=orders, n_rays=256, **SINGLE_SAMPLE)
    budget = jl.energy_budget(LIDAR, scene, key=second, rtol=rtol, illumination="parallel")
    names, fluxes = ("returned", "transmitted"), [budget.returned, budget.transmitted]
    values = [np.sum(wave.reflectance), *fluxes, budget.absorbed["leaf"]]
    errors = [np.sum(wave.stderr), *(budget.stderr[n] for n in (*names, "leaf"))]
    return [float(np.sum(v)) for v in values], [float(np.sum(e)) for e in errors], float(wave.neglected[0])


def main(argv=None):
    arguments = options(__doc__, argv, rtol=2e-3, slabs=len(SLABS))
    rows = []
    keys = jax.random.split(jax.random.key(0), len(SLABS))
    for key, (case, slab) in with_progress(arguments, list(zip(keys, SLABS.items()))[: arguments.slabs]):
        tau, leaf, ground, orders = slab
        coarse, references = (solve(tau, leaf, ground, n) for n in STREAMS)
        values, stderr, neglected = simulate_slab(tau, leaf, ground, orders, arguments.rtol, key)
        names = ("reflectance factor", "share returned", "share let through", "share absorbed by leaves")
        for what, a, b, s, rough in zip(names, values, references, stderr, coarse):
            error = float(np.linalg.norm([s, b - rough, ROUNDING]))
            extra = {"neglected orders, at most": neglected} if what == names[0] else {}
            rows.append(comparison(what, "PythonicDISORT", case, a, b, stderr=error, **extra))

    def draw(figure):
        for ax, (what, group) in zip(figure.subplots(1, 4), by_quantity(rows).items()):
            draw_differences(ax, group)
            ax.set(title=what)

    return finish(
        arguments,
        "discrete_ordinates",
        rows,
        title="Slabs against discrete ordinates",
        caption="""Differences with bars of two standard errors, slab by slab: optical depth, scattering,
        ground. Points scatter about zero as their bars say; no slab, thick or bright, stands apart.""",
        unchecked="""Slabs are uniform and lit from straight above: crowns and gaps, slant beams and the times
        of arrival are not seen by them.""",
        draw=draw,
        size=(13.0, 4.5),
        packages=["PythonicDISORT"],
        streams=STREAMS,
        rtol=arguments.rtol,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
