"""Waveforms of a scene of triangles against Mitsuba 3 with mitransient, and what 1 % costs both.

    python examples/validation/mitransient_meshes.py [--out figures] [--repeats 32]

Needs `pip install 'jaxlidar[bench]'`. A house with a roof, a wall beside it and three trunks stand on a
plane; all are Lambertian on both sides, and no two have the same reflectance but house and wall, between
which light goes to and fro. The beam comes from 10 km at 30 degrees, uniform over a disc of 5 m; the receiver
sees everything. Order one alone, and orders 1 to 6, of a pulse of 6 ns. The renderer's roles of laser and
receiver are exchanged, as in the benchmark (`examples/benchmarks/_peer_mitransient.py`).

Both codes run one after the other on the same cores. Seconds to 1 % are those of a repetition times the
square of its error over 1 %, as in `examples/benchmarks/peers.py`.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from _peer import run_peer
from _validation import COLOURS, finish, options, with_progress
from _waveforms import draw_cases, rows_of
from peers import FINE, SAMPLES, WINDOW, cost_of, repeat_jaxlidar, sampled

import jaxlidar as jl

CODE = "mitransient"
DISTANCE, ZENITH, RADIUS, PULSE = 1e4, 30.0, 5.0, 6.0
# The orders that each case follows.
CASES = {"order 1": 1, "orders 1 to 6": 6}
# Paths of one repetition of the renderer, for about 1 % of error.
PATHS = 2**18
REFLECTANCE = {"ground": 0.4, "house": 0.8, "roof": 0.3, "wall": 0.8, "trunks": 0.5}
LIDAR = jl.Lidar(
    altitude=DISTANCE * np.cos(np.deg2rad(ZENITH)),
    zenith=ZENITH,
    azimuth=90.0,
    divergence=2e3 * RADIUS / DISTANCE,
    profile="top-hat",
    pulse=jl.GaussianPulse(PULSE),
)


def meshes():
    """Return the parts of the scene, coordinates in m."""
    far = 200.0
    ground = trimesh.Trimesh(
        [[-far, -far, 0], [far, -far, 0], [far, far, 0], [-far, far, 0]], [[0, 1, 2], [0, 2, 3]]
    )
    eaves = [[-3.8, -3.3, 2.6], [0.8, -3.3, 2.6], [0.8, 1.3, 2.6], [-3.8, 1.3, 2.6]]
    ridge = [[-3.8, -1.0, 4.2], [0.8, -1.0, 4.2]]
    roof = trimesh.Trimesh(eaves + ridge, [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [0, 4, 3], [1, 2, 5]])
    trunks = [
        trimesh.creation.cylinder(radius=0.3, segment=[[x, y, 0.0], [x, y, 5.0]], sections=32)
        for x, y in ((-2.0, 3.0), (0.5, 2.8), (3.5, 0.0))
    ]
    return {
        "ground": ground,
        "house": trimesh.creation.box(bounds=[[-3.5, -3, 0], [0.5, 1, 2.5]]),
        "roof": roof,
        "wall": trimesh.creation.box(bounds=[[2.0, -3, 0], [2.2, 2, 2.5]]),
        "trunks": trimesh.util.concatenate(trunks),
    }


def run_renderer(parts, repeats):
    """Return what the worker measures."""
    with tempfile.TemporaryDirectory() as folder:
        files = {name: str(Path(folder, f"{name}.ply")) for name in parts}
        for name, mesh in parts.items():
            mesh.export(files[name])
        task = {
            **{"meshes": list(files.values()), "reflectances": [REFLECTANCE[name] for name in files]},
            **{"cases": list(CASES), "orders": list(CASES.values()), "repeats": repeats},
            **{"altitude": float(LIDAR.altitude), "zenith": ZENITH, "radius": RADIUS, "fine": FINE},
            **{"start": WINDOW[0] - 0.5, "count": round(SAMPLES / FINE), "mitransient_samples": PATHS},
        }
        return run_peer("_peer_mitransient.py", task)


def draw(figure, parts, rows):
    """Draw the scene with the axis of the beam, and beside it the waveforms and their differences."""
    left, right = figure.subfigures(1, 2, width_ratios=(2, 5))
    ax = left.add_subplot(projection="3d", computed_zorder=False)
    # Drawn from far to near, as matplotlib does not hide one part behind another.
    for colour, name in zip(COLOURS, ("house", "roof", "wall", "trunks")):
        ax.plot_trisurf(*parts[name].vertices.T, triangles=parts[name].faces, color=colour, shade=True)
    turn = np.linspace(0.0, 2 * np.pi, 100)
    slant = np.deg2rad(ZENITH)
    ax.plot(RADIUS / np.cos(slant) * np.cos(turn), RADIUS * np.sin(turn), 0.0, color="0.5", zorder=-1)
    along = np.array([9.0, 6.5])
    x, z = -along * np.sin(slant), along * np.cos(slant)
    ax.quiver(x[0], 0, z[0], np.diff(x)[0], 0, np.diff(z)[0], color="black")
    ax.set(xlabel="east (m)", ylabel="north (m)", zlabel="height (m)", title="scene, lit area and beam")
    ax.set_aspect("equal")
    ax.set_box_aspect(None, zoom=0.85)
    ax.view_init(elev=28, azim=-65)
    draw_cases(right, rows, CODE, list(CASES))


def main(argv=None):
    arguments = options(__doc__, argv, repeats=32)
    parts = meshes()
    measurements = run_renderer(parts, arguments.repeats)
    if isinstance(measurements, str):
        raise SystemExit(f"{CODE} does not run here: {measurements}")
    scene = jl.Scene(meshes=tuple(jl.MeshSurface(mesh, REFLECTANCE[name]) for name, mesh in parts.items()))
    rows, costs = [], []
    for case, orders in with_progress(arguments, CASES.items()):
        ours = repeat_jaxlidar(LIDAR, scene, arguments.repeats, orders)
        theirs = {
            "waves": sampled(measurements[f"{case}_waves"], PULSE),
            "times": measurements[f"{case}_times"],
            "first": measurements[f"{case}_first"],
        }
        rows += rows_of(CODE, case, ours["waves"], theirs["waves"])
        costs += [{"case": case, "code": c, **cost_of(r)} for c, r in (("jaxlidar", ours), (CODE, theirs))]
    return finish(
        arguments,
        "mitransient_meshes",
        rows,
        draw=lambda figure: draw(figure, parts, rows),
        size=(14.0, 5.5),
        title="Triangles against mitransient",
        caption="""Left the scene; above the waveforms, below their relative differences with bars of two
        standard errors. With the first order alone and with all six, both codes return the same light at the
        same times.""",
        unchecked="""Lambertian opaque surfaces alone: the renderer has no diffuse transmission and does not
        tell the materials apart. One wavelength: jaxlidar's trace serves all of them, and gives derivatives,
        which is not in the times. Rays of the renderer meet triangles by Embree, machine code written for
        them, those of jaxlidar by a compiled array program. Steep sides move by the width of fine bins.""",
        code=str(measurements["version"]),
        repetitions=arguments.repeats,
        triangles=sum(len(mesh.faces) for mesh in parts.values()),
        costs=costs,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
