"""Design of the tracer on a GPU: text of the page of benchmarks. Nothing of it was measured."""

# Lines of the table are as long as they need to be.
# ruff: noqa: E501

PAGE = """## On a GPU: a design

The tracer has run on CPUs only. It is plain JAX without other requirements, but in its present form a GPU would be
idle most of the time: the traversal of voxels is a loop of small steps, and each step would be several kernels whose
launches take longer than their work. The table lists the steps of the tracer and a design for a GPU; nothing of
this has been measured:

| step | work | on a GPU |
| --- | --- | --- |
| traversal (`trace/voxel_traversal.py`) | each step gathers one extinction coefficient, three with leaf angles; no scatter | one Pallas kernel for a whole flight: the state of a ray stays in registers, maps of some ten million voxels stay in the second-level cache |
| return path at nadir | one gather from a table of optical depths | unchanged |
| return path off nadir | a traversal without target depths | the same kernel, without target depths |
| collisions (`trace/collisions.py`) | arithmetic on every photon, no memory access | unchanged: XLA fuses it |
| stream compaction (`trace/compaction.py`) | a running sum, a scatter of indices, a gather of 20 words a photon | unchanged, once an order; if photons are sorted by voxel as well, neighbours gather from the same cache lines |
| deposits of the first order (`trace/deposit.py`) | rows of bins scattered to few histories; many rays meet the same bins | in the kernel of the traversal: each block sums a record in shared memory, which is added to the total once |
| deposits of higher orders | three bins scattered to one of hundreds of histories | sorted by history and bin, then summed by segments |
| application of optics (`spectral/apply_optics.py`) | a matrix product of optics and histories | unchanged, in full single precision: the reduced precision of tensor cores is too coarse |
| random numbers (`trace/random_numbers.py`) | an integer multiplication for each number | unchanged |

Two properties of the CPU version would change. Chunks of 256 photons keep their data in the cache of a core, and
chunks of dead photons are skipped: on a GPU a batch is one chunk, and living photons are counted before an order
begins. Groups of chunks, whose sums are added, remain: they keep small deposits from being lost on large sums.

Two properties must not change. The same key gives the same waveform: as atomic additions happen in arbitrary order,
deposits are sorted and summed by segments, which also makes sums reproducible. Derivatives need no other traversal:
with voxels held fixed, the derivative of an optical depth is a sum over the same steps, of lengths times derivatives
of coefficients plus coefficients times derivatives of lengths, so that the rule of the kernel traverses once more and
carries one number for each direction.
"""
