"""Worker of `peers.py`: the same crown, without ground, by MCX-CL on an OpenCL runtime for the CPU.

MCX has no Lambertian ground, and its detectors collect over all directions. It computes the fluence in every
voxel and time gate; the light that voxels scatter towards the receiver is calculated from it afterwards. This
converges far faster than counting the photons that leave within a cone about the vertical. Gates (of 1 ns, or
of `mcx_gate`) are assumed to be filled evenly. MCX deposits the weight of a photon when it leaves a voxel,
half a crossing late on average, which is subtracted. There is no limit of orders.

The OpenCL runtime is that of `OCL_ICD_VENDORS`, or of the system; else PoCL from its wheel, whose compiler
(LLVM 14) does not know the newest processors.
"""

import ctypes
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from _peer import read_task, repeated, write_result

SPEED_OF_LIGHT = 0.299792458  # m/ns
END_TIME = 120  # ns; no light returns later


def load():
    """Import pmcxcl, after making an OpenCL runtime available."""
    system = Path("/etc/OpenCL/vendors")
    if "OCL_ICD_VENDORS" not in os.environ and not (system.exists() and list(system.glob("*.icd"))):
        for folder in map(Path, sys.path):
            for library in folder.glob("pyopencl/.libs/libpocl*.so"):
                vendors = Path(tempfile.mkdtemp())
                (vendors / "pocl.icd").write_text(f"{library}\n")
                os.environ["OCL_ICD_VENDORS"] = str(vendors)
    # A cache of compiled kernels would hide the time of compilation.
    os.environ["POCL_CACHE_DIR"] = tempfile.mkdtemp()
    # The runtime of the wheel needs symbols of libstdc++, which Python does not load globally.
    ctypes.CDLL("libstdc++.so.6", mode=ctypes.RTLD_GLOBAL)
    import pmcxcl

    return pmcxcl


def main() -> None:
    """Run `repeats` times."""
    task = read_task()
    pmcxcl = load()
    size, albedo, altitude = (float(task[n]) for n in ("size", "albedo", "altitude"))
    # Layers count from the top. Medium 0 is vacuum; each level of extinction is one further medium.
    extinction = task["extinction"][:, :, ::-1]
    levels, label = np.unique(extinction, return_inverse=True)
    if levels.size > 254:
        raise RuntimeError(f"{levels.size} levels of extinction; MCX takes 254 in volumes of bytes")
    n_layers = extinction.shape[2]
    edge = size / n_layers
    width = float(task.get("mcx_gate", 1.0))
    gates = round(END_TIME / width)
    slope = float(task["radius"]) / altitude
    settings = {
        "vol": np.asfortranarray(1 + label.reshape(extinction.shape), dtype=np.uint8),
        "prop": [[0, 0, 1, 1], *([1e-3 * (1 - albedo) * k, 1e-3 * albedo * k, 0, 1] for k in levels)],
        "unitinmm": 1e3 * edge,
        "tstart": 0.0,
        # A little less than all gates: rounding must not open a second window.
        "tend": (gates - 0.01) * width * 1e-9,
        "tstep": width * 1e-9,
        "srctype": "disk",
        "srcpos": [extinction.shape[0] / 2, extinction.shape[1] / 2, 0.0],
        # The fourth number is the focal length; where it is negative, rays diverge.
        "srcdir": [0, 0, 1, -(altitude - size) / edge],
        "srcparam1": [slope * (altitude - size) / edge, 0, 0, 0],
        "nphoton": int(task["mcx_photons"]),
        "outputtype": "flux",
        "isreflect": 0,
        "issrcfrom0": 1,
        "issavedet": 0,
        "autopilot": 1,
        "gpuid": 1,
    }

    # Apparent reflectance per fluence: pi times the scattering coefficient per solid angle, albedo k / (4
    # pi), times the transmittance out: exp(-depth above) times the mean transmittance within the voxel.
    depth = extinction * edge
    depth_above = np.cumsum(depth, axis=2) - depth
    mean_transmittance = np.where(depth > 0, -np.expm1(-depth) / np.where(depth > 0, depth, 1), 1)
    weight = 0.25 * albedo * extinction * np.exp(-depth_above) * mean_transmittance * edge**3
    layer_depth = edge * (np.arange(n_layers) + 0.5)
    # The apparent reflectance refers to the range that the time of arrival stands for.
    gate = width * (np.arange(gates) + 0.5)
    half_way = altitude - size + 0.5 * (SPEED_OF_LIGHT * gate[None, :] + layer_depth[:, None])
    range_correction = (half_way / (altitude - size + layer_depth[:, None])) ** 2
    edges = task["start"] + task["fine"] * np.arange(int(task["count"]) + 1)

    def wave(seed: int) -> np.ndarray:
        flux = np.asarray(pmcxcl.run({**settings, "seed": 1 + seed})["flux"])
        # Per mm2 and s to per m2 and gate.
        by_depth = np.einsum("xyz,xyzt->zt", weight, flux) * 1e6 * 1e-9 * width * range_correction
        total = np.zeros(edges.size - 1)
        for row, back in zip(by_depth, layer_depth):
            opened = width * np.arange(gates + 1) + (back - 0.5 * edge - 2 * size) / SPEED_OF_LIGHT
            total += np.diff(np.interp(edges, opened, np.concatenate([[0.0], np.cumsum(row)])))
        return total

    waves, times, first = repeated(wave, int(task["repeats"]))
    version = f"pmcxcl {pmcxcl.__version__} on {pmcxcl.gpuinfo()[0]['name']}"
    write_result(version=version, alone_waves=waves, alone_times=times, alone_first=first)


if __name__ == "__main__":
    main()
