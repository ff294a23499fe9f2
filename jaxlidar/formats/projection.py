"""Positions on another map: points, inventories and trajectories in another coordinate reference system."""

import dataclasses
from typing import TypeVar

import numpy as np

from jaxlidar._fields.checks import check_kind
from jaxlidar._fields.crs import (
    common_system,
    directions_of_north,
    level_and_heights,
    metric_system,
    transform,
)
from jaxlidar.plants.inventory import Inventory
from jaxlidar.plants.point_cloud import PointCloud
from jaxlidar.sensors.trajectory import Trajectory

_Data = TypeVar("_Data", PointCloud, Inventory, Trajectory)


def to_crs(data: _Data, crs: str | int) -> _Data:
    """Transform points, an inventory or a trajectory to another map, by PROJ.

    Headings of a trajectory are turned to the north of the new map. Heights are transformed where both
    systems declare theirs, as "EPSG:25832+7837" does, and stay where neither does. Lengths other than
    positions stay, so that distances differ by the scales of the maps, some 1e-3 in UTM. Terrain and voxel
    maps are not transformed: make them from transformed points.

    **Arguments:**

    - `data`: a `PointCloud`, an `Inventory` or a `Trajectory`, with its `crs`.
    - `crs`: the coordinate reference system to transform to, in metres, such as "EPSG:32633", or its EPSG
      number.

    **Returns:** the same kind of object, with this `crs`.

    **Warns:** UserWarning with the accuracy of the transformation, where that is coarser than 0.1 m or
    unknown, and with the file of a better one that is not installed.

    **Raises:** ValueError for data without a `crs`, one that is not known or not in metres, heights that one
    of the systems declares alone, and positions outside of the new map; TypeError for other objects.

    **Example:**

    >>> import jaxlidar as jl
    >>> flight = jl.Trajectory([0.0, 1.0], [(5e5, 5.3e6, 900), (5e5, 5.30006e6, 900)], crs=25832)
    >>> moved = jl.io.to_crs(flight, "EPSG:25833")
    >>> print(moved.position[0].round(1).tolist(), moved.yaw.round(2).tolist(), moved.crs)
    [51241.8, 5317451.8, 900.0] [4.46, 4.46] EPSG:25833
    """
    check_kind(
        "data", data, PointCloud | Inventory | Trajectory, "a PointCloud, an Inventory or a Trajectory"
    )
    check_kind("crs", crs, str | int, "the name of a coordinate reference system, or its EPSG number")
    if data.crs is None:
        raise ValueError("data has no crs; admissible is data whose crs is stated where it is read or made")
    name = common_system({"crs": crs})
    assert name is not None
    source, target = metric_system("data.crs", data.crs), metric_system("crs", name)
    (level, heights), (new_level, new_heights) = map(level_and_heights, (source, target))
    if (heights is None) != (new_heights is None):
        raise ValueError(
            f"heights are declared in {data.crs if new_heights is None else name} alone; admissible is that "
            "both systems declare theirs, as 'EPSG:25832+7837' does, or neither"
        )
    if isinstance(data, Inventory):
        z = np.zeros(len(data.x)) if data.z is None else data.z
        position = np.stack([data.x, data.y, z], axis=1)
    else:
        position = data.position
    if heights is None:
        moved = transform("data", level, new_level, *position.T[:2])
        moved = np.column_stack([moved, position[:, 2]])
    else:
        moved = transform("data", source.crs, target.crs, *position.T)
    outside = np.flatnonzero(~np.isfinite(moved).all(axis=1))
    if outside.size:
        raise ValueError(
            f"data: {outside.size} of {len(moved)} positions lie outside of {name}, the first at "
            f"{position[outside[0]].tolist()} in {data.crs}"
        )
    if isinstance(data, PointCloud):
        return data._replace(position=moved, crs=name)
    if isinstance(data, Inventory):
        z = None if data.z is None else moved[:, 2]
        return data._replace(x=moved[:, 0], y=moved[:, 1], z=z, crs=name)
    turn = directions_of_north(level, *position.T[:2]) - directions_of_north(new_level, *moved.T[:2])
    yaw = np.fmod(data.yaw + turn, 360.0)
    return dataclasses.replace(data, position=moved, yaw=yaw, crs=name)
