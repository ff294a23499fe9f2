"""Worker of `peers.py`: the same scene rendered by Mitsuba 3 with mitransient.

Laser and receiver stand at one point. Their roles are exchanged, which light paths allow: the sensor sends
its rays over the laser's disc, uniformly, and a point emitter stands for the receiver, which sees everything.
No ray is then wasted, and every scattering is connected with the receiver. `"camera"` is the set-up that
a user of a renderer would begin with: a spot and a camera that looks at the square of 10 m x 10 m.

`transient_prbvolpath` of mitransient 1.3.1 adds a flight to the length of a path only where it ends in a real
collision, not the stretches between null collisions. The line that adds is found and corrected here in
a temporary copy; where it is not found, the plug-in is used as it is and `corrected` is false.
"""

import importlib.util
import inspect
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PLUGIN, FIXED = "transient_prbvolpath", "transient_prbvolpath_all_stretches"
ADDED = "dr.select(act_medium_scatter, mei.t"
LIGHT = 0.299792458  # m/ns


def load():
    """Mitsuba with a variant for the CPU, and mitransient's plug-ins."""
    llvm = Path(sys.prefix, "lib", "libLLVM.so.19.1")
    if "DRJIT_LIBLLVM_PATH" not in os.environ and llvm.exists():
        os.environ["DRJIT_LIBLLVM_PATH"] = str(llvm)
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    import drjit as dr

    # Dr.Jit counts the thread that calls, but lets it wait: by default one core is idle.
    dr.set_thread_count((os.cpu_count() or 1) + 1)
    import mitransient

    return mi, mitransient


def correct() -> bool:
    """Register the plug-in under another name with the stretches between null collisions added up."""
    from mitransient.integrators import transient_prbvolpath as module

    source = inspect.getsource(module)
    if source.count(ADDED) != 1:
        return False
    source = source.replace(ADDED, "dr.select(act_medium_scatter | act_null_scatter, mei.t")
    source = source.replace(f"'{PLUGIN}'", f"'{FIXED}'").replace(f'"{PLUGIN}"', f'"{FIXED}"')
    path = Path(tempfile.mkdtemp(), "corrected.py")
    path.write_text(source)
    # Dr.Jit reads the source of what it compiles, so the copy must be a file; it imports its neighbours.
    spec = importlib.util.spec_from_file_location("mitransient.integrators.corrected", path)
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return True


def register_beam(mi, altitude: float, radius: float) -> None:
    """A sensor whose rays leave one point and are uniform over a disc on the reference plane."""
    import drjit as dr

    class Beam(mi.Sensor):
        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            across = radius * mi.warp.square_to_uniform_disk(sample2)
            down = dr.normalize(mi.Vector3f(across.x, across.y, -altitude))
            return mi.RayDifferential3f(mi.Point3f(0, 0, altitude), down, time, []), mi.Spectrum(1.0)

        def sample_ray_differential(self, *arguments, **named):
            return self.sample_ray(*arguments, **named)

        def to_string(self):
            return "Beam"

    mi.register_sensor("disc_beam", Beam)


def scene(mi, given, reflectance: float, camera: bool, plugin: str):
    """The scene; a Lambertian target of reflectance rho that fills the footprint gives the radiance rho."""
    move = mi.ScalarTransform4f
    altitude, radius, size = (float(given[n]) for n in ("altitude", "radius", "size"))
    start, width, count = (float(given[n]) for n in ("start", "fine", "count"))
    down = move().look_at(origin=[0, 0, altitude], target=[0, 0, 0], up=[0, 1, 0])
    half = float(np.degrees(np.arctan(radius / altitude)))
    film = {
        "type": "transient_hdr_film",
        "width": 1,
        "height": 1,
        "temporal_bins": int(count),
        "start_opl": 2 * altitude + start * LIGHT,
        "bin_width_opl": width * LIGHT,
        "rfilter": {"type": "box"},
    }
    sampler = {"type": "independent"}
    power = np.pi * altitude**2
    sensor = {"type": "disc_beam", "film": film, "sampler": sampler}
    light = {"type": "point", "position": [0, 0, altitude], "intensity": power}
    if camera:
        # The camera averages over its square, the footprint covers pi/4 of it.
        square = {"type": "perspective", "fov": 2 * half, "to_world": down, "film": film}
        sensor = {**square, "sampler": sampler}
        light = {"type": "spot", "to_world": down, "cutoff_angle": half, "beam_width": 0.9999 * half}
        light["intensity"] = power * 4 / np.pi
    # Axes of a grid are z, y, x.
    grid = np.ascontiguousarray(given["extinction"].transpose(2, 1, 0), dtype=np.float32)[..., None]
    box = move().translate([-size / 2, -size / 2, 0]).scale(size)
    extinction = {"type": "gridvolume", "grid": mi.VolumeGrid(grid), "to_world": box, "raw": True}
    medium = {"type": "heterogeneous", "albedo": float(given["albedo"]), "phase": {"type": "isotropic"}}
    # The box ends a little above the ground: two coincident surfaces are hit in any order.
    gap = 1e-3 * size
    hull = move().translate([0, 0, (size + gap) / 2]).scale([size / 2, size / 2, (size - gap) / 2])
    parts = {
        "type": "scene",
        # Depth n leaves n - 1 scatterings. Paths are not thinned out at random: it gains nothing here.
        "integrator": {"type": plugin, "max_depth": int(given["orders"]) + 1, "rr_depth": 1000},
        "sensor": sensor,
        "light": light,
        "box": {
            "type": "cube",
            "to_world": hull,
            "bsdf": {"type": "null"},
            "interior": {**medium, "sigma_t": {**extinction, "filter_type": "nearest"}},
        },
    }
    if reflectance > 0:
        soil = {"type": "diffuse", "reflectance": reflectance}
        parts["ground"] = {"type": "rectangle", "to_world": move().scale(1000), "bsdf": soil}
    return mi.load_dict(parts)


def main() -> None:
    """Render every case `repeats` times; a call's arguments and results are files of arrays."""
    given = dict(np.load(sys.argv[1]))
    mi, mitransient = load()
    corrected = correct()
    register_beam(mi, float(given["altitude"]), float(given["radius"]))
    version = f"mitransient {mitransient.__version__}, Mitsuba {mi.__version__}"
    out: dict[str, object] = {"version": version, "corrected": corrected}
    # The apparent reflectance refers to the range that the time of arrival stands for.
    time_of = given["start"] + given["fine"] * (np.arange(int(given["count"])) + 0.5)
    range_of = (1 + 0.5 * LIGHT * time_of / given["altitude"]) ** 2
    samples = int(given["mitransient_samples"])
    for case, reflectance, camera in (
        ("ground", float(given["reflectance"]), False),
        ("alone", 0.0, False),
        ("camera", float(given["reflectance"]), True),
    ):
        if case not in given.get("cases", (case,)):
            continue
        target = scene(mi, given, reflectance, camera, FIXED if corrected else PLUGIN)
        integrator = target.integrator()
        waves, times = [], []
        for seed in range(int(given["repeats"]) + 1):
            start, work = time.perf_counter(), time.process_time()
            _, image = integrator.render(target, seed=seed, spp=samples)
            waves.append(np.array(image).ravel() * range_of)
            times.append((time.perf_counter() - start, time.process_time() - work))
        out[f"{case}_waves"], out[f"{case}_times"] = np.array(waves[1:]), np.array(times[1:])
        out[f"{case}_first"] = times[0][0]
    np.savez(sys.argv[2], **out)


if __name__ == "__main__":
    main()
