"""One scene from many records: leaf area in voxels from overlapping wide footprints.

Run it as `python examples/benchmarks/scene_retrieval.py [--out figures] [--footprints 225] [--voxel 1]`;
`--voxel` is the width of voxels in m, which are 1 m high.

Footprints 25 m across over a stand of 60 m x 60 m x 25 m in the open, simulated at first order, with normal
noise of 2 % of the largest sample. Leaves vary over tens of metres ("even"), or are in crowns of 3 to 6 m
("crowns"). Priors: a Markov field, which spreads leaves evenly within a footprint; and clumps of the density
and of the mean size of the crowns, or of three quarters of their height.
"""

import resource
import warnings
from pathlib import Path

import jax
import numpy as np
from _common import machine, new_figure, options, print_table, save_figure, write_json

import inversion
import jaxlidar as jl

SIDE, LAYERS, NOISE = 60, 25, 0.02
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


def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def retrieve(records: dict, survey: jl.Survey, scene: jl.Scene, unknowns: list, **settings):
    """Retrieve a scene; return the fit and the record of its cost and end."""
    cpu_start = cpu_seconds()
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
        progress=lambda step: print(f"\r{step}", end="", flush=True),
        **settings,
    )
    print()
    return fit, {
        "shots": len(survey),
        "unknowns": sum(int(value.size) for value in fit.values.values()),
        "cpu seconds": cpu_seconds() - cpu_start,
        "peak GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
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


def wide_footprints(shots: int, edge: float) -> list[dict]:
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
            settings = {} if label == "Markov field" else {"held_out": 0.0, "max_steps": 60}
            fit, row = retrieve(records, survey, scene, [unknown], **settings)
            rows.append({"stand": name, "prior": label, "edge": edge, **row, **leaf_errors(fit, lad)})
    return rows


def draw(rows: list[dict], out: Path) -> None:
    """Draw the profiles of the stands."""
    figure, axes = new_figure(2, size=(9, 4))
    height = np.arange(LAYERS) + 0.5
    for panel, name, title in zip(axes, ("even", "crowns"), ("even leaves", "leaves in crowns")):
        of_stand = [r for r in rows if r["stand"] == name]
        panel.plot(of_stand[0]["true profile"], height, color="0.3", lw=2, label="truth")
        for row, style in zip(of_stand, ("--", ":", "-.")):
            label = f"{row['prior']}, leaf area {100 * row['leaf area error']:+.0f} %"
            panel.plot(row["profile"], height, style, lw=2, label=label)
        panel.set(
            xlabel="leaf area density, m2/m3",
            ylabel="height, m",
            title=title,
        )
        panel.set(xlim=(0.0, None), ylim=(0.0, LAYERS))
        panel.legend(fontsize=8)
    save_figure(figure, out / "scene_retrieval.png")


def main() -> None:
    arguments = options("One scene from many records.", footprints=225, voxel=1)
    warnings.simplefilter("ignore", jl.OffMapWarning)
    rows = wide_footprints(arguments.footprints, float(arguments.voxel))
    write_json(arguments.out / "scene_retrieval.json", {"machine": machine(), "footprints": rows})
    draw(rows, arguments.out)
    columns = ("leaf area error", "profile correlation", "misfit", "cpu seconds")
    print_table(
        ("stand, prior", *columns), [(f"{r['stand']}, {r['prior']}", *(r[c] for c in columns)) for r in rows]
    )


if __name__ == "__main__":
    main()
