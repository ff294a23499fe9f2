"""Worker of `peers.py`: the same crown, without ground, by MCX-CL on an OpenCL runtime for the CPU.

MCX has no Lambertian ground, and its detectors collect over all directions. So it computes what it is made
for, the fluence in every voxel and gate, and the light that voxels scatter towards the receiver is carried
there afterwards. This converges far faster than counting the photons that leave within a cone about the
vertical. Gates (of 1 ns, where `mcx_gate` says nothing else) are taken as evenly filled. What a photon leaves
in a voxel is booked when it leaves the voxel, half a crossing late on average, which is taken off. There is
no limit of orders.

OpenCL runtimes are found through `OCL_ICD_VENDORS`, or in the system; else PoCL from its wheel is taken,
whose compiler (LLVM 14) does not know the newest processors.
"""

import ctypes
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

LIGHT = 0.299792458  # m/ns
END = 120  # ns; nothing comes later


def load():
    """pmcxcl, with an OpenCL runtime to be found."""
    system = Path("/etc/OpenCL/vendors")
    if "OCL_ICD_VENDORS" not in os.environ and not (system.exists() and list(system.glob("*.icd"))):
        for folder in map(Path, sys.path):
            for library in folder.glob("pyopencl/.libs/libpocl*.so"):
                vendors = Path(tempfile.mkdtemp())
                (vendors / "pocl.icd").write_text(f"{library}\n")
                os.environ["OCL_ICD_VENDORS"] = str(vendors)
    # Kernels compiled before would hide the time of compilation.
    os.environ["POCL_CACHE_DIR"] = tempfile.mkdtemp()
    # The wheel's runtime needs its symbols, which Python does not share by itself.
    ctypes.CDLL("libstdc++.so.6", mode=ctypes.RTLD_GLOBAL)
    import pmcxcl

    return pmcxcl


def main() -> None:
    """Run `repeats` times; a call's arguments and results are files of arrays."""
    given = dict(np.load(sys.argv[1]))
    pmcxcl = load()
    size, albedo, altitude = (float(given[n]) for n in ("size", "albedo", "altitude"))
    # Depth counts from the top. Media are numbered: one for each of the levels of extinction, after vacuum.
    extinction = given["extinction"][:, :, ::-1]
    levels, label = np.unique(extinction, return_inverse=True)
    if levels.size > 254:
        raise RuntimeError(f"{levels.size} levels of extinction; MCX takes 254 in volumes of bytes")
    number = extinction.shape[2]
    edge = size / number
    width = float(given.get("mcx_gate", 1.0))
    gates = round(END / width)
    slope = float(given["radius"]) / altitude
    settings = {
        "vol": np.asfortranarray(1 + label.reshape(extinction.shape), dtype=np.uint8),
        "prop": [[0, 0, 1, 1], *([1e-3 * (1 - albedo) * k, 1e-3 * albedo * k, 0, 1] for k in levels)],
        "unitinmm": 1e3 * edge,
        "tstart": 0.0,
        # A little less: rounding must not open a second window of gates.
        "tend": (gates - 0.01) * width * 1e-9,
        "tstep": width * 1e-9,
        "srctype": "disk",
        "srcpos": [extinction.shape[0] / 2, extinction.shape[1] / 2, 0.0],
        # The fourth number is the focal length; where it is negative, rays diverge.
        "srcdir": [0, 0, 1, -(altitude - size) / edge],
        "srcparam1": [slope * (altitude - size) / edge, 0, 0, 0],
        "nphoton": int(given["mcx_photons"]),
        "outputtype": "flux",
        "isreflect": 0,
        "issrcfrom0": 1,
        "issavedet": 0,
        "autopilot": 1,
        "gpuid": 1,
    }

    # Apparent reflectance per unit of fluence: pi, times the density of scattering per angle, times the way
    # out, with the mean over the voxel of its own transmittance.
    depth = extinction * edge
    above = np.cumsum(depth, axis=2) - depth
    own = np.where(depth > 0, -np.expm1(-depth) / np.where(depth > 0, depth, 1), 1)
    weight = 0.25 * albedo * extinction * np.exp(-above) * own * edge**3
    out_of = edge * (np.arange(number) + 0.5)
    # The apparent reflectance refers to the range that the time of arrival stands for.
    gate = width * (np.arange(gates) + 0.5)
    half_way = altitude - size + 0.5 * (LIGHT * gate[None, :] + out_of[:, None])
    range_of = (half_way / (altitude - size + out_of[:, None])) ** 2
    edges = given["start"] + given["fine"] * np.arange(int(given["count"]) + 1)

    def wave(flux: np.ndarray) -> np.ndarray:
        # Per mm2 and s to per m2 and gate.
        by_depth = np.einsum("xyz,xyzt->zt", weight, flux) * 1e6 * 1e-9 * width * range_of
        total = np.zeros(edges.size - 1)
        for row, back in zip(by_depth, out_of):
            opened = width * np.arange(gates + 1) + (back - 0.5 * edge - 2 * size) / LIGHT
            total += np.diff(np.interp(edges, opened, np.concatenate([[0.0], np.cumsum(row)])))
        return total

    waves, times = [], []
    for seed in range(int(given["repeats"]) + 1):
        start, work = time.perf_counter(), time.process_time()
        result = pmcxcl.run({**settings, "seed": 1 + seed})
        waves.append(wave(np.asarray(result["flux"])))
        times.append((time.perf_counter() - start, time.process_time() - work))
    np.savez(
        sys.argv[2],
        version=f"pmcxcl {pmcxcl.__version__} on {pmcxcl.gpuinfo()[0]['name']}",
        alone_waves=np.array(waves[1:]),
        alone_times=np.array(times[1:]),
        alone_first=times[0][0],
    )


if __name__ == "__main__":
    main()
