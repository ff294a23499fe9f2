"""Waveforms of a crown by all orders against MCX-CL, which follows photons through media of tissue.

    python examples/validation/mcx_crown.py [--out figures] [--repeats 6]

Needs `pip install 'jaxlidar[bench]'`. The scene is the crown without ground of the benchmark
(`examples/benchmarks/peers.py`): 64^3 voxels of random extinction in a sphere, isotropic scattering with
albedo 0.9. MCX has no limit of orders; jaxlidar follows 60. MCX returns the fluence in voxels and gates of
0.25 ns, from which the returned light is computed. The light deposited in a voxel, which takes 0.52 ns to
cross, counts in one gate: times are uncertain by half of both. The change of a sum of 5 ns under such a shift
is part of its error.
"""

import sys

import numpy as np
from _crown import compare
from _validation import options

GATE, CROSSING = 0.25, 0.52


def main(argv=None):
    arguments = options(__doc__, argv, repeats=6)
    return compare(
        arguments,
        "mcx_crown",
        "MCX-CL",
        "_peer_mcx.py",
        ("alone",),
        orders=60,
        pulse=6.0,
        worker_options={"mcx_gate": GATE},
        timing=0.5 * float(np.hypot(GATE, CROSSING)),
        title="A crown against MCX-CL",
        caption="""Above the waveforms, below their relative differences with bars of two standard errors.
        The tail, where light was scattered many times, is as long by both.""",
        unchecked="""No ground and no leaves' phase function. Where the waveform rises and falls, MCX's own
        gates and voxels set the error.""",
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
