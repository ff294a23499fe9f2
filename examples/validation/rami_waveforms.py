"""Waveforms of canopies of discs, HET01, HET04 and HET06 of RAMI, of the first order and of all orders.

    python examples/validation/rami_waveforms.py FOLDER [--out figures] [--photons 32768] [--rays 400000]

FOLDER: as for `rami_reflectance.py`, with the same optics. The lidar is that of RAMI-IV's measurements
lidar_co_sgl and lidar_tot, but for the wavelength: an instantaneous pulse of parallel light, even over a disc
of 50 m diameter about the origin at the top of the canopy, at nadir, and at 30 degrees from the east.

The first order over discs is compared with rays that meet exact discs, traced with NumPy and a k-d tree;
voxels are compared with discs. `rami_waveforms.csv` holds the columns of RAMI-IV, from the ground to the top:
height of the middle of a bin, m, and apparent reflectance of single scattering and in total, each with its
standard deviation.
"""

import csv
import sys
from typing import NamedTuple

import jax
import numpy as np
from _rami import NAMES, WAVELENGTH, WEST, Forest, disc_scene, read_forest, voxel_scene
from _validation import COLOURS, comparison, finish, options, with_progress
from scipy.spatial import KDTree

import jaxlidar as jl
from jaxlidar.io import atomic_write

ZENITHS, SIZES = (0.0, 30.0), (0.5,)
DIAMETER, ALTITUDE, INTERVAL = 50.0, 1e6, 0.5
SPEED_OF_LIGHT = 0.299792458
# Samples in an interval of heights whose sums are compared.
BLOCK = 6
# Rays that are traced at once by NumPy, and by jaxlidar in each batch of the first order.
RAYS, RAYS_PER_BATCH = 20_000, 16_384


class Profile(NamedTuple):
    """Apparent reflectance by height: heights, m, and values of the first order and of all, with errors."""

    height: np.ndarray
    first: np.ndarray
    first_error: np.ndarray
    total: np.ndarray
    total_error: np.ndarray


def direction(zenith: float) -> np.ndarray:
    """Return the direction of the beam, down and to the west."""
    angle = np.deg2rad(zenith)
    return np.array([-np.sin(angle), 0.0, -np.cos(angle)])


def lidar_of(forest: Forest, zenith: float) -> jl.Lidar:
    """Return the lidar, whose samples are 0.5 m apart in height."""
    cosine = np.cos(np.deg2rad(zenith))
    return jl.Lidar(
        wavelength=WAVELENGTH,
        altitude=ALTITUDE,
        zenith=zenith,
        azimuth=WEST,
        # A disc across the beam, whose range is the altitude over the cosine.
        divergence=1e3 * DIAMETER * cosine**2 / ALTITUDE,
        profile="top-hat",
        pulse=jl.RectangularPulse(length=0.0),
        sampling_interval=2 * INTERVAL / (SPEED_OF_LIGHT * cosine),
        position=(-forest.height * np.tan(np.deg2rad(zenith)), 0.0),
    )


def simulate(forest: Forest, scene: jl.Scene, zenith: float, n_photons: int) -> Profile:
    """Simulate the first order and all orders, each by a run of its own."""
    lidar, values = lidar_of(forest, zenith), []
    # A slant beam meets the ground before and after its axis does.
    margin = 2.0 + 0.5 * DIAMETER * np.sin(np.deg2rad(zenith))
    time_of_height = -2 / (SPEED_OF_LIGHT * np.cos(np.deg2rad(zenith)))
    window = time_of_height * (forest.height + margin), -time_of_height * margin
    for orders in ({"max_orders": 1, "n_rays": RAYS_PER_BATCH}, {"n_photons": n_photons}):
        wave = jl.simulate(lidar, scene, key=jax.random.key(5), rtol=0.9, window=window, **orders)
        # From the ground up.
        values.append(np.asarray([wave.height, wave.reflectance[0], wave.stderr[0]], float)[:, ::-1])
    (height, *first), (_, *total) = values
    return Profile(height, *first, *total)


def exact_first_order(forest: Forest, zenith: float, n_rays: int, height: np.ndarray) -> Profile:
    """Trace rays to the first of the exact discs or the ground; sums about the heights, and errors.

    A disc of normal n that the beam d meets returns R |n . d|, the ground R cos(zenith).
    """
    down = direction(zenith)
    # Axes across the beam: west-east and up, and south-north.
    across = np.stack([[-down[2], 0.0, down[0]], [0.0, 1.0, 0.0]])
    top = np.array([0.0, 0.0, forest.height])
    discs, centre, reflectance = [], [], []
    for cloud in forest.clouds:
        for position in cloud.position:
            place = cloud.discs[:, 1:4] + position
            near = np.linalg.norm((place - top) @ across.T, axis=1) < 0.5 * DIAMETER + 1.0
            discs.append(cloud.discs[near])
            centre.append(place[near])
            reflectance.append(np.full(near.sum(), cloud.reflectance))
    discs, centre, reflectance = (np.concatenate(a) for a in (discs, centre, reflectance))
    normal = discs[:, 4:] / np.linalg.norm(discs[:, 4:], axis=1, keepdims=True)
    tree = KDTree((centre - top) @ across.T)
    rng = np.random.default_rng(7)
    edges = np.append(height - 0.5 * INTERVAL, height[-1] + 0.5 * INTERVAL)
    sums, squares = np.zeros(len(height)), np.zeros(len(height))
    for _ in range(n_rays // RAYS):
        radius = 0.5 * DIAMETER * np.cos(np.deg2rad(zenith)) * np.sqrt(rng.uniform(size=RAYS))
        turn = 2 * np.pi * rng.uniform(size=RAYS)
        foot = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)
        start = top + foot @ across
        candidates = tree.query_ball_point(foot, float(discs[0, 0]))
        ray = np.repeat(np.arange(RAYS), [len(c) for c in candidates])
        disc = np.concatenate([np.asarray(c, int) for c in candidates])
        cosine = normal[disc] @ down
        offset = centre[disc] - start[ray]
        depth = np.sum(normal[disc] * offset, axis=1) / np.where(np.abs(cosine) > 1e-9, cosine, 1e-9)
        apart = np.linalg.norm(depth[:, None] * down - offset, axis=1)
        depth[apart > discs[disc, 0]] = np.inf
        nearest = start[:, 2] / -down[2]
        np.minimum.at(nearest, ray, depth)
        is_hit = depth == nearest[ray]
        value = np.full(RAYS, forest.ground * -down[2])
        value[ray[is_hit]] = reflectance[disc[is_hit]] * np.abs(cosine[is_hit])
        # The time of a return tells its depth below the plane through the top across the beam.
        level = forest.height + down[2] * nearest
        number = np.clip(np.digitize(level, edges) - 1, 0, len(height) - 1)
        sums += np.bincount(number, value, len(height))
        squares += np.bincount(number, value**2, len(height))
    n = RAYS * (n_rays // RAYS)
    mean = sums / n
    error = np.sqrt((squares / n - mean**2) / n)
    return Profile(height, mean, error, mean, error)


def blocks(values: np.ndarray) -> np.ndarray:
    """Return sums over `BLOCK` heights."""
    return values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK).sum(axis=1)


def first_order_rows(name: str, view: str, profile: Profile, exact: Profile) -> list[dict]:
    """Compare the first order over discs with exact discs, by sums over heights and in all."""
    height, ours, theirs = blocks(profile.height) / BLOCK, blocks(profile.first), blocks(exact.first)
    error = np.sqrt(blocks(profile.first_error**2) + blocks(exact.first_error**2))
    what, against = f"{name}: first order over discs", "exact discs by NumPy"
    rows = [
        comparison(what, against, f"{view}, {h:.3g} m", a, b, stderr=e)
        for h, a, b, e in zip(height, ours, theirs, error)
        if b > 0.01 * theirs.max()
    ]
    total_error = np.sqrt(np.sum(profile.first_error**2) + np.sum(exact.first_error**2))
    in_all = profile.first.sum(), exact.first.sum()
    return [*rows, comparison(what, against, f"{view}, in all", *in_all, stderr=total_error)]


def write_columns(path, profiles: dict[tuple[str, str, str], Profile]) -> None:
    """Write the profiles in RAMI-IV's order, from the ground to the top."""
    head = ("canopy", "scatterers", "view", "height", "single", "single_std", "total", "total_std")
    with atomic_write(path) as draft, draft.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(head)
        for case, profile in profiles.items():
            for line in zip(*profile):
                rows.writerow([*case, *(f"{x:.6g}" for x in line)])


def main(argv=None):
    arguments = options(__doc__, argv, "folder", photons=32_768, rays=400_000, canopies=len(NAMES))
    rows, lines, profiles = [], [], {}
    for name in with_progress(arguments, NAMES[: arguments.canopies]):
        forest = read_forest(arguments.folder, name)
        for size in (0.0, *SIZES):
            scene = voxel_scene(forest, size) if size else disc_scene(forest)
            scatterers = f"voxels of {size:g} m" if size else "discs"
            for zenith in ZENITHS:
                view = f"{zenith:g} degrees" if zenith else "nadir"
                profile = simulate(forest, scene, zenith, arguments.photons)
                profiles[name, scatterers, view] = profile
                discs = profiles[name, "discs", view]
                if size:
                    for what, k in (("first order", 1), ("all orders", 3)):
                        here, there = profile[k].sum(), discs[k].sum()
                        title = f"{name}: {what}, {scatterers}"
                        rows.append(comparison(title, "discs", view, here, there, bound=0.03 * there))
                else:
                    exact = exact_first_order(forest, zenith, arguments.rays, profile.height)
                    rows += first_order_rows(name, view, profile, exact)
                shape = np.abs(blocks(profile.total) - blocks(discs.total)).sum() / discs.total.sum()
                values = (f"{profile.first.sum():.4f}", f"{profile.total.sum():.4f}")
                lines.append([name, view, scatterers, *values, f"{100 * shape:.1f} %" if size else ""])

    def draw(figure):
        axes = figure.subplots(len(ZENITHS), arguments.canopies, squeeze=False)
        for (name, scatterers, view), profile in profiles.items():
            kinds = ["discs", *(f"voxels of {size:g} m" for size in SIZES)]
            views = [f"{zenith:g} degrees" if zenith else "nadir" for zenith in ZENITHS]
            ax, colour = axes[views.index(view), NAMES.index(name)], COLOURS[::-1][kinds.index(scatterers)]
            ax.plot(profile.total, profile.height, color=colour, lw=1.0, label=scatterers)
            ax.plot(profile.first, profile.height, color=colour, lw=1.0, ls=":")
            ax.set(title=f"{name}, {view}", xscale="log", xlim=(1e-5, 0.3))
        axes[0, 0].legend(fontsize=7)
        for ax in axes[-1]:
            ax.set_xlabel("apparent reflectance per 0.5 m")
        for ax in axes[:, 0]:
            ax.set_ylabel("height (m)")

    record = finish(
        arguments,
        "rami_waveforms",
        rows,
        title="Waveforms of canopies of discs",
        caption="""Apparent reflectance by height in all orders (lines) and of the first (dotted), over
        discs and over voxels. Columns for comparisons are in `rami_waveforms.csv`.""",
        unchecked="""Higher orders over discs: their sum is that of the reflectance factors above, their times
        are jaxlidar's own. RAMI-IV asks for another wavelength.""",
        draw=draw,
        of_others=True,
        size=(4.0 * arguments.canopies, 7.0),
        photons=arguments.photons,
        tables=[{"text": TABLE, "headings": HEADINGS, "lines": lines}],
    )
    write_columns(arguments.out / "rami_waveforms.csv", profiles)
    return record


TABLE = """Apparent reflectance within the record, which ends two metres below the ground, and the light that
voxels return from other heights than discs: the sum of absolute differences in intervals of 3 m over the
total."""
HEADINGS = ["canopy", "view", "scatterers", "first order", "all orders", "elsewhere"]

if __name__ == "__main__":
    main()
    sys.exit(0)
