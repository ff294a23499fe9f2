"""Worker of `peers_gradient.py`: the gradient in every voxel by Mitsuba's `prbvolpath`, without time.

Sensor, light and crown are those of `_peer_mitransient.py`, with a film that has no bins of time.
"""

import sys
import time

import numpy as np
from _peer_mitransient import crown, load, register_beam

EXTINCTION = "box.interior_medium.sigma_t.data"


def main() -> None:
    """Render and differentiate `repeats` times; the command line names files for the task and the results."""
    task = dict(np.load(sys.argv[1]))
    mi, _ = load()
    import drjit as dr

    register_beam(mi, task)
    scene = crown(mi, task, 0.0, False, "prbvolpath")
    parameters, samples = mi.traverse(scene), int(task["samples"])

    def render(seed: int) -> float:
        image = mi.render(scene, parameters, seed=seed, spp=samples)
        return float(np.mean(np.array(image)))

    def gradient(seed: int) -> tuple[float, np.ndarray]:
        extinction = parameters[EXTINCTION]
        dr.enable_grad(extinction)
        dr.set_grad(extinction, 0.0)
        parameters.update()
        loss = dr.mean(mi.render(scene, parameters, seed=seed, spp=samples), axis=None)
        dr.backward(loss)
        # Axes of a grid are z, y, x.
        slopes = np.array(dr.grad(extinction)).reshape(task["extinction"].shape[::-1]).transpose(2, 1, 0)
        dr.disable_grad(extinction)
        return float(np.array(loss).ravel()[0]), slopes

    out: dict[str, object] = {"version": f"Mitsuba {mi.__version__}"}
    for name, function in (("simulation", render), ("gradient", gradient)):
        results, times = [], []
        for seed in range(int(task["repeats"]) + 1):
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            results.append(function(seed))
            times.append((time.perf_counter() - wall_start, time.process_time() - cpu_start))
        out[f"{name}_times"], out[f"{name}_first"] = np.array(times[1:]), times[0][0]
        if name == "gradient":
            out["totals"] = np.array([total for total, _ in results[1:]])
            out["gradients"] = np.array([slopes for _, slopes in results[1:]], np.float32)
    np.savez(sys.argv[2], **out)


if __name__ == "__main__":
    main()
