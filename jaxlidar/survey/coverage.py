"""What lies below the shots of a survey: ground, and the voxel map or nothing."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxlidar._summary import NOTABLE_FRACTION, percent
from jaxlidar._vectors import FAR, vec
from jaxlidar.instrument.survey import Survey
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import Plane

# Rays of a footprint, and shots that are looked at together.
_RAYS, _TOGETHER = 512, 1024


class OffMapWarning(UserWarning):
    """The warning that a hundredth of a footprint's light or more falls beside the voxel map.

    There is nothing beyond a map with open sides, so such a shot sees less canopy than there may be.
    `Waveforms.off_map` has the share of every shot.

    **Example:** half a footprint beside the map.

    >>> import warnings
    >>> import jax, numpy as np, jaxlidar as jl
    >>> voxels = jl.VoxelMap.from_lad(np.ones((4, 4, 2)), voxel_size=1.0)
    >>> scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)))
    >>> with warnings.catch_warnings(record=True) as found:
    ...     warnings.simplefilter("always")
    ...     many = jl.simulate_many(
    ...         jl.Survey(jl.Lidar(), [(0, 2)]), scene, key=jax.random.key(0), max_orders=1, rtol=0.05
    ...     )
    >>> print(found[0].message)
    1 of 1 footprints lie partly beside the voxel map: shot 0 with 50 % of its light
    """


def ground_heights(survey: Survey, scene: Scene, upstream: float) -> Float[np.ndarray, " shots"]:
    """Heights, m, of the ground where each beam axis meets it; NaN where it meets none.

    `survey` and `scene` have the same origin of coordinates, `upstream` is a plan's.

    **Raises:** ValueError for shots beside a ground that ends somewhere.
    """
    if scene.ground is None:
        return np.full(len(survey), np.nan)
    start = np.pad(survey.position, ((0, 0), (0, 1))) - upstream * survey.direction
    x, w = (vec(jnp.asarray(a, float).T) for a in (start, survey.direction))
    shape = scene.ground.shape
    distance = np.asarray(shape.distance(x, w), float)
    met = distance < 0.1 * FAR
    if not met.all() and not isinstance(shape, Plane):
        beside = np.flatnonzero(~met)
        shown = ", ".join(map(str, beside[:5])) + (", ..." if beside.size > 5 else "")
        raise ValueError(
            f"position: {beside.size} of {len(survey)} shots do not meet the ground: shots {shown}; "
            "admissible are shots above it"
        )
    heights = start[:, 2] + np.where(met, distance, 0.0) * survey.direction[:, 2]
    return np.where(met, heights, np.nan)


def off_map(survey: Survey, scene: Scene) -> Float[np.ndarray, " shots"]:
    """Shares of each footprint's light that fall beside the voxel map, at its top or at its bottom."""
    canopy = scene.canopy
    if canopy is None or canopy.sides == "periodic":
        return np.zeros(len(survey))
    low, high = (np.asarray(a, float) for a in (canopy.voxels.origin, canopy.voxels.top))
    share = (np.arange(_RAYS) + 0.5) / _RAYS
    # A Fibonacci disc of rays of equal energy, in units of the footprint's radius.
    gaussian = survey.lidar.profile == "gaussian"
    radius = np.sqrt(-0.5 * np.log1p(-share) if gaussian else share)
    turn = np.pi * (np.sqrt(5.0) - 1.0) * np.arange(_RAYS)
    disc = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
    found = []
    for first in range(0, len(survey), _TOGETHER):
        part = survey[first : first + _TOGETHER]
        assert isinstance(part, Survey)
        axis = part.direction
        # Across the beam and level; along it, the footprint is longer.
        level = np.stack([np.cos(np.deg2rad(part.azimuth)), -np.sin(np.deg2rad(part.azimuth))], axis=-1)
        along = np.stack([-level[:, 1], level[:, 0]], axis=-1) / -axis[:, 2:]
        spread = disc[:, :1] * level[:, None] + disc[:, 1:] * along[:, None]
        spread = part.position[:, None] + part.footprint_radius[:, None, None] * spread
        beside = np.zeros(spread.shape[:2], bool)
        for z in (low[2], high[2]):
            place = spread + (z * axis[:, :2] / axis[:, 2:])[:, None]
            beside |= np.any((place < low[:2]) | (place > high[:2]), axis=-1)
        found.append(beside.mean(axis=1))
    return np.concatenate(found)


def said_of(beside: Float[np.ndarray, " shots"]) -> str | None:
    """A sentence on the footprints that lie partly beside the map, or None where there are none."""
    there = np.flatnonzero(beside >= NOTABLE_FRACTION)
    if there.size == 0:
        return None
    worst = there[np.argsort(-beside[there], kind="stable")][:3]
    listed = ", ".join(f"shot {i} with {percent(float(beside[i]))}" for i in worst)
    more = ", ..." if there.size > 3 else ""
    whose = "its" if there.size == 1 else "their"
    count = f"{there.size} of {beside.size} footprints"
    return f"{count} lie partly beside the voxel map: {listed}{more} of {whose} light"
