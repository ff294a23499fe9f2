"""Design of the tracer on a GPU: text of the page of benchmarks. Nothing of it was measured."""

# Lines of the table are as long as they need to be.
# ruff: noqa: E501

PAGE = """## On a GPU: a design

The tracer has run on CPUs only. It is plain JAX and asks for nothing else, but as it is written a GPU would
wait: a march is a loop of small steps, and each step would be kernels of its own, whose launches take longer
than their work. What each part is, and what would become of it; nothing of this has been measured:

| part | what it does | on a GPU |
| --- | --- | --- |
| march (`trace/march.py`) | each step gathers one extinction coefficient, three with leaf angles; nothing is scattered | one Pallas kernel for a whole flight: the state of a ray stays in registers, maps of some ten million voxels stay in the second-level cache |
| way up at nadir | one gather from a table of depths | stays as it is |
| way up otherwise | a march without targets | the same kernel, without targets |
| collisions (`trace/collisions.py`) | arithmetic on every photon, no memory | stays as it is: XLA fuses it |
| living photons first (`_alive_first`) | a running sum, a scatter of numbers, a gather of 20 words a photon | stays as it is, once an order; sorted by voxel as well, neighbours gather from the same lines |
| deposits of order one (`add_rows`) | rows of bins scattered to few histories; many rays meet the same bins | in the kernel of the march: each block sums its own record in shared memory, which is added to the whole once |
| deposits of higher orders | three bins scattered to one of hundreds of histories | sorted by history and bin, then summed by segments |
| colouring (`trace/colouring.py`) | a matrix product of optics and histories | stays as it is, in full single precision: the shorter products of tensor cores are too coarse |
| random numbers (`trace/random_numbers.py`) | an integer multiplication for each number | stays as it is |

Two rules of the CPU would change. Chunks of 256 photons exist so that a chunk stays in a core's cache and
chunks of dead photons are skipped: on a GPU a batch is one chunk, and the living ones are counted before an
order begins. Groups of chunks, whose sums are added, stay: they keep small deposits from being lost on large
sums.

Two rules must not. The same key gives the same waveform: atomic additions come in any order, so deposits are
sorted and summed by segments, which also makes sums repeatable. Derivatives need no march of their own: with
voxels held fixed, the derivative of a depth is a sum over the same steps, of lengths times derivatives of
coefficients and of coefficients times derivatives of lengths, so that the kernel's rule walks once more and
carries one number for each direction.
"""
