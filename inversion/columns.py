"""How many geometric columns of a Jacobian are pushed through the trace at once: as many as memory allows."""

from jaxlidar import Plan
from jaxlidar.planning.memory import in_words, memory_limit

# Columns up to which scores are known to take less time than tangents.
MOST_SCORED = 32
# Tables of columns and voxels that scores take, and the bytes of a number.
_TABLES, _NUMBER = 8, 8


def scores_fit(plan: Plan, columns: int, cells: int) -> bool:
    """Whether the tables of scores, of so many columns and voxels, fit into a plan's memory."""
    return _TABLES * _NUMBER * columns * cells <= memory_limit(plan.limits.max_memory)


def columns_at_once(plan: Plan, columns: int) -> int:
    """The number of columns that are pushed through the trace at once; groups of them are about as large.

    **Raises:** ValueError where one column alone takes more memory than the plan may.
    """
    most, limit = columns, memory_limit(plan.limits.max_memory)
    while most > 1 and plan.jacobian_memory(most) > limit:
        most -= 1
    if columns and (size := plan.jacobian_memory(most)) > limit:
        raise ValueError(
            f"derivatives in the geometric unknowns would take about {in_words(size)} of memory, one at a "
            f"time; admissible is max_memory = {limit / 1e9:.3g} GB of the plan: follow fewer orders "
            "(max_orders=), record a shorter window, have fewer plates or materials, or give a plan with more"
        )
    return -(-columns // -(-columns // most)) if columns else 0
