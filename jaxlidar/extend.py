"""What code that builds on jaxlidar may use: checks at construction, vectors, threads.

For laws, pulses and elements of your own, and for packages on top such as `inversion`:

- fields: `as_array`, `as_scalar` convert them, `check_range`, `check_choice` refuse what is inadmissible;
  `concrete` tells known values from those that a JAX transformation is tracing.
- directions: a `Vec` is a tuple of three arrays, x, y and z; `dot`, `scale`, `add`, `normalise`; `polar` and
  `from_frame` make directions about an axis, `about` draws one by the cosine law.
- `side_by_side` runs compiled programs on as many threads as there are cores; compile them with `ONE_CORE`.
"""

from jaxlidar._checks import as_array, as_scalar, check_choice, check_range, concrete
from jaxlidar._threads import ONE_CORE, side_by_side
from jaxlidar._vectors import (
    Scalar,
    Vec,
    about,
    add,
    along,
    cross,
    dot,
    from_frame,
    normalise,
    polar,
    scale,
    vec,
)

__all__ = [
    "ONE_CORE",
    "Scalar",
    "Vec",
    "about",
    "add",
    "along",
    "as_array",
    "as_scalar",
    "check_choice",
    "check_range",
    "concrete",
    "cross",
    "dot",
    "from_frame",
    "normalise",
    "polar",
    "scale",
    "side_by_side",
    "vec",
]
