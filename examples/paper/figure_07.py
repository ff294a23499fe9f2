"""Figure 7: the paths of the first pulse's photons through a tree with leaves, beside the waveform.

python examples/paper/figure_07.py [--out figures] [--small]
"""

import jax
import numpy as np
from _analog import photon_paths
from _common import COLOURS, new_figure, options, save, tree_scene

import jaxlidar as jl
import jaxlidar.plot


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    lidar = jl.Lidar(position=(1.0, 0.5))
    scene = tree_scene(1.0 if arguments.small else 0.25)
    plan = jl.plan(lidar, scene, max_orders=2 if arguments.small else 8)
    wave = jl.simulate(lidar, scene, key=jax.random.key(0), plan=plan, n_photons=8 * 1024)
    points = photon_paths(lidar, scene, plan, key=jax.random.key(3), n_photons=60, leaving=3.0)
    points = np.asarray(points, float)
    has_moved = np.any(np.diff(points, axis=1) != 0, axis=2)
    collisions = has_moved.sum(axis=1) - 1
    reached = np.any(np.abs(points[:, 1:, 2]) < 1e-3, axis=1)
    results = {
        "photons": len(points),
        "collisions in the mean": float(collisions.mean()),
        "share that reached the ground": float(reached.mean()),
        "apparent reflectance": float(np.sum(wave.reflectance)),
    }
    print(results)
    assert np.all(points[..., 2] > -1e-3)
    assert 0.5 < results["collisions in the mean"] < 9
    crown = np.asarray(wave.components["leaf"][0]).sum() + np.asarray(wave.components["bark"][0]).sum()
    assert crown > 0.01

    figure, (scene_axes, wave_axes) = new_figure(2, height=3.2, sharey=True, width_ratios=(1.5, 1))
    jaxlidar.plot.scene(scene, None, scene_axes, legend=False)
    for path in points:
        scene_axes.plot(path[:, 0], path[:, 2], color=COLOURS[1], linewidth=0.4, alpha=0.7)
    for path, n in zip(points, collisions):
        scene_axes.plot(path[1 : n + 1, 0], path[1 : n + 1, 2], ".", color=COLOURS[6], markersize=1.5)
    jaxlidar.plot.waveform(wave, wave_axes)
    wave_axes.set(ylabel="", xlabel="", title="")
    # Leave room for the power of ten of the axis.
    wave_axes.set_xlabel("apparent reflectance\nper ns", labelpad=10)
    wave_axes.legend(loc="center right", fontsize=6, bbox_to_anchor=(1.0, 0.3), handlelength=1.2)
    scene_axes.set(ylim=(-1.5, 16.5), aspect="auto")
    save(figure, arguments.out / "paper_figure_07.png")
    return results


if __name__ == "__main__":
    main()
