"""One scene from many records: leaf area in voxels, from wide footprints and from narrow shots, and terrain.

Records are simulated at first order, in the open. Priors: a Markov field, which spreads leaves evenly within
a footprint; and clumps of the density and of the mean size of the crowns, or of three quarters of their
height.
"""

import statistics
import time
import warnings

import equinox as eqx
import jax
import numpy as np
from _common import new_figure, number, page_of, peak_gigabytes, show_progress, table

import inversion
import jaxlidar as jl

TITLE = "One scene from many records"
QUICK = {"footprints": 9, "shots": 50, "track": 10, "edge": 2.0, "max_steps": 2}
SIDE, LAYERS, NOISE = 60, 25, 0.02
# Width of the strip of terrain along a track of footprints, m.
WIDTH = 60.0
# Leaf area density within crowns, m2/m3, and the crowns' mean diameter and height, m.
CROWN_DENSITY, CROWN_SIZE = 0.6, (4.5, 12.0)
LEAF, SOIL = jl.LeafOptics(0.45, 0.4), 0.3


def even_leaves(edge: float) -> np.ndarray:
    """Return leaf area density that varies over tens of metres, in m2/m3."""
    x, z = edge * (np.arange(round(SIDE / edge)) + 0.5), np.arange(LAYERS) + 0.5
    x, y, z = np.meshgrid(x, x, z, indexing="ij")
    top = 18.0 + 3.0 * np.sin(2.0 * np.pi * x / 45.0) * np.cos(2.0 * np.pi * y / 38.0)
    cover = 1.0 + 0.4 * np.cos(2.0 * np.pi * x / 50.0 + 1.0) * np.sin(2.0 * np.pi * y / 42.0)
    return 0.22 * cover * np.exp(-0.5 * ((z - 0.62 * top) / (0.2 * top)) ** 2)


def crowns(edge: float) -> np.ndarray:
    """Return ellipsoids of leaves at random positions, 500 per hectare."""
    random = np.random.default_rng(1)
    x, z = edge * (np.arange(round(SIDE / edge)) + 0.5), np.arange(LAYERS) + 0.5
    lad = np.zeros((x.size, x.size, LAYERS))
    for _ in range(round(500 * SIDE**2 / 1e4)):
        east, north = random.uniform(0, SIDE, 2)
        top, wide = random.uniform(0.6, 0.95) * LAYERS, random.uniform(1.5, 3.0)
        bottom = random.uniform(0.3, 0.5) * top
        i, j = (np.flatnonzero(np.abs(x - middle) < wide) for middle in (east, north))
        across = ((x[i, None] - east) / wide) ** 2 + ((x[None, j] - north) / wide) ** 2
        along = ((z - 0.5 * (top + bottom)) / (0.5 * (top - bottom))) ** 2
        block = lad[np.ix_(i, j)]
        lad[np.ix_(i, j)] = np.where(across[:, :, None] + along < 1.0, CROWN_DENSITY, block)
    return lad


def stand(lad: np.ndarray) -> jl.Scene:
    """Return leaves over level ground, `SIDE` wide."""
    edge = SIDE / len(lad)
    canopy = jl.Canopy(jl.VoxelMap.from_lad(lad, voxel_size=(edge, edge, 1.0)), leaf=LEAF)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=SOIL))


def observe(survey: jl.Survey, scene: jl.Scene) -> dict:
    """Simulate records with noise; return them with the noise and the times, as arguments of a fit."""
    # Errors of each shot are independent, and small beside the noise.
    waves = jl.simulate_many(survey, scene, key=jax.random.key(0), max_orders=1, rtol=0.02, shared=False)
    clean = np.asarray(waves.reflectance)
    noise = NOISE * float(clean.max())
    observed = clean + noise * np.random.default_rng(0).normal(size=clean.shape)
    return {"observed": observed, "noise": noise, "time": waves.time}


def retrieve(records: dict, survey: jl.Survey, scene: jl.Scene, unknowns: list, **settings):
    """Retrieve a scene; return the fit and the record of its cost and end."""
    cpu_start = time.process_time()
    fit = inversion.retrieve_scene(
        records["observed"],
        survey,
        scene,
        unknowns,
        noise=records["noise"],
        time=records["time"],
        key=jax.random.key(1),
        max_orders=1,
        draws=0,
        progress=show_progress,
        **settings,
    )
    return fit, {
        "shots": len(survey),
        "unknowns": sum(int(value.size) for value in fit.values.values()),
        "cpu seconds": time.process_time() - cpu_start,
        "peak GB": peak_gigabytes(),
        "steps": len(fit.history),
        "misfit": float(fit.misfit),
        "held out": float(fit.held_out_misfit) if np.any(np.asarray(fit.held_out)) else None,
        "status": fit.status,
    }


def leaf_unknown(lad: np.ndarray, difference: float) -> inversion.Unknown:
    return inversion.Unknown(
        "canopy.voxels.leaf",
        bounds=(0.0, 2.0),
        name="leaf",
        start=np.full(lad.shape, 0.05),
        prior=inversion.MarkovField(difference),
    )


def leaf_errors(fit, lad: np.ndarray) -> dict:
    """Return the error of the leaf area, the correlation of profiles, and the profiles."""
    # Half of the leaf area density is the extinction of a voxel.
    retrieved = 2.0 * np.asarray(fit.scene.canopy.voxels.leaf, float)

    profile, true_profile = retrieved.mean(axis=(0, 1)), lad.mean(axis=(0, 1))
    return {
        "leaf area error": float(retrieved.sum() / lad.sum() - 1.0),
        "profile correlation": float(np.corrcoef(profile, true_profile)[0, 1]),
        "profile": profile.tolist(),
        "true profile": true_profile.tolist(),
    }


def wide_footprints(shots: int, edge: float, max_steps: int) -> list[dict]:
    """Retrieve stands from footprints of 25 m, with several priors."""
    lidar = jl.Lidar(wavelength=1064.0, altitude=1000.0, divergence=25.0, pulse=jl.GaussianPulse(4.0))
    x = np.linspace(2.0, SIDE - 2.0, round(np.sqrt(shots)))
    survey = jl.Survey(lidar, np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2))
    rows = []
    for name, lad in (("even", even_leaves(edge)), ("crowns", crowns(edge))):
        scene, priors = stand(lad), {"Markov field": leaf_unknown(lad, 0.1)}
        if name == "crowns":
            for label, height in (
                ("clumps", CROWN_SIZE[1]),
                ("clumps, a quarter too low", 0.75 * CROWN_SIZE[1]),
            ):
                priors[label] = inversion.clumped_leaves(
                    scene, density=CROWN_DENSITY, size=(CROWN_SIZE[0], height), key=jax.random.key(2)
                )
        records = observe(survey, scene)
        for label, unknown in priors.items():
            # Clumps are settled by their prior, and need no early stopping but more steps.
            settings = {} if label == "Markov field" else {"held_out": 0.0, "max_steps": max_steps}
            fit, row = retrieve(records, survey, scene, [unknown], **settings)
            rows.append({"stand": name, "prior": label, "edge": edge, **row, **leaf_errors(fit, lad)})
    return rows


def narrow_shots(shots: int, edge: float) -> dict:
    """Retrieve crowns from shots of a scanner, 0.5 m wide and up to 10 degrees off nadir."""
    lidar = jl.Lidar(wavelength=1064.0, altitude=1000.0, divergence=0.5, pulse=jl.GaussianPulse(4.0))
    random = np.random.default_rng(3)
    position = random.uniform(1.0, SIDE - 1.0, (shots, 2))
    zenith, azimuth = random.uniform(0.0, 10.0, shots), random.uniform(0.0, 360.0, shots)
    survey, lad = jl.Survey(lidar, position, zenith, azimuth), crowns(edge)
    scene = stand(lad)
    fit, row = retrieve(observe(survey, scene), survey, scene, [leaf_unknown(lad, 0.3)], n_rays=16)
    retrieved = 2.0 * np.asarray(fit.scene.canopy.voxels.leaf, float)

    def in_blocks(a: np.ndarray) -> np.ndarray:
        """Return means over blocks of 2 m, without the layer that is left over."""
        across, height = round(2.0 / edge), 2
        a = a[:, :, : a.shape[2] // height * height]
        nx, ny, nz = (n // size for n, size in zip(a.shape, (across, across, height)))
        return a.reshape(nx, across, ny, across, nz, height).mean(axis=(1, 3, 5))

    blocks, true_blocks = in_blocks(retrieved).ravel(), in_blocks(lad).ravel()
    by_voxel = np.corrcoef(retrieved.ravel(), lad.ravel())[0, 1]
    by_block = np.corrcoef(blocks, true_blocks)[0, 1]
    correlations = {"voxel correlation": float(by_voxel), "correlation in 2 m": float(by_block)}
    middle = len(lad) // 2
    sections = {"true section": lad[:, middle].tolist(), "section": retrieved[:, middle].round(3).tolist()}
    return {"stand": "crowns", "edge": edge, **row, **leaf_errors(fit, lad), **correlations, **sections}


def hills(spacing: float, length: float) -> np.ndarray:
    """Return heights of nodes on a strip of the given length, `WIDTH` wide, in m."""
    x = spacing * np.arange(round(length / spacing) + 1)[:, None]
    y = spacing * np.arange(round(WIDTH / spacing) + 1)[None, :]
    return 5.0 + 2.5 * np.sin(x / 19.0) + 1.5 * np.cos(x / 31.0 + y / 23.0)


def terrain_track(shots: int) -> dict:
    """Retrieve terrain and leaves along a track of overlapping footprints, together and one by one.

    Leaves and terrain are unknown; the ground under each footprint alone is a slope of unknown height.
    """
    spacing, step, margin = 5.0, 2.5, 30.0
    length = 2.0 * margin + 10.0 * np.ceil(step * (shots - 1) / 10.0)
    lidar = jl.Lidar(wavelength=1064.0, altitude=1000.0, divergence=25.0, pulse=jl.GaussianPulse(6.0))
    track = np.stack([margin + step * np.arange(shots), np.full(shots, 0.5 * WIDTH)], axis=1)
    survey, heights = jl.Survey(lidar, track), hills(spacing, length)
    random, n_layers = np.random.default_rng(4), 36
    z, shape = np.arange(n_layers) + 0.5, (round(length / 10.0), round(WIDTH / 10.0))
    top = random.uniform(14.0, 22.0, shape)[..., None] + hills(10.0, length)[:-1, :-1, None]
    lad = 0.35 * random.uniform(0.6, 1.4, shape)[..., None] * np.exp(-0.5 * ((z - top + 6.0) / 3.5) ** 2)

    def scene_of(leaf: np.ndarray, nodes: np.ndarray) -> jl.Scene:
        voxels = jl.VoxelMap.from_lad(leaf, voxel_size=(10.0, 10.0, 1.0))
        return jl.Scene(
            canopy=jl.Canopy(voxels, leaf=LEAF), ground=jl.Terrain(nodes, spacing, reflectance=SOIL)
        )

    true_scene = scene_of(lad, heights)
    records = observe(survey, true_scene)
    # Footprint by footprint first: what each tells is where the fit of all together starts.
    single_fits, failed = one_by_one(survey, records, n_layers)
    nearest = np.abs(track[:, 0, None] - spacing * np.arange(len(heights))).argmin(axis=0)
    nearest_of_column = np.abs(track[:, 0, None] - 10.0 * (np.arange(shape[0]) + 0.5)).argmin(axis=0)
    # Relief of a centimetre, as heights in a plane are traced as one.
    start_heights = single_fits["height"][nearest][:, None] + 0.01 * random.normal(size=heights.shape)
    start_leaf = np.repeat(single_fits["leaf"][nearest_of_column][:, None], shape[1], axis=1)
    start = scene_of(start_leaf, np.clip(start_heights, 0.0, 12.0))
    leaf = inversion.Unknown(
        "canopy.voxels.leaf", bounds=(0.0, 2.0), name="leaf", prior=inversion.MarkovField(0.1)
    )
    nodes = inversion.Unknown(
        "ground.heights", bounds=(0.0, 12.0), name="heights", prior=inversion.MarkovField(0.5)
    )
    fit, row = retrieve(records, survey, start, [leaf, nodes], n_rays=128)
    inner = slice(shots // 20, -shots // 20)
    true_height = np.asarray(true_scene.ground.height_at(*track.T))
    together = np.asarray(fit.scene.ground.height_at(*track.T)) - true_height
    alone = single_fits["height"] - true_height

    def rms(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean(error[inner] ** 2)))

    return {
        **row,
        "rms together": rms(together),
        "rms alone": rms(alone),
        "failed alone": failed,
        "x": track[:, 0].tolist(),
        "true height": true_height.tolist(),
        "error together": together.tolist(),
        "error alone": alone.tolist(),
    }


def one_by_one(survey: jl.Survey, records: dict, n_layers: int) -> tuple[dict, int]:
    """Fit each footprint alone: height and slope of the ground, and leaves by layer; count what failed."""
    layers = jl.VoxelMap.from_lad(
        np.full((1, 1, n_layers), 0.05), voxel_size=(2000.0, 2000.0, 1.0), origin=(-1000.0, -1000.0, 0.0)
    )
    ground = jl.Ground(height=5.0, slope=5.0, reflectance=SOIL)
    scene = jl.Scene(canopy=jl.Canopy(layers, leaf=LEAF), ground=ground)

    def layers_set(scene: jl.Scene, lad: jax.Array) -> jl.Scene:
        return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, 0.5 * lad[None, None])

    unknowns = [
        inversion.Unknown(
            apply=layers_set,
            bounds=(0.0, 2.0),
            start=np.full(n_layers, 0.1),
            name="leaf",
            prior=inversion.Smooth(3.0, strength=0.1),
        ),
        inversion.Unknown("ground.height", bounds=(0.0, 12.0), name="height"),
        inversion.Unknown("ground.slope", bounds=(0.0, 20.0), name="slope"),
    ]
    problem = inversion.Problem(
        records["observed"],
        survey.lidar,
        scene,
        unknowns,
        noise=records["noise"],
        time=records["time"],
        max_orders=1,
        n_rays=16,
    )
    fits = inversion.retrieve_many(problem, key=jax.random.key(2), starts=3)
    return {name: np.asarray(a) for name, a in fits.values.items()}, int(np.sum(~np.asarray(fits.converged)))


def measure(
    footprints: int = 225, shots: int = 20_000, track: int = 200, edge: float = 1.0, max_steps: int = 60
) -> dict:
    """Return the fits of wide `footprints`, of narrow `shots`, and of the terrain under a `track`.

    - `edge`: width of voxels in m; they are 1 m high. - `max_steps`: of fits of clumps.
    """
    warnings.simplefilter("ignore", jl.OffMapWarning)
    # Voxels of leaves reach down to the lowest terrain; below the ground they are dark.
    warnings.simplefilter("ignore", jl.MisplacedCanopyWarning)
    return {
        "footprints": wide_footprints(footprints, edge, max_steps),
        "narrow": narrow_shots(shots, edge),
        "terrain": terrain_track(track),
    }


def draw(record: dict):
    """Draw the profiles of the stands, a section through the crowns, and the errors of the terrain."""
    figure, axes = new_figure(3, size=(12, 7), rows=2)
    height, narrow, terrain = np.arange(LAYERS) + 0.5, record["narrow"], record["terrain"]
    titles = {"even": "wide footprints, even leaves", "crowns": "wide footprints, leaves in crowns"}
    panels = [(title, [r for r in record["footprints"] if r["stand"] == s]) for s, title in titles.items()]
    panels.append(("narrow shots, leaves in crowns", [{"prior": "Markov field", **narrow}]))
    for panel, (title, rows) in zip(axes[0], panels):
        panel.plot(rows[0]["true profile"], height, color="0.3", lw=2, label="truth")
        for row, style in zip(rows, ("--", ":", "-.")):
            label = f"{row['prior']}, leaf area {100 * row['leaf area error']:+.0f} %"
            panel.plot(row["profile"], height, style, lw=2, label=label)
        panel.set(xlabel="leaf area density, m2/m3", ylabel="height, m", title=title)
        panel.set(xlim=(0.0, None), ylim=(0.0, LAYERS))
        panel.legend(fontsize=8)
    extent = (0.0, SIDE, 0.0, LAYERS)
    for panel, name in zip(axes[1], ("true section", "section")):
        image = panel.imshow(np.transpose(narrow[name]), origin="lower", extent=extent, vmin=0, vmax=0.8)
        title = "truth" if name == "true section" else f"retrieved from {narrow['shots']:,} narrow shots"
        panel.set(xlabel="east, m", ylabel="height, m", title=title)
        panel.set_aspect("auto")
    figure.colorbar(image, ax=axes[1, :2], label="leaf area density, m2/m3", shrink=0.8)
    panel = axes[1, 2]
    for name in ("alone", "together"):
        label = f"{name}, rms {terrain[f'rms {name}']:.2f} m"
        panel.plot(terrain["x"], terrain[f"error {name}"], lw=1, label=label)
    panel.set(
        xlabel="along the track, m", ylabel="error of the ground's height, m", title="terrain under leaves"
    )
    panel.legend(fontsize=8)
    return figure


def section(record: dict) -> str:
    rows, narrow, terrain = record["footprints"], record["narrow"], record["terrain"]
    medians = {k: statistics.median(map(abs, terrain[f"error {k}"])) for k in ("alone", "together")}
    columns = {
        "stand": "stand",
        "prior": "prior",
        "leaf area error": lambda r: f"{100 * r['leaf area error']:+.0f} %",
        "correlation of the profile": lambda r: f"{r['profile correlation']:.3f}",
        "misfit": lambda r: number(r["misfit"], 3),
        "steps": "steps",
        "CPU s": "cpu seconds",
        "GB": "peak GB",
    }
    return page_of(
        f"Leaf extinction in {rows[0]['unknowns']:,} voxels, {rows[0]['edge']:g} m wide and 1 m high, of a "
        f"stand of 60 m x 60 m x 25 m, from {rows[0]['shots']} overlapping footprints of 25 m with noise of "
        "2 % of the largest sample. Leaves vary over tens of metres (even), or are in crowns of 3 to 6 m. "
        "Misfit is chi-squared over the number of samples: one is the noise. CPU seconds include "
        "compilation.",
        table(rows, columns),
        "All priors explain the records to their noise. Leaf area beyond that of the Markov field, in "
        "crowns narrower than a footprint, is not in these records: it comes from what `clumped_leaves` is "
        "told of the crowns, and is no better than that.",
        f"**Narrow shots.** The crowns from {narrow['shots']:,} shots 0.5 m wide, up to 10 degrees off "
        f"nadir: leaf area {100 * narrow['leaf area error']:+.1f} %, correlation of the voxels "
        f"{narrow['voxel correlation']:.3f}, and {narrow['correlation in 2 m']:.3f} of means over 2 m; "
        f"{number(narrow['cpu seconds'])} CPU seconds, {number(narrow['peak GB'])} GB.",
        f"**Terrain under leaves.** {terrain['shots']} footprints of 25 m, 2.5 m apart, over hills under "
        f"leaves of unknown density. The rms error of the ground's height is {terrain['rms alone']:.2f} m "
        f"where each footprint is fitted alone, over a slope of its own, and {terrain['rms together']:.2f} m "
        "where nodes of the terrain and voxels of leaves are fitted to all records together, from there on; "
        f"the median sizes of the error are {medians['alone']:.2f} and {medians['together']:.2f} m: single "
        f"fits that end at another echo make the difference. {number(terrain['cpu seconds'])} CPU seconds.",
    )
