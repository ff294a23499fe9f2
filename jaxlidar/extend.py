"""Building blocks for extensions of jaxlidar: checks of arguments, vectors, threads.

For laws, pulses and surfaces of your own, and for packages on top such as `inversion`:

- fields: `as_array`, `as_scalar` and, in NumPy's double precision, `as_numpy` convert them, and refuse
  booleans, times and masked elements; `check_range`, `check_number`, `check_integer`, `check_index` refuse
  values, `check_kind`, `check_numbers`, `check_key` objects of another type; `concrete`
  returns the value of an array, or None where a JAX transformation is tracing it; `even_step` the step of
  times or heights, and refuses uneven ones. `warn_user` warns at the line of the user's code.
- directions: a `Vec` is a tuple of three arrays, x, y and z; `dot`, `scale`, `add`, `normalise`; `polar` and
  `from_frame` make directions about an axis, `cosine_direction` draws one by the cosine law.
- ranges: `quantity` makes a field with its unit, `Range` and conversion, by `as_array` and others, such as
  `as_optional_scalar`; the constructor calls `check_ranges`; where JAX is tracing, `inadmissible` detects
  values outside of them and `reasons` tells which.
- `check_kinds` refuses objects that are not a lidar and a scene.
- `fingerprint` is a hash of everything that a result depends on, to compare with that of a stored result.
- `barrier` is an optimisation barrier: the compiler computes its arguments once, instead of again in each
  expression that uses them.
- `einsum`, `matmul` and `tensordot` are those of `jax.numpy`, in full precision on every device: by default,
  GPUs round their factors.
- `side_by_side` runs compiled programs on as many threads as there are cores; compile them as a
  `Program` with `one_core=True`.
- `outcomes` runs the tasks that `task` makes, in this process or by the workers of an executor.
"""

from jaxlidar._fields.checks import (
    as_array,
    as_numpy,
    as_optional_array,
    as_optional_scalar,
    as_scalar,
    check_index,
    check_integer,
    check_key,
    check_kind,
    check_number,
    check_numbers,
    check_range,
    concrete,
    even_step,
    warn_user,
)
from jaxlidar._fields.ranges import Range, check_ranges, inadmissible, quantity, reasons
from jaxlidar._fingerprint import fingerprint
from jaxlidar._jax.one_function import barrier
from jaxlidar._jax.products import einsum, matmul, tensordot
from jaxlidar._jax.programs import Program
from jaxlidar._jax.threads import side_by_side
from jaxlidar._jax.workers import outcomes, task
from jaxlidar._vectors import (
    Scalar,
    Vec,
    add,
    along,
    cosine_direction,
    dot,
    from_frame,
    normalise,
    polar,
    scale,
    vec,
)
from jaxlidar.scenes.scene import check_kinds

__all__ = [
    "Program",
    "Range",
    "Scalar",
    "Vec",
    "add",
    "along",
    "as_array",
    "as_numpy",
    "as_optional_array",
    "as_optional_scalar",
    "as_scalar",
    "barrier",
    "check_index",
    "check_integer",
    "check_key",
    "check_kind",
    "check_kinds",
    "check_number",
    "check_numbers",
    "check_range",
    "check_ranges",
    "concrete",
    "cosine_direction",
    "dot",
    "einsum",
    "even_step",
    "fingerprint",
    "from_frame",
    "inadmissible",
    "matmul",
    "normalise",
    "outcomes",
    "polar",
    "quantity",
    "reasons",
    "scale",
    "side_by_side",
    "task",
    "tensordot",
    "vec",
    "warn_user",
]
