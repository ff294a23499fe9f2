"""Open forests against the reference fluxes of RAMI4PILPS.

    python examples/validation/rami4pilps.py PATH [--out figures] [--rtol 0.002] [--arrangements 3]

PATH is a CSV with the columns `band` (ends with "red" or "nir"), `canopy` (100 times the leaf area index: 50,
150, 250), `soil` (BLK, MED, SNW), `zenith` (27, 60, 83), `flux` (abs, ref, tran) and `value`; lines that
begin with # are comments. The values are those of the experiment's open forest canopies (Widlowski et al.
2011, doi:10.1029/2010JG001511).

The forests: spherical crowns of radius 5 m, without overlap, centres at 7 to 11 m, on a periodic square of
250 m; leaf area density 0.75 m2/m3, spherical leaf angles. The positions of the crowns are unknown, so that
several random arrangements are simulated. The standard error of a difference combines that of the photons and
the spread of one arrangement, which both sides have. Crowns are voxels of 0.5 m here.
"""

import csv
import itertools
import sys

import jax
import numpy as np
from _validation import COLOURS, comparison, finish, options, with_progress

import jaxlidar as jl

# 100 times the leaf area index: crowns.
CROWNS = {50: 80, 150: 239, 250: 398}
SOILS = {"BLK": (0.0, 0.0), "MED": (0.1217, 0.2142), "SNW": (0.9640, 0.5568)}
LEAF = jl.LeafOptics(reflectance=(0.0735, 0.3912), transmittance=(0.0566, 0.4146))
BANDS, ZENITHS = ("red", "nir"), (27, 60, 83)
FLUXES = {"abs": "absorbed by leaves", "ref": "reflected", "tran": "let through to the ground"}


def crowns(count, seed, size=0.5, side=250.0, base=2.0):
    """Return crowns of radius 5 m that do not overlap, as voxels filled by fractions (4^3 points a voxel)."""
    rng = np.random.default_rng(seed)
    centres = np.empty((0, 3))
    while len(centres) < count:
        candidate = np.append(rng.uniform(0, side, 2), rng.uniform(7.0, 11.0))
        offsets = centres - candidate
        offsets[:, :2] -= side * np.round(offsets[:, :2] / side)
        if np.all(np.sum(offsets**2, axis=1) >= 100.0):
            centres = np.vstack([centres, candidate])
    cells, layers, n_wide = round(side / size), round(14.0 / size), round(10.0 / size) + 2
    fraction = np.zeros((cells, cells, layers))
    within = (np.arange(4) + 0.5) / 4 * size
    for centre in centres - (0.0, 0.0, base):
        index = [np.floor((c - 5.0) / size).astype(int) + np.arange(n_wide) for c in centre]
        a, b, c = (((n[:, None] * size + within).ravel() - x) ** 2 for n, x in zip(index, centre))
        inside = a[:, None, None] + b[None, :, None] + c[None, None, :] < 25.0
        filled = inside.reshape(n_wide, 4, n_wide, 4, n_wide, 4).mean(axis=(1, 3, 5))
        in_layers = (index[2] >= 0) & (index[2] < layers)
        fraction[np.ix_(index[0] % cells, index[1] % cells, index[2][in_layers])] += filled[:, :, in_layers]
    lad = 0.75 * np.minimum(fraction, 1.0)
    return jl.VoxelMap.from_lad(lad, voxel_size=size, origin=(0.0, 0.0, base))


def fluxes(voxels, soil, zenith, rtol=0.002, seed=3):
    """Return light absorbed by leaves, reflected and transmitted, in (red, near infrared), and errors."""
    canopy = jl.Canopy(voxels, leaf=LEAF, sides="periodic", hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=SOILS[soil]))
    lidar = jl.Lidar(wavelength=(650.0, 850.0), zenith=float(zenith))
    key = jax.random.key(seed)
    budget = jl.energy_budget(lidar, scene, key=key, rtol=rtol, illumination="parallel")
    values = budget.absorbed["leaf"], budget.returned, budget.transmitted
    names = ("leaf", "returned", "transmitted")
    return np.array(values, float), np.array([budget.stderr[name] for name in names], float)


def read(path):
    """Return the reference values by (band, canopy, soil, zenith, flux)."""
    with path.open(newline="") as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        return {
            (r["band"].split()[-1], int(r["canopy"]), r["soil"], int(r["zenith"]), r["flux"]): float(
                r["value"]
            )
            for r in rows
        }


def main(argv=None):
    arguments = options(__doc__, argv, "path", rtol=0.002, arrangements=3, canopies=len(CROWNS))
    references, rows = read(arguments.path), []
    canopies = list(CROWNS)[: arguments.canopies]
    maps = {c: [crowns(CROWNS[c], seed) for seed in range(arguments.arrangements)] for c in canopies}
    for canopy, zenith in with_progress(arguments, [(c, z) for c in canopies for z in ZENITHS]):
        # (soils, arrangements, fluxes, bands)
        values_by_soil, stderr = np.moveaxis(
            [[fluxes(v, s, zenith, arguments.rtol, n) for n, v in enumerate(maps[canopy])] for s in SOILS],
            2,
            0,
        )
        n = len(maps[canopy])
        # Few arrangements give a poor estimate of their spread: pool the soils, which have the same crowns.
        spread = np.sqrt(np.mean(values_by_soil.var(axis=1, ddof=1), axis=0))
        error = np.hypot(spread * np.sqrt(1 + 1 / n), np.sqrt((stderr**2).mean(axis=(0, 1)) / n))
        for (k, soil), (i, (flux, name)), (j, band) in itertools.product(
            enumerate(SOILS), enumerate(FLUXES.items()), enumerate(BANDS)
        ):
            values = values_by_soil[k, :, i, j].mean(), references[band, canopy, soil, zenith, flux]
            case = f"{band}, leaf area index {canopy / 100:g}, soil {soil}, {zenith} degrees"
            rows.append(
                comparison(
                    f"forest: {name}",
                    "RAMI4PILPS",
                    case,
                    *values,
                    stderr=error[i, j],
                    zenith=zenith,
                    arrangements_apart=float(spread[i, j]),
                )
            )

    def draw(figure):
        for ax, name in zip(figure.subplots(1, 3, sharey=True), FLUXES.values()):
            group = [r for r in rows if r["what"] == f"forest: {name}"]
            for zenith, colour in zip(ZENITHS, COLOURS):
                zenith_rows = [r for r in group if r["zenith"] == zenith]
                differences, error = ([r[k] for r in zenith_rows] for k in ("difference", "standard error"))
                reference = [r["there"] for r in zenith_rows]
                ax.errorbar(
                    reference,
                    differences,
                    2 * np.array(error),
                    fmt="o",
                    ms=3,
                    lw=0.8,
                    color=colour,
                    label=f"{zenith} degrees",
                )
            ax.axhline(0.0, color="0.6", lw=0.8)
            ax.set(title=name, xlabel="reference")
        figure.axes[0].set_ylabel("difference, share of the light")
        ax.legend(fontsize=7)

    return finish(
        arguments,
        "rami4pilps",
        rows,
        title="Open forests against RAMI4PILPS",
        caption="""Differences with bars of two standard errors over the reference's value. Of the densest
        forest some are beyond them: voxels of 0.5 m make crowns a little wider and thinner at their
        edges than spheres are, so that they hold back more light; the finer the voxels, the less.""",
        unchecked="""Fluxes of slant sunlight, not waveforms: neither times of arrival nor the direction back
        to a sensor. The reference has no errors of its own and does not say where its crowns stand.""",
        draw=draw,
        of_others=True,
        size=(12.0, 4.5),
        rtol=arguments.rtol,
        arrangements=arguments.arrangements,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
