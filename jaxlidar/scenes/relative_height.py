"""Heights of a canopy relative to its ground: a buried one is refused, a misplaced one reported."""

import jax
import numpy as np

from jaxlidar._fields.checks import concrete, warn_user
from jaxlidar._text import NOTABLE_FRACTION, percent
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.surfaces import AbstractGround
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.scenes.voxels import VoxelMap

# A canopy whose lowest plants are so high above the ground, m, hangs in the air: no tree does.
MAX_CLEARANCE = 100.0
_REMEDY = "VoxelMap.above(terrain) lifts a map whose z is height above the ground"


class MisplacedCanopyWarning(UserWarning):
    """The warning that plants lie below the terrain of their scene, or hang in the air above it.

    It is given for more than a hundredth of the plants below the terrain, where light does not get, and for a
    canopy whose lowest plants are more than 100 m above it. A canopy that is buried as a whole is refused.

    **Example:**

    >>> import warnings
    >>> import jaxlidar as jl, numpy as np
    >>> voxels = jl.VoxelMap.from_lad(np.ones((2, 2, 10)), voxel_size=1.0)
    >>> canopy = jl.Canopy(voxels, leaf=jl.Prospect())
    >>> terrain = jl.Terrain(np.full((3, 3), 4.0), spacing=1.0)
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     scene = jl.Scene(canopy=canopy, ground=terrain)
    >>> print(str(caught[0].message).split(":")[0])
    40 % of the plants lie below the terrain, up to 4 m deep
    """


def check_relative_height(canopy: Canopy, ground: AbstractGround) -> None:
    """Compare the heights of plants with that of the terrain below them. Nothing is checked while traced.

    A plane ground is not checked: its height is often an unknown of a fit, and moves through the canopy.

    **Raises:** ValueError for a canopy that lies below the terrain as a whole.

    **Warns:** MisplacedCanopyWarning.
    """
    if not isinstance(ground, Terrain):
        return
    voxels = canopy.voxels
    size, origin = concrete(voxels.voxel_size), concrete(voxels.origin)
    terrain = (concrete(a) for a in (ground.heights, ground.spacing, ground.origin))
    if size is None or origin is None or any(a is None for a in terrain):
        return
    extinction = _total_extinction(voxels)
    if extinction is None or not np.any(extinction):
        return
    nx, ny, nz = voxels.shape
    x, y = (o + d * (np.arange(n) + 0.5) for o, d, n in zip(origin[:2], size[:2], (nx, ny)))
    middles = origin[2] + size[2] * (np.arange(nz) + 0.5)
    if ground.sides == "open":
        # Columns beside the terrain have no height below them.
        low, high = np.asarray(concrete(ground.origin), float), ground.end
        over_x, over_y = ((low[k] <= v) & (v <= high[k]) for k, v in enumerate((x, y)))
        if not (np.all(over_x) and np.all(over_y)):
            x, y, extinction = x[over_x], y[over_y], extinction[np.ix_(over_x, over_y)]
    has_plants = extinction > 0
    has_any = np.any(has_plants, axis=2)
    if not np.any(has_any):
        return
    # Within a transformation that traces other parts of the scene, constants would be traced, too.
    with jax.ensure_compile_time_eval():
        surface = np.asarray(ground.height_at(*np.meshgrid(x, y, indexing="ij")), float)
    # Only voxels that lie below the terrain as a whole count: in a map that was lifted onto terrain, the
    # lowest voxel of a column is partly in the ground.
    tops = middles + 0.5 * size[2]
    # Depths of the lowest and the highest plants of each column.
    deepest, shallowest = (
        surface[has_any] - tops[level[has_any]]
        for level in (np.argmax(has_plants, axis=2), nz - 1 - np.argmax(has_plants[:, :, ::-1], axis=2))
    )
    deepest, shallowest = float(deepest.max()), float(shallowest.min())
    # Rounding of single precision must not bury what lies on the terrain.
    least_depth = -1e-3 * size[2]
    if shallowest > least_depth:
        raise ValueError(
            f"the canopy lies below the terrain, its top {shallowest:.3g} m deep: no light reaches "
            f"it; {_REMEDY}"
        )
    if deepest > least_depth:
        is_buried = surface[:, :, None] - tops > least_depth
        total, buried = (float(extinction.sum(where=w, dtype=float)) for w in (has_plants, is_buried))
        if buried > NOTABLE_FRACTION * total:
            bottom = deepest + float(size[2])
            _warn(f"{percent(buried / total)} of the plants lie below the terrain, up to {bottom:.3g} m deep")
    elif (clearance := -deepest - float(size[2])) > MAX_CLEARANCE:
        _warn(f"the lowest plants are {clearance:.3g} m above the terrain")


def _warn(message: str) -> None:
    warn_user(f"{message}: {_REMEDY}", MisplacedCanopyWarning)


def _total_extinction(voxels: VoxelMap) -> np.ndarray | None:
    """Return the extinction coefficient of leaf and bark together; None while it is being traced."""
    total = None
    for table in (voxels.leaf, voxels.bark):
        if table is None:
            continue
        values = concrete(table)
        if values is None:
            return None
        total = values if total is None else total + values
    return total
