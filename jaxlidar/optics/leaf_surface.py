"""The surface of a leaf: mean Fresnel reflectances and transmittances, without cancellation.

Light of radiance independent of direction that arrives within a cone of half-angle alpha around the normal is
reflected by a smooth dielectric of refractive index n with the mean (Stern 1964; Allen 1973)

    r_alpha = 2/(1 - c^2) * integral over mu in [c, 1] of mu R(mu) dmu,    c = cos alpha,
    R(mu) = ((mu - g)/(mu + g))^2 / 2 + ((n^2 mu - g)/(n^2 mu + g))^2 / 2,    g = sqrt(n^2 - 1 + mu^2),

where mu is the cosine of incidence, and the two terms are Fresnel's for both polarisations. Its complement is

    1 - R(mu) = 2 mu g [1/(mu + g)^2 + n^2/(n^2 mu + g)^2].

r12 is r_alpha at 90 degrees. From inside, where light beyond the critical angle is reflected totally, the
transmittance is t21 = t12/n^2, by reciprocity.

*Numerics.* The factor 2/(1 - c^2) is 2/(1 + c) times 1/(1 - c): the latter makes the integral an average over
mu in [c, 1], which is smooth at alpha = 0 and 90 degrees and is taken by Gauss-Legendre quadrature. r and
1 - r come from separate sums of positive terms, so that neither loses digits where it is small (n close to 1,
or grazing incidence). The differences in R(mu) are written as mu - g = -(n^2 - 1)/(mu + g), and likewise for
the other polarisation.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxlidar._fields.checks import as_numpy, check_number, check_range

# Gauss-Legendre nodes and weights on [0, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


class LeafSurface(NamedTuple):
    """Mean reflectances and transmittances of a leaf's surface, each an array of one shape.

    - `t_alpha`, `r_alpha`: of light within the cone of incidence, from outside.
    - `t12`, `r12`: of diffuse light from outside.
    - `t21`, `r21`: of diffuse light from inside.

    Each pair adds up to 1.

    **Example:**

    >>> import jaxlidar as jl
    >>> face = jl.leaf_surface(1.45)
    >>> print(f"{face.t12 + face.r12:.3f} {face.t21:.3f}")
    1.000 0.435
    """

    t_alpha: Any
    r_alpha: Any
    t12: Any
    r12: Any
    t21: Any
    r21: Any


def leaf_surface(n: ArrayLike, alpha: float | int = 40.0) -> LeafSurface:
    """Mean reflectances and transmittances of a dielectric surface.

    **Arguments:**

    - `n`: refractive index, any shape, at least 1. Exact to rounding from 1.01 on.
    - `alpha`: half-angle of the cone of incidence, degrees, in [0, 90]. Default 40, as in PROSPECT.

    **Returns:** a `LeafSurface` of arrays shaped as `n`: JAX arrays where `n` is one, else NumPy arrays of
    float64.

    **Raises:** ValueError for values outside these ranges; TypeError for arguments that are no numbers.

    **Source:** Stern (1964), Appl. Opt. 3, 111; Allen (1973), J. Opt. Soc. Am. 63, 664.

    **Example:**

    >>> import jaxlidar as jl
    >>> face = jl.leaf_surface(1.45)
    >>> print(f"{face.r_alpha:.3f} within the cone, {face.r12:.3f} diffuse")
    0.035 within the cone, 0.084 diffuse
    """
    check_range("n", n, 1.0)
    check_number("alpha", alpha, 0.0, 90.0)
    xp: Any = jnp if isinstance(n, jax.Array) else np
    index = n if isinstance(n, jax.Array) else as_numpy(n, "n")
    t_alpha, r_alpha = _mean_within_cone(xp, index, alpha)
    t12, r12 = _mean_within_cone(xp, index, 90.0)
    square = index * index
    # r21 = 1 - t12/n^2, as a sum of positive terms.
    return LeafSurface(
        t_alpha, r_alpha, t12, r12, t12 / square, r12 + t12 * ((index - 1) * (index + 1) / square)
    )


def _mean_within_cone(xp: Any, n: Any, alpha: float | int) -> tuple[Any, Any]:
    """Mean transmittance and reflectance within a cone; `xp` is the module of `n`, NumPy or jax.numpy."""
    # The cosine of 90 degrees would be 6e-17.
    c = np.cos(np.deg2rad(alpha)) if alpha < 90 else 0.0
    n = n[..., None]
    mu = np.broadcast_to(c + (1 - c) * _NODES, (1,) * (n.ndim - 1) + _NODES.shape).astype(n.dtype)
    weight = (2 / (1 + c) * _WEIGHTS * (c + (1 - c) * _NODES)).reshape(mu.shape).astype(n.dtype)
    g = xp.sqrt((n - 1) * (n + 1) + mu * mu)
    square, excess = n * n, (n - 1) * (n + 1)
    # Perpendicular (s) and parallel (p) to the plane of incidence.
    per_s, per_p = 1 / (mu + g), 1 / (square * mu + g)
    transmittance = 2 * mu * g * (per_s * per_s + square * per_p * per_p)
    s_amplitude = excess * per_s * per_s
    p_amplitude = excess * ((square + 1) * mu * mu - 1) * per_p * per_p
    reflectance = (s_amplitude * s_amplitude + p_amplitude * p_amplitude) / 2
    return xp.sum(weight * transmittance, axis=-1), xp.sum(weight * reflectance, axis=-1)
