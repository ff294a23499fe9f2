"""How many geometric columns of a Jacobian are pushed through the trace at once: as many as memory allows."""

from jaxlidar import Plan
from jaxlidar.planning.memory import format_bytes, memory_limit


def columns_at_once(plan: Plan, columns: int, beside: float = 0.0) -> int:
    """The number of columns that are pushed through the trace at once; groups of them are about as large.

    `beside`: bytes that the other columns take.

    **Raises:** ValueError where one column alone takes more memory than the plan may.
    """
    most, limit = columns, memory_limit(plan.scope.max_memory) - beside
    while most > 1 and plan.jacobian_memory(most) > limit:
        most -= 1
    if columns and (size := plan.jacobian_memory(most)) > limit:
        raise ValueError(
            f"derivatives in the geometric unknowns would take about {format_bytes(size)} of memory, one at "
            f"a time; admissible is max_memory = {limit / 1e9:.3g} GB of the plan: follow fewer orders "
            "(max_orders=), record a shorter window, have fewer plates or materials, or give a plan with more"
        )
    return -(-columns // -(-columns // most)) if columns else 0
