"""Alternative estimators: with them, the gain of the estimators that are built in can be measured."""

import dataclasses

from jaxlidar._checks import check_choice, check_integer
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.trace_plan import KERNEL


def with_alternatives(
    plan: Plan,
    *,
    first_order: str = "expected",
    points: str = "lattice",
    kernel: int = KERNEL,
    ends: int | None = None,
) -> Plan:
    """The same plan with other estimators, for comparisons and benchmarks only.

    **Arguments:**

    - `plan`: a `Plan` made by `jaxlidar.plan`.
    - `first_order`: "expected" (integrated along every ray) or "drawn" (returns from drawn collisions, as
      those of the other orders, among which it is then counted). Default "expected".
    - `points`: "lattice" (of low discrepancy) or "independent" random numbers for rays and photons. Default
      "lattice".
    - `kernel`: fine bins over which an instant is spread: 3 (smooth), 2 (linear) or 1 (the nearest: without
      derivatives with respect to times). Default 3.
    - `ends`: points of each flight through a canopy from which light returns, one in each stratum of the
      probability of getting there; at least 1, which is the collision alone. Default None: the plan's, 4.

    **Returns:** a `Plan`.

    **Raises:** ValueError for other values, and for a drawn first order with a mirror or a hot spot.

    **Example:**

    >>> import jaxlidar as jl
    >>> from jaxlidar.planning.alternatives import with_alternatives
    >>> plan = jl.plan(jl.Lidar(), jl.Scene(ground=jl.Ground()))
    >>> with_alternatives(plan, kernel=1).bins.kernel
    1
    """
    check_choice("first_order", first_order, ("expected", "drawn"))
    check_choice("points", points, ("lattice", "independent"))
    if kernel not in (1, 2, 3):
        raise ValueError(f"kernel = {kernel} is none of 1, 2, 3")
    trace = plan.trace
    if first_order == "drawn" and (trace.hotspot or any(trace.mirrors)):
        raise ValueError("first_order = 'drawn'; admissible with a mirror or a hot spot is 'expected'")
    if ends is not None:
        # Without a canopy all ends of a flight are on the same surface.
        ends = check_integer("ends", ends) if trace.leaf or trace.bark else 1
    return dataclasses.replace(
        plan,
        bins=dataclasses.replace(plan.bins, kernel=kernel),
        trace=dataclasses.replace(
            trace,
            drawn_first=first_order == "drawn",
            independent=points == "independent",
            ends=trace.ends if ends is None else ends,
        ),
    )
