"""Waveforms of a crown by all orders against Mitsuba 3 with mitransient, a path tracer of transient light.

    python examples/validation/mitransient_crown.py [--out figures] [--repeats 32]

Needs `pip install 'jaxlidar[bench]'`. The scene and the settings of the renderer are those of the benchmark
(`examples/benchmarks/peers.py`): 64^3 voxels of random extinction in a sphere, isotropic scattering with
albedo 0.9, up to 15 scatterings, with and without Lambertian ground; the returns of a pulse of 6 ns. The
two cases of the renderer share random numbers, so that their errors are correlated.
"""

import sys

from _crown import compare
from _validation import options


def main(argv=None):
    arguments = options(__doc__, argv, repeats=32)
    return compare(
        arguments,
        "mitransient_crown",
        "mitransient",
        "_peer_mitransient.py",
        ("ground", "alone"),
        orders=15,
        pulse=6.0,
        worker_options={"cases": ["ground", "alone"]},
        title="A crown against mitransient",
        caption="""Above the waveforms, below their relative differences with bars of two standard errors.
        Peak, decay and the ground's echo agree in height and in time. Over ground a little more comes
        back here in all, by more than the errors say: less than a thousandth, which is not explained.""",
        unchecked="""Isotropic scattering alone, no leaves' phase function; light above 1 % of the peak.
        mitransient 1.3.1 leaves stretches between null collisions out of path lengths, which is corrected in
        a copy. Its histogram has bins of 0.05 ns, which move steep sides by more than the bars.""",
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
