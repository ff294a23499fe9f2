"""Cloud-like slabs in three fields of view, all orders, against multiscatter (Hogan and Battaglia 2008).

    python examples/validation/multiscatter_slabs.py PATH [--out figures] [--photons 524288]

PATH is the program `multiscatter` 1.2.10 (LGPL 2.1), which `make` builds from its source in C. It solves
two-stream equations in time and assumes that scattered light spreads as a Gaussian. Where light has
diffused, 20 % are expected of it. Its answer is the attenuated backscatter beta (1/m/sr). In single
scattering, with the extinction k, the depth z and the phase function p (per steradian) towards the sensor,

    beta = p k exp(-2 k z),    apparent reflectance per metre of range = pi p k exp(-2 k z),

so that a sample of the length L holds pi beta L. Both refer late light to the range of its time of arrival.

A lidar 400 km above slabs of 300 m, albedo 1, sees discs of three radii. The late tail comes from ranges
beyond the slab's base. A third estimate decides where the two differ: photons in NumPy, with lateral
displacements, and the probability of return to the sensor summed over collisions within each disc.
"""

import subprocess
import sys
import tempfile

import jax
import numpy as np
from _validation import COLOURS, comparison, finish, options, with_progress

import jaxlidar as jl

# Name: optical depth, mean cosine of scattering (Henyey and Greenstein), algorithms of multiscatter: for
# small and wide angles. With "lidar" it takes half of the extinction as a forward lobe.
SLABS = {
    "isotropic, optical depth 12": (12.0, 0.0, ("single", "radar")),
    "forward, optical depth 80": (80.0, 0.85, ("fast", "lidar")),
    "forward, optical depth 20": (20.0, 0.85, ("fast", "lidar")),
}
# Depth of slabs, altitude, length of samples and of the record, m; radii of the disc that is seen, m.
DEPTH, ALTITUDE, SAMPLE, RECORD = 300.0, 4e5, 75.0, 900.0
RADII = (50.0, 150.0, 450.0)
EDGES = np.arange(0.0, RECORD + 1.0, SAMPLE)
IS_TAIL = EDGES[:-1] >= DEPTH
# Gates of multiscatter, m: with gates of 2.5 m the tail differs by 0.6 %. Radius of its droplets, m: with
# 3e-6 the tail differs by 0.1 %.
GATE, DROPLET = 1.25, 1e-5
# Accuracy that is expected of multiscatter.
ACCURACY = 0.2
# Metres per ns; bins of the tracer per sample.
LIGHT_SPEED, BINS = 0.299792458, 16
# Batches of photons in NumPy.
BATCHES = 32


def run_multiscatter(program, tau, g, algorithms):
    """Return attenuated backscatter in samples; (fields of view, samples)."""
    # Extinction over backscatter, sr.
    ratio = 4 * np.pi * (1 + g) ** 2 / (1 - g)
    gates = np.arange(0.5 * GATE, DEPTH, GATE)
    # Wavelength, altitude (the range increases), divergence, half-angles of view.
    head = [len(gates), 5.32e-7, -ALTITUDE, 1e-9, *(radius / ALTITUDE for radius in RADII)]
    lines = [head, *([r, tau / DEPTH, DROPLET, ratio, 0, 1, g, 1] for r in gates)]
    samples = round(RECORD / GATE)
    # This version of the program leaves a file in its folder.
    with tempfile.TemporaryDirectory() as folder:
        answer = subprocess.run(
            [program.resolve(), "-quiet", "-algorithms", *algorithms, "-num-samples", str(samples)],
            input="\n".join(" ".join(map(str, line)) for line in lines) + "\n",
            capture_output=True,
            text=True,
            check=True,
            cwd=folder,
        )
    backscatter = np.array([line.split()[4:] for line in answer.stdout.splitlines()], float)
    return backscatter.T.reshape(len(RADII), len(EDGES) - 1, -1).mean(-1)


def follow_photons(rng, tau, g, count):
    """Return attenuated backscatter in samples, by photons in NumPy; (fields of view, samples)."""
    k, total = tau / DEPTH, np.zeros((len(RADII), len(EDGES) - 1))
    x, y, z, path = np.zeros((4, count))
    u, v, w = np.zeros(count), np.zeros(count), np.ones(count)
    while x.size:
        flight = rng.exponential(1 / k, x.size)
        x, y, z, path = x + flight * u, y + flight * v, z + flight * w, path + flight
        # The range that the time of arrival stands for. z points down.
        reach = 0.5 * (path + z)
        stays = (z > 0) & (z < DEPTH) & (reach < RECORD)
        x, y, z, path, u, v, w, reach = (a[stays] for a in (x, y, z, path, u, v, w, reach))
        returned = (1 - g * g) / (4 * np.pi * (1 + g * g + 2 * g * w) ** 1.5) * np.exp(-k * z)
        sample = (reach / SAMPLE).astype(int)
        for seen, radius in zip(total, RADII):
            seen += np.bincount(sample, returned * (x * x + y * y < radius**2), len(seen))
        s, turn = 2 * rng.random(x.size) - 1, 2 * np.pi * rng.random(x.size)
        cosine = s if g == 0 else (1 + g * g - ((1 - g * g) / (1 + g * s)) ** 2) / (2 * g)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0))
        a, b = sine * np.cos(turn), sine * np.sin(turn)
        # Two axes across the direction of flight (Duff et al. 2017).
        sign = np.where(w >= 0, 1.0, -1.0)
        c = -1 / (sign + w)
        u, v, w = (
            a * (1 + sign * u * u * c) + b * u * v * c + cosine * u,
            a * sign * u * v * c + b * (sign + v * v * c) + cosine * v,
            -a * sign * u - b * v + cosine * w,
        )
        norm = np.sqrt(u * u + v * v + w * w)
        u, v, w = u / norm, v / norm, w / norm
    return total / (count * SAMPLE)


def simulate_slab(tau, g, radius, photons, key):
    """Return attenuated backscatter in samples and its standard error, by jaxlidar."""
    # Voxels of leaf have half their area as extinction.
    voxels = jl.VoxelMap.from_lad(np.full((2, 2, 12), 2 * tau / DEPTH), voxel_size=(50.0, 50.0, DEPTH / 12))
    leaf = jl.HenyeyGreenstein(albedo=1.0, g=g)
    canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic", hotspot=False)
    interval = 2 * SAMPLE / LIGHT_SPEED
    start = 0.5 * interval - 2 * DEPTH / LIGHT_SPEED
    # Of the Poisson distribution of collisions along the longest path, six standard deviations are left out.
    collisions = 2 * RECORD * tau / DEPTH
    wave = jl.simulate(
        jl.Lidar(
            wavelength=532.0,
            altitude=ALTITUDE,
            divergence=1e-3,
            pulse=jl.GaussianPulse(fwhm=0.0),
            sampling_interval=interval,
            field_of_view=2e3 * radius / ALTITUDE,
        ),
        jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.0)),
        key=key,
        n_photons=photons,
        max_orders=int(collisions + 6 * np.sqrt(collisions)),
        n_rays=64,
        window=(start, start + (len(EDGES) - 2) * interval),
        bin_width=interval / BINS,
    )
    values, errors = (np.asarray(a, float)[0] for a in (wave.reflectance, wave.stderr))
    return values / (np.pi * SAMPLE), errors / (np.pi * SAMPLE)


def main(argv=None):
    arguments = options(__doc__, argv, "program", photons=524_288)
    rows, lines, curves = [], [], {}
    rng = np.random.default_rng(0)
    for case, (tau, g, algorithms) in with_progress(arguments, list(SLABS.items())):
        theirs = run_multiscatter(arguments.program, tau, g, algorithms)
        count = arguments.photons // BATCHES
        batches = np.array([follow_photons(rng, tau, g, count) for _ in range(BATCHES)])
        third, third_error = batches.mean(0), batches.std(0, ddof=1) / np.sqrt(BATCHES)
        for i, radius in enumerate(RADII):
            values, errors = simulate_slab(tau, g, radius, arguments.photons, jax.random.key(i))
            curves[case, radius] = values, theirs[i], third[i]
            here, there, decides = (a[IS_TAIL].mean() for a in (values, theirs[i], third[i]))
            name = f"radius {radius:.0f} m"
            bound = ACCURACY * there
            rows.append(
                comparison(
                    f"late tail: {case}", "multiscatter", name, here, there, bound=bound, unit="per m sr"
                )
            )
            for j in np.flatnonzero(IS_TAIL):
                rows.append(
                    comparison(
                        f"samples of the tail: {case}",
                        "photons in NumPy",
                        f"{name}, {EDGES[j]:.0f} m",
                        values[j],
                        third[i, j],
                        stderr=float(np.hypot(errors[j], third_error[i, j])),
                        unit="per m sr",
                    )
                )
            ratios = here / there, decides / there, here / decides
            lines.append([case, radius, *(f"{ratio:.3f}" for ratio in ratios)])

    def draw(figure):
        middle = EDGES[:-1] + 0.5 * SAMPLE
        for column, case in zip(figure.subplots(2, len(SLABS), squeeze=False).T, SLABS):
            above, below = column
            for radius, colour in zip(RADII, COLOURS):
                values, reference, third = curves[case, radius]
                label = f"radius {radius:.0f} m"
                above.semilogy(middle, values, "o", ms=3, color=colour, label=label)
                above.semilogy(middle, reference, "-", lw=0.8, color=colour)
                below.plot(middle, values / reference, "o", ms=3, color=colour)
                below.plot(middle, third / reference, "x", ms=4, color=colour)
            below.axhspan(1 - ACCURACY, 1 + ACCURACY, color="0.9")
            for ax in column:
                ax.axvline(DEPTH, color="0.6", linewidth=0.8)
            above.set(title=case, ylabel="attenuated backscatter (1 per m sr)")
            above.legend(fontsize=7)
            below.set(xlabel="range from the top (m)", ylabel="over multiscatter", ylim=(0.2, 1.6))

    return finish(
        arguments,
        "multiscatter_slabs",
        rows,
        title="Cloud-like slabs in three fields of view against multiscatter",
        caption="""Above: attenuated backscatter by jaxlidar (points) and multiscatter (lines); the grey line
        is the base. Below: jaxlidar (points) and photons in NumPy (crosses) over multiscatter, with the band
        of 20 %. Points follow crosses in all slabs. Where light diffuses, the mean of the tail is within the
        band. In the forward slab of depth 20, which diffuses light as little as an isotropic one of depth 3,
        multiscatter is a quarter too high in the two smaller fields of view.""",
        unchecked="""Uniform slabs without absorption, air or ground, lit vertically by a beam without width.
        Phase functions of droplets, with their forward and backward peaks, and light from above the base are
        not compared.""",
        draw=draw,
        size=(13.0, 7.0),
        code="multiscatter 1.2.10 (LGPL 2.1)",
        photons=arguments.photons,
        tables=[
            {
                "text": """Mean of the tail, from the base of the slab to three times its depth, by radius of
                the disc that is seen. The photons in NumPy share no code with either.""",
                "headings": [
                    "slab",
                    "radius (m)",
                    "jaxlidar over multiscatter",
                    "NumPy over multiscatter",
                    "jaxlidar over NumPy",
                ],
                "lines": lines,
            }
        ],
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
