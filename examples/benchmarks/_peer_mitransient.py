"""Worker of `peers.py`: the same scene rendered by Mitsuba 3 with mitransient.

A task is the crown of `peers.py`, or some meshes ("meshes": paths of files), with a beam at a zenith angle.

Laser and receiver are at one point. Their roles are exchanged, by reciprocity: the sensor sends its rays
uniformly over the disc of the laser, and a point emitter stands for the receiver, which sees everything. No
ray is then wasted, and every scattering is connected with the receiver. `"camera"` is the set-up that a user
of a renderer would begin with: a spot and a camera that looks at the square of 10 m x 10 m.

`transient_prbvolpath` of mitransient 1.3.1 adds a flight to the length of a path only where it ends in a real
collision, not the segments between null collisions. The line that adds them is corrected here in a temporary
copy; if the line does not exist, the plug-in is used as it is and `corrected` is false.
"""

import importlib.util
import inspect
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from _peer import read_task, repeated, write_result

PLUGIN, CORRECTED_PLUGIN = "transient_prbvolpath", "transient_prbvolpath_all_stretches"
LENGTH_LINE = "dr.select(act_medium_scatter, mei.t"
SPEED_OF_LIGHT = 0.299792458  # m/ns


def load():
    """Import Mitsuba with a variant for the CPU, and the plug-ins of mitransient."""
    llvm = Path(sys.prefix, "lib", "libLLVM.so.19.1")
    if "DRJIT_LIBLLVM_PATH" not in os.environ and llvm.exists():
        os.environ["DRJIT_LIBLLVM_PATH"] = str(llvm)
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    import drjit as dr

    # Dr.Jit counts the calling thread, which only waits: by default one core is idle.
    dr.set_thread_count((os.cpu_count() or 1) + 1)
    import mitransient

    return mi, mitransient


def register_corrected_plugin() -> bool:
    """Register a plug-in that counts segments between null collisions; return False if that fails."""
    from mitransient.integrators import transient_prbvolpath as module

    source = inspect.getsource(module)
    if source.count(LENGTH_LINE) != 1:
        return False
    source = source.replace(LENGTH_LINE, "dr.select(act_medium_scatter | act_null_scatter, mei.t")
    source = source.replace(f"'{PLUGIN}'", f"'{CORRECTED_PLUGIN}'").replace(
        f'"{PLUGIN}"', f'"{CORRECTED_PLUGIN}"'
    )
    path = Path(tempfile.mkdtemp(), "corrected.py")
    path.write_text(source)
    # Dr.Jit reads the source of what it compiles, so the copy must be a file; it imports its neighbours.
    spec = importlib.util.spec_from_file_location("mitransient.integrators.corrected", path)
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return True


def axes_of_beam(task) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of the sensor, m, and unit vectors in rows: two across the beam, and its direction.

    The beam is aimed at the origin, and travels to the east where it is not vertical.
    """
    zenith = np.deg2rad(float(task.get("zenith", 0.0)))
    sine, cosine = np.sin(zenith), np.cos(zenith)
    axes = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [sine, 0.0, -cosine]])
    return -float(task["altitude"]) / cosine * axes[2], axes


def register_beam(mi, task) -> None:
    """Register a sensor whose rays leave one point and are uniform over a disc across the beam's axis."""
    import drjit as dr

    radius, (position, axes) = float(task["radius"]), axes_of_beam(task)
    distance = float(np.linalg.norm(position))
    first, second, axis = (mi.Vector3f(*a) for a in axes.tolist())

    class DiscBeam(mi.Sensor):
        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            across = radius * mi.warp.square_to_uniform_disk(sample2)
            direction = dr.normalize(across.x * first + across.y * second + distance * axis)
            return mi.RayDifferential3f(mi.Point3f(*position.tolist()), direction, time, []), mi.Spectrum(1.0)

        def sample_ray_differential(self, *arguments, **named):
            return self.sample_ray(*arguments, **named)

        def to_string(self):
            return "DiscBeam"

    mi.register_sensor("disc_beam", DiscBeam)


def instrument(mi, task, camera: bool = False) -> dict:
    """Return sensor and light. A task without a count of bins of time has a film without.

    A Lambertian target of reflectance rho that fills the footprint has the radiance rho.
    """
    position, _ = axes_of_beam(task)
    distance, radius = float(np.linalg.norm(position)), float(task["radius"])
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    if "count" in task:
        start, width, count = (float(task[n]) for n in ("start", "fine", "count"))
        film |= {
            "type": "transient_hdr_film",
            "temporal_bins": int(count),
            "start_opl": 2 * distance + start * SPEED_OF_LIGHT,
            "bin_width_opl": width * SPEED_OF_LIGHT,
        }
    sampler = {"type": "independent"}
    power = np.pi * distance**2
    if not camera:
        light = {"type": "point", "position": position.tolist(), "intensity": power}
        return {"sensor": {"type": "disc_beam", "film": film, "sampler": sampler}, "light": light}
    # The camera averages over its square, of which the footprint covers pi / 4.
    half = float(np.degrees(np.arctan(radius / distance)))
    down = mi.ScalarTransform4f().look_at(origin=position.tolist(), target=[0, 0, 0], up=[0, 1, 0])
    square = {"type": "perspective", "fov": 2 * half, "to_world": down, "film": film}
    light = {"type": "spot", "to_world": down, "cutoff_angle": half, "beam_width": 0.9999 * half}
    return {"sensor": {**square, "sampler": sampler}, "light": {**light, "intensity": power * 4 / np.pi}}


def integrator(plugin: str, orders: int) -> dict:
    """Return the integrator: depth n means n - 1 scatterings. Russian roulette does not pay here."""
    return {"type": plugin, "max_depth": int(orders) + 1, "rr_depth": 1000}


def crown(mi, task, reflectance: float, camera: bool, plugin: str):
    """Return the scene of a crown."""
    move, size = mi.ScalarTransform4f, float(task["size"])
    # Axes of a grid are z, y, x.
    grid = np.ascontiguousarray(task["extinction"].transpose(2, 1, 0), dtype=np.float32)[..., None]
    box = move().translate([-size / 2, -size / 2, 0]).scale(size)
    extinction = {"type": "gridvolume", "grid": mi.VolumeGrid(grid), "to_world": box, "raw": True}
    medium = {"type": "heterogeneous", "albedo": float(task["albedo"]), "phase": {"type": "isotropic"}}
    # The box ends a little above the ground: coincident surfaces would be hit in arbitrary order.
    gap = 1e-3 * size
    hull = move().translate([0, 0, (size + gap) / 2]).scale([size / 2, size / 2, (size - gap) / 2])
    scene_dict = {
        "type": "scene",
        "integrator": integrator(plugin, task["orders"]),
        **instrument(mi, task, camera),
        "box": {
            "type": "cube",
            "to_world": hull,
            "bsdf": {"type": "null"},
            "interior": {**medium, "sigma_t": {**extinction, "filter_type": "nearest"}},
        },
    }
    if reflectance > 0:
        soil = {"type": "diffuse", "reflectance": reflectance}
        scene_dict["ground"] = {"type": "rectangle", "to_world": move().scale(1000), "bsdf": soil}
    return mi.load_dict(scene_dict)


def meshes(mi, task, orders: int):
    """Return the scene of meshes, whose both sides are Lambertian."""
    surfaces = {
        f"mesh {n}": {
            "type": "ply",
            "filename": str(path),
            "face_normals": True,
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": float(reflectance)}},
        }
        for n, (path, reflectance) in enumerate(zip(task["meshes"], task["reflectances"]))
    }
    path_tracer = integrator("transient_path", orders)
    return mi.load_dict({"type": "scene", "integrator": path_tracer, **instrument(mi, task), **surfaces})


def scenes(mi, task, plugin: str):
    """Yield the name and the scene of each case of a task."""
    if "meshes" in task:
        for case, orders in zip(task["cases"], task["orders"]):
            yield str(case), meshes(mi, task, orders)
        return
    for case, reflectance, camera in (
        ("ground", float(task["reflectance"]), False),
        ("alone", 0.0, False),
        ("camera", float(task["reflectance"]), True),
    ):
        if case in task.get("cases", (case,)):
            yield case, crown(mi, task, reflectance, camera, plugin)


def main() -> None:
    """Render every case `repeats` times."""
    task = read_task()
    mi, mitransient = load()
    corrected = register_corrected_plugin()
    register_beam(mi, task)
    version = f"mitransient {mitransient.__version__}, Mitsuba {mi.__version__}"
    out: dict[str, object] = {"version": version, "corrected": corrected}
    # The apparent reflectance refers to the range that the time of arrival stands for.
    bin_time = task["start"] + task["fine"] * (np.arange(int(task["count"])) + 0.5)
    distance = np.linalg.norm(axes_of_beam(task)[0])
    range_correction = (1 + 0.5 * SPEED_OF_LIGHT * bin_time / distance) ** 2
    samples = int(task["mitransient_samples"])
    for case, target in scenes(mi, task, CORRECTED_PLUGIN if corrected else PLUGIN):

        def render(seed: int, target=target) -> np.ndarray:
            _, image = target.integrator().render(target, seed=seed, spp=samples)
            return np.array(image).ravel() * range_correction

        names = (f"{case}_waves", f"{case}_times", f"{case}_first")
        out |= dict(zip(names, repeated(render, int(task["repeats"]))))
    write_result(**out)


if __name__ == "__main__":
    main()
