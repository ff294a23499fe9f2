"""What code that builds on jaxlidar may use: checks at construction, vectors, threads.

For laws, pulses and elements of your own, and for packages on top such as `inversion`:

- fields: `as_array`, `as_scalar` convert them; `check_range`, `check_integer`, `check_choice` refuse values,
  `check_kind`, `check_numbers`, `check_key` things of another kind; `concrete` tells known values from those
  that a JAX transformation is tracing.
- directions: a `Vec` is a tuple of three arrays, x, y and z; `dot`, `scale`, `add`, `normalise`; `polar` and
  `from_frame` make directions about an axis, `about` draws one by the cosine law.
- ranges: a class states them by field, `ranges = {"slope": Range(0.0, 90.0)}`; its constructor calls
  `check_ranges`, and `inadmissible` finds values outside them where JAX is tracing, `reasons` says which.
- `check_kinds` refuses what is no lidar or no scene.
- `briefly` shortens the signature that `help` shows of a function or a class, `shorten_signatures` those of a
  package.
- `fingerprint` tells whether all that a result depends on is as it was.
- `once` has values computed once for all that use them, whatever the compiler.
- `side_by_side` runs compiled programs on as many threads as there are cores; compile them with `ONE_CORE`.
- `outcomes` does tasks that `task` makes, here or by the workers of an executor.
"""

from jaxlidar._checks import (
    as_array,
    as_scalar,
    check_choice,
    check_integer,
    check_key,
    check_kind,
    check_numbers,
    check_range,
    concrete,
)
from jaxlidar._fingerprint import fingerprint
from jaxlidar._one_function import once
from jaxlidar._ranges import Range, check_ranges, inadmissible, reasons
from jaxlidar._signatures import briefly, shorten_signatures
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
from jaxlidar._workers import outcomes, task
from jaxlidar.scenes.scene import check_kinds

__all__ = [
    "ONE_CORE",
    "Range",
    "Scalar",
    "Vec",
    "about",
    "add",
    "along",
    "as_array",
    "as_scalar",
    "briefly",
    "check_choice",
    "check_integer",
    "check_key",
    "check_kind",
    "check_kinds",
    "check_numbers",
    "check_range",
    "check_ranges",
    "concrete",
    "cross",
    "dot",
    "fingerprint",
    "from_frame",
    "inadmissible",
    "normalise",
    "once",
    "outcomes",
    "polar",
    "reasons",
    "scale",
    "shorten_signatures",
    "side_by_side",
    "task",
    "vec",
]

shorten_signatures(globals(), converters=("as_array", "as_scalar"))
