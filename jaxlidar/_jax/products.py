"""Products of arrays in full precision on every device.

By default, GPUs round the factors of products in single precision to 11 bits of the mantissa and TPUs to 8:
the parts of an energy budget then sum to 1.0002. CPUs compute in full precision anyway.
"""

from functools import partial

import jax.numpy as jnp
from jax import lax

FULL_PRECISION = lax.Precision.HIGHEST

einsum = partial(jnp.einsum, precision=FULL_PRECISION)
matmul = partial(jnp.matmul, precision=FULL_PRECISION)
tensordot = partial(jnp.tensordot, precision=FULL_PRECISION)
