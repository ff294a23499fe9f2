"""A lidar and a scene as a plan simulates them."""

from typing import final

import equinox as eqx

from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.effects import without
from jaxlidar.planning.plan import Plan
from jaxlidar.scenes.scene import Scene


@final
class Setup(eqx.Module):
    """A lidar and a scene without what a plan leaves out: all that tracing and recording need.

    Made by `reduce`. The plan is static; lidar and scene are traced and differentiated.
    """

    lidar: Lidar
    scene: Scene
    plan: Plan = eqx.field(static=True)


def reduce(lidar: Lidar, scene: Scene, plan: Plan) -> Setup:
    """Take what a plan leaves out of a lidar and a scene. Everything below works on the result.

    **Arguments:**

    - `lidar`, `scene`: as given by the user.
    - `plan`: of `jaxlidar.plan`.

    **Returns:** a `Setup`.

    **Example:**

    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(slope=10.0))
    >>> plan = jl.plan(lidar, scene, effects={"slope spread": False})
    >>> float(jl.reduce(lidar, scene, plan).scene.ground.slope)
    0.0
    """
    return Setup(*without(lidar, scene, plan.off), plan)
