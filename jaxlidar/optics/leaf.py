"""Leaf optics given as numbers, with the interface of a leaf model."""

from collections.abc import Sequence
from typing import ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import as_array
from jaxlidar._fields.ranges import FRACTION, SUM_OF_FRACTIONS, check_ranges, quantity


@final
class LeafOptics(eqx.Module):
    """Leaf optics from given reflectance and transmittance: `R, T = optics(wavelengths)`, as with `Prospect`.

    **Arguments:**

    - `reflectance`: hemispherical reflectance, one number or one per wavelength, in [0, 1].
    - `transmittance`: hemispherical transmittance, one number or one per wavelength, in [0, 1]. The sum with
      the reflectance is at most 1. Default 0.

    **Raises:** ValueError, naming the field, its value and the admissible range, for values outside their
    range, for a sum above 1, for more than one dimension, and for different numbers of values; TypeError for
    arguments that are no numbers. Inside a JAX transformation values cannot be checked.

    **Example:**

    >>> import jaxlidar as jl
    >>> R, T = jl.LeafOptics(reflectance=[0.1, 0.45], transmittance=[0.05, 0.4])([532.0, 1064.0])
    >>> print([f"{x:.2f}" for x in R], [f"{x:.2f}" for x in T])
    ['0.10', '0.45'] ['0.05', '0.40']
    """

    reflectance: Float[Array, "*wavelengths"] = quantity(range=FRACTION, converter=as_array)
    transmittance: Float[Array, "*wavelengths"] = quantity(range=FRACTION, converter=as_array, default=0.0)

    ranges: ClassVar = {"reflectance + transmittance": SUM_OF_FRACTIONS}

    def __check_init__(self):
        for name in ("reflectance", "transmittance"):
            value = getattr(self, name)
            if value.ndim > 1 or value.size == 0:
                raise ValueError(
                    f"{name} has shape {value.shape}; admissible is a number or one per wavelength"
                )
        R, T = self.reflectance, self.transmittance
        if R.ndim == T.ndim == 1 and R.shape != T.shape:
            raise ValueError(f"transmittance has {T.size} values where reflectance has {R.size}")
        check_ranges(self)

    def __call__(
        self, wavelengths: ArrayLike | Sequence[ArrayLike]
    ) -> tuple[Float[Array, "*wavelengths"], Float[Array, "*wavelengths"]]:
        """Reflectance and transmittance, one per wavelength.

        **Arguments:**

        - `wavelengths`: nm, of any shape where the optics are single numbers, else as many as there are
          values.

        **Returns:** reflectance and transmittance, shaped as `wavelengths`.

        **Raises:** ValueError where the numbers of values and wavelengths differ.
        """
        shape = np.shape(wavelengths)  # pyright: ignore[reportArgumentType, reportCallIssue]
        for name in ("reflectance", "transmittance"):
            value = getattr(self, name)
            if value.ndim and value.shape != shape:
                raise ValueError(f"{name} has {value.size} values, where wavelengths has the shape {shape}")
        return jnp.broadcast_to(self.reflectance, shape), jnp.broadcast_to(self.transmittance, shape)
