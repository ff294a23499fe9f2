"""Worker of `peers_gradient.py`: the gradient in every voxel by Mitsuba's `prbvolpath`, without time.

Sensor, light and crown are those of `_peer_mitransient.py`, with a film that has no bins of time.
"""

import numpy as np
from _peer import read_task, repeated_gradient, write_result
from _peer_mitransient import crown, load, register_beam

EXTINCTION = "box.interior_medium.sigma_t.data"


def main() -> None:
    """Render and differentiate `repeats` times."""
    task = read_task()
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

    repeats = int(task["repeats"])
    write_result(version=f"Mitsuba {mi.__version__}", **repeated_gradient(render, gradient, repeats))


if __name__ == "__main__":
    main()
