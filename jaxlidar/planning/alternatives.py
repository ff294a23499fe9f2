"""Other estimators, to compare with: what the choices that are built in are worth."""

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
    """The same plan with other estimators. For comparisons and benchmarks; nobody else needs it.

    **Arguments:**

    - `plan`: of `jaxlidar.plan`.
    - `first_order`: "expected" (default: integrated along every ray) or "drawn" (returns from drawn
      collisions, as those of the other orders, among which it is then counted).
    - `points`: "lattice" (default: of low discrepancy) or "independent" random numbers for rays and photons.
    - `kernel`: fine bins over which an instant is spread: 3 (default, smooth), 2 (linear) or 1 (the nearest:
      without derivatives with respect to times).
    - `ends`: points of each flight through a canopy from which light returns, one in each stratum of the
      probability of getting there; 1 is the collision alone. Default None: the plan's, 4.

    **Returns:** a `Plan`.

    **Raises:** ValueError for other values, and for a drawn first order with a mirror or a hot spot.
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
        trace=trace._replace(
            drawn_first=first_order == "drawn",
            independent=points == "independent",
            ends=trace.ends if ends is None else ends,
        ),
    )
