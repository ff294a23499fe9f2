"""How far voxel maps are from the triangles of the same tree, waveform by waveform.

The tree is the paper's (Table 2), with and without leaves. As triangles it has leaves of random places and
orientations in each clump; `section` explains the two kinds of voxel maps. Each simulation is repeated with
independent keys, from which standard errors follow.
"""

import statistics
import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from _common import new_figure, number, page_of, table
from matplotlib.ticker import NullLocator

import inversion
import jaxlidar as jl

TITLE = "Voxels against triangles"
QUICK = {"runs": 2, "photons": 128, "n_edges": 1, "n_footprints": 1}
ORDERS = 8
EDGES = (1.0, 0.5, 0.25, 0.1)
# Leaves of each clump, and their length, m: rhombuses of a quarter of its square.
LEAVES, LEAF_LENGTH = 2, 0.1
LEAF_AREA = LEAVES * 0.25 * LEAF_LENGTH**2
LEAF, WOOD, GROUND = jl.LeafOptics(0.45, 0.4), 0.4, 0.3
PULSE = jl.GaussianPulse(fwhm=6.0)
WINDOW = (-125.0, 45.0)
KINDS = {"by area": {"leaf_area": LEAF_AREA, "wood": "surface"}, "by volume": {}}
TRIANGLES, OTHER_LEAVES = "triangles", "other leaves"
# Waveforms in the figure, by kind and edge.
DRAWN = {
    (TRIANGLES, 0.0): {"color": "black", "linewidth": 1.8},
    ("by area", 1.0): {"color": "#E69F00"},
    ("by area", 0.25): {"color": "#0072B2"},
    ("by volume", 0.25): {"color": "#CC79A7", "linestyle": "--"},
}
PARTS = ("ground", "leaf", "wood")
MEASURES = ("total", "RH50", "RH98", *PARTS, "ground share")


class Footprint(NamedTuple):
    """Diameter of a footprint at 1/e2, and its place, m."""

    diameter: float
    place: tuple[float, float]

    def lidar(self) -> jl.Lidar:
        """Return the lidar from orbit, so that light is parallel."""
        return jl.Lidar(altitude=4e5, divergence=1e3 * self.diameter / 4e5, pulse=PULSE, position=self.place)


# The middle of the crown, and two places towards its edge.
FOOTPRINTS = (
    *(Footprint(5.0, place) for place in ((-1.2, 0.8), (1.8, 0.8), (-1.2, 3.8))),
    Footprint(25.0, (-1.2, 0.8)),
)


class Runs(NamedTuple):
    """Waveforms of independent runs.

    - `height`: (samples,) m.
    - `waves`: (runs, samples) apparent reflectance by name: "first order", "all orders", and each of `PARTS`.
    """

    height: np.ndarray
    waves: Mapping[str, np.ndarray]

    def measures(self, orders: str) -> np.ndarray:
        """Return `MEASURES`, of the first order those that materials have no part in; (runs, measures)."""
        power = self.waves[orders]
        values = [power.sum(axis=1)]
        ends = (float(self.height.max()), float(self.height.min()))
        rh = inversion.relative_heights(self.height, power, levels=(50.0, 98.0), ends=ends)
        values += list(np.asarray(rh).T)
        if orders == "all orders":
            values += [self.waves[name].sum(axis=1) for name in PARTS]
            values.append(values[MEASURES.index("ground")] / values[MEASURES.index("total")])
        return np.stack(values, axis=1)


def mesh_scene(tree: jl.Tree, seed: int = 0) -> jl.Scene:
    """Return the triangles of a tree over the ground."""
    mesh = jl.mesh_of(tree, leaves=LEAVES, leaf_length=LEAF_LENGTH, seed=seed)
    reflectance = {"wood": WOOD, "leaf": LEAF.reflectance}
    transmittance = {"leaf": LEAF.transmittance} if "leaf" in mesh.materials else {}
    surface = jl.MeshSurface(mesh, {n: reflectance[n] for n in mesh.materials}, transmittance)
    return jl.Scene(meshes=(surface,), ground=jl.Ground(reflectance=GROUND))


def voxel_scene(tree: jl.Tree, edge: float, kind: str) -> jl.Scene:
    """Return a voxel map of a tree over the ground."""
    voxels = jl.voxelise(tree, edge, **KINDS[kind])
    canopy = jl.Canopy(voxels, leaf=None if voxels.leaf is None else LEAF, bark=WOOD)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=GROUND))


def scene_size(scene: jl.Scene) -> int:
    """Return the number of triangles, or of voxels."""
    if scene.canopy is not None:
        return int(np.prod(scene.canopy.voxels.shape))
    return sum(surface.n_triangles for surface in scene.meshes)


def simulations(footprint: Footprint, scene: jl.Scene, key: jax.Array, runs: int, photons: int) -> Runs:
    """Simulate a footprint with independent keys."""
    lidar = footprint.lidar()
    plan = jl.plan(
        lidar,
        scene,
        # A tolerance that eight batches meet.
        rtol=0.9,
        max_orders=ORDERS,
        n_photons=photons,
        n_rays=photons // 4,
        window=WINDOW,
        describe=False,
    )
    waves = [jl.simulate(lidar, scene, plan=plan, rtol=0.9, key=k) for k in jax.random.split(key, runs)]
    names = {"first order": "first", "ground": "ground"}
    names |= {"leaf": "mesh:leaf", "wood": "mesh:wood"} if scene.meshes else {"leaf": "leaf", "wood": "bark"}
    nothing = np.zeros_like(waves[0].reflectance[0])
    samples = {
        name: np.stack([np.asarray(w.components[c][0]) if c in w.components else nothing for w in waves])
        for name, c in names.items()
    }
    samples["all orders"] = np.stack([np.asarray(w.reflectance[0]) for w in waves])
    return Runs(np.asarray(waves[0].height), samples)


def squared_error(values: np.ndarray) -> np.ndarray:
    """Return the squared standard error of the mean over runs, the first axis."""
    return np.var(values, axis=0, ddof=1) / len(values)


def compare(result: Runs, reference: Runs, orders: str) -> dict[str, object]:
    """Return how far a simulation is from another: of the waveform and of its measures, with errors.

    The relative root mean square difference is that of samples above 1 % of the peak, over the root mean
    square of the reference there.
    """
    waves, truths = result.waves[orders], reference.waves[orders]
    truth = truths.mean(axis=0)
    is_bright = truth > 0.01 * truth.max()
    noise = np.sum((squared_error(waves) + squared_error(truths))[is_bright])
    square = np.sum((waves.mean(axis=0) - truth)[is_bright] ** 2)
    scale = np.sum(truth[is_bright] ** 2)
    values, true_values = result.measures(orders), reference.measures(orders)
    error = np.sqrt(squared_error(values) + squared_error(true_values))
    difference = values.mean(axis=0) - true_values.mean(axis=0)
    return {
        "orders": orders,
        "rms": float(np.sqrt(max(square - noise, 0.0) / scale)),
        "rms of noise": float(np.sqrt(noise / scale)),
        "differences": dict(zip(MEASURES, difference.tolist())),
        "errors": dict(zip(MEASURES, error.tolist())),
        "reference": dict(zip(MEASURES, true_values.mean(axis=0).tolist())),
    }


def scenes(tree: jl.Tree, edges: tuple[float, ...]) -> Iterator[tuple[str, float, float, jl.Scene]]:
    """Yield each scene to compare: its kind, its edge (m; 0 of triangles), and the seconds it took to make.

    The first is the reference.
    """
    for kind, edge in [
        (TRIANGLES, 0.0),
        *([(OTHER_LEAVES, 0.0)] if len(tree.bud_position) else []),
        *((kind, edge) for kind in KINDS for edge in edges),
    ]:
        start = time.perf_counter()
        scene = voxel_scene(tree, edge, kind) if edge else mesh_scene(tree, int(kind == OTHER_LEAVES))
        yield kind, edge, time.perf_counter() - start, scene


def steepness_factor(tree: jl.Tree) -> float:
    """Return the reflectance of wood in voxels over that of the branches, of equal areas seen from above.

    Per area seen, a Lambertian surface returns its cosine: on average 2/3 of facets of all orientations, as
    voxels have them, and less of the sides of steep branches.
    """
    corners = jl.mesh_of(tree.leafless()).corners
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    upward = normal[normal[:, 2] > 0]
    seen, cosine = upward[:, 2], upward[:, 2] / np.linalg.norm(upward, axis=1)
    return float(2 / 3 / np.average(cosine, weights=seen))


def rounded(x: Any) -> Any:
    """Return a record with its numbers to five significant digits."""
    if isinstance(x, Mapping):
        return {name: rounded(value) for name, value in x.items()}
    if isinstance(x, list | tuple):
        return [rounded(value) for value in x]
    return float(f"{x:.5g}") if isinstance(x, float) else x


def measure(runs: int = 4, photons: int = 32768, n_edges: int = 4, n_footprints: int = 4) -> dict:
    """Return differences from the triangles, of independent runs; of voxels, the largest edges come first."""
    tree = jl.grow(jl.broadleaf(), seed=0)
    footprints = FOOTPRINTS[:n_footprints]
    rows, sizes, waves, height = [], [], [], np.zeros(0)
    key = jax.random.key(0)
    for leaves, state in (("leaf-on", tree), ("leaf-off", tree.leafless())):
        reference: list[Runs] = []
        for kind, edge, seconds, scene in scenes(state, EDGES[:n_edges]):
            names = {"leaves": leaves, "kind": kind, "edge": edge}
            start, results = time.perf_counter(), []
            for footprint in footprints:
                # No two simulations share a key: their errors count as independent.
                key, run_key = jax.random.split(key)
                results.append(simulations(footprint, scene, run_key, runs, photons))
            elapsed = time.perf_counter() - start
            reference = reference or results
            seconds = {"seconds to make": seconds, "seconds to simulate": elapsed}
            sizes.append({**names, "size": scene_size(scene), **seconds})
            height = results[0].height
            if (kind, edge) in DRAWN:
                mean = results[0].waves["all orders"].mean(axis=0)
                waves.append({**names, "reflectance": mean.tolist()})
            for footprint, result, truth in zip(footprints, results, reference):
                if kind != TRIANGLES:
                    comparisons = [compare(result, truth, orders) for orders in ("first order", "all orders")]
                    rows += [{**names, **footprint._asdict(), **c} for c in comparisons]
    return rounded(
        {
            "runs": runs,
            "photons": photons,
            "orders": ORDERS,
            "clumps": len(tree.bud_position),
            "leaf area of a clump": LEAF_AREA,
            "steepness factor of wood": steepness_factor(tree),
            "scenes": sizes,
            "rows": rows,
            "height": height.tolist(),
            "waves": waves,
        }
    )


def draw(record: Mapping[str, Any]) -> Any:
    """Draw waveforms of the first footprint, and differences by the edge of voxels."""
    figure, axes = new_figure(2, (10.0, 5.6), rows=2)
    for (wave_axes, difference_axes), leaves in zip(axes, ("leaf-on", "leaf-off")):
        for wave in record["waves"]:
            if wave["leaves"] == leaves:
                name = f"voxels of {wave['edge']:g} m, {wave['kind']}" if wave["edge"] else wave["kind"]
                look = DRAWN[wave["kind"], wave["edge"]]
                wave_axes.plot(wave["reflectance"], record["height"], label=name, **look)
        wave_axes.set(ylim=(-2.0, 17.5), xlim=(0.0, None), ylabel="height (m)")
        wave_axes.set_title(f"{leaves}: a footprint of 5 m, all orders", fontsize="medium")
        draw_differences(difference_axes, [row for row in record["rows"] if row["leaves"] == leaves])
        difference_axes.set_title(f"{leaves}: difference from the triangles", fontsize="medium")
    axes[1, 0].legend(frameon=False, fontsize="small", loc="upper right")
    axes[1, 0].set_xlabel("apparent reflectance per sample of 1 ns")
    axes[1, 1].set_xlabel("edge of voxels (m)")
    figure.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure


def draw_differences(axes: Any, rows: list[dict]) -> None:
    """Draw relative rms differences by the edge of voxels; bars: from the least to the largest footprint."""
    colours = {("by volume", 5.0): "#CC79A7", ("by area", 5.0): "#0072B2", ("by area", 25.0): "#56B4E9"}
    edges = np.array(sorted({row["edge"] for row in rows if row["edge"]}))
    for (kind, diameter), colour in colours.items():
        for orders, look in (("first order", {"fillstyle": "none", "ls": "--"}), ("all orders", {"ls": "-"})):
            values = [
                [r["rms"] for r in rows if (r["kind"], r["diameter"], r["orders"], r["edge"]) == chosen]
                for chosen in ((kind, diameter, orders, edge) for edge in edges)
            ]
            if not all(values):
                continue
            mean = np.array([np.mean(v) for v in values])
            bars = np.abs(np.array([[min(v), max(v)] for v in values]).T - mean)
            name = f"{kind}, {diameter:g} m,\n{orders}"
            axes.errorbar(edges, mean, bars, color=colour, marker="o", markersize=5, label=name, **look)
    narrow = [row for row in rows if row["diameter"] == 5.0 and row["orders"] == "all orders"]
    levels = {"noise of the simulations, 5 m": np.mean([row["rms of noise"] for row in narrow])}
    others = [row["rms"] for row in narrow if row["kind"] == OTHER_LEAVES]
    if others:
        levels["other leaves, 5 m"] = np.mean(others)
    for name, level in levels.items():
        axes.axhline(level, color="grey", linestyle=":")
        axes.text(edges[-1], level, name, color="grey", fontsize="small", ha="right", va="bottom")
    axes.set(xscale="log", yscale="log", ylabel="relative rms difference")
    axes.set_xticks(edges, [f"{edge:g}" for edge in edges])
    axes.xaxis.set_minor_locator(NullLocator())


def waveform_difference(rows: list[dict]) -> str:
    """Return the mean over footprints of the rms difference in percent, or the noise if that is larger."""
    rms, noise = (100 * statistics.fmean(row[name] for row in rows) for name in ("rms", "rms of noise"))
    return f"{rms:.1f}" if rms > noise else f"< {noise:.1f}"


def difference(rows: list[dict], measure: str, relative: bool = False) -> str:
    """Return the mean difference over footprints with its standard error, in percent if relative."""
    reference = statistics.fmean(row["reference"][measure] for row in rows)
    if reference == 0.0:
        return ""
    factor, digits = (100.0 / reference, 1) if relative else (1.0, 3)
    value = factor * statistics.fmean(row["differences"][measure] for row in rows)
    error = abs(factor) * sum(row["errors"][measure] ** 2 for row in rows) ** 0.5 / len(rows)
    return f"{value:+.{digits}f} ± {error:.{digits}f}"


def section(record: dict) -> str:
    scenes = [s for s in record["scenes"] if s["kind"] != TRIANGLES]
    diameters = sorted({row["diameter"] for row in record["rows"]})
    narrow = diameters[0]

    def rows_of(scene: dict, orders: str = "all orders", diameter: float = narrow) -> list[dict]:
        chosen = {key: scene[key] for key in ("leaves", "kind", "edge")}
        chosen |= {"orders": orders, "diameter": diameter}
        return [row for row in record["rows"] if all(row[key] == value for key, value in chosen.items())]

    def noise(scene: dict) -> str:
        return f"{100 * statistics.fmean(row['rms of noise'] for row in rows_of(scene)):.1f}"

    scene_columns = {
        "leaves": "leaves",
        "scene": lambda s: f"{s['edge']:g} m, {s['kind']}" if s["edge"] else s["kind"],
    }
    waves = {
        f"{d:g} m, {orders}: %": lambda s, d=d, orders=orders: waveform_difference(rows_of(s, orders, d))
        for d in diameters
        for orders in ("first order", "all orders")
    }
    percents = {
        f"{m}: %": lambda s, m=m: difference(rows_of(s), m, relative=True)
        for m in ("total", "leaf", "wood", "ground")
    }
    heights = {f"{m}: m": lambda s, m=m: difference(rows_of(s), m) for m in ("RH50", "RH98")}
    triangles, *_ = record["scenes"]
    finest = min((s for s in scenes if s["kind"] == "by area"), key=lambda s: s["edge"])
    shots = record["runs"] * len({(row["diameter"], tuple(row["place"])) for row in record["rows"]})
    return page_of(
        f"The paper's tree over ground at 1064 nm, as {triangles['size']:,} triangles and as voxels, seen by "
        f"footprints of {' and '.join(f'{d:g}' for d in diameters)} m with a pulse of 6 ns, "
        f"{record['orders']} orders.",
        '"By area": `voxelise(tree, edge, leaf_area=, wood="surface")` has the leaf area of the triangles '
        'and attenuates by a quarter of the surface of wood. "By volume": the default of `voxelise`, the '
        "paper's probability map, has the fractions of voxels that clumps and wood fill; its leaf area "
        'follows from the edge. "Other leaves": triangles whose leaves have other random places within the '
        "same clumps, which is as near as a map can come.",
        "Leaf optics, wood, ground and lidar are the same. In voxels, too, light of the first order returns "
        "through the gap by which it came (`hotspot=True`, the default; the paper has none). Light of higher "
        "orders meets the gaps among triangles again, but in voxels it is attenuated independently.",
        "Root mean square difference of waveforms from those of the triangles, over samples above 1 % of the "
        "peak, in percent of the root mean square there; mean over footprints. What the noise of the "
        "simulations adds is subtracted.",
        table(scenes, {**scene_columns, **waves, f"{narrow:g} m, noise: %": noise}),
        f"Differences of the footprints of {narrow:g} m, all orders, with standard errors of the "
        "simulations: of the apparent reflectance in all and of each material, and of relative heights.",
        table(scenes, {**scene_columns, **percents, **heights}),
        "What remains by area at 0.1 m without leaves is scattering, not attenuation: facets of wood in "
        "voxels have all orientations, branches are steep. By their normals alone, wood seen from above "
        f"returns {100 * (record['steepness factor of wood'] - 1):.0f} % more in voxels than as triangles.",
        f"{shots} simulations of {record['photons']:,} photons, compilation included, take "
        f"{number(triangles['seconds to simulate'])} s with triangles and "
        f"{number(finest['seconds to simulate'])} s with {finest['size']:,} voxels of {finest['edge']:g} m.",
    )
