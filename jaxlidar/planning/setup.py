"""A lidar and a scene as a plan simulates them."""

from typing import final

import equinox as eqx

from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.effects import without
from jaxlidar.planning.plan import Plan
from jaxlidar.scenes.scene import Scene


@final
class Setup(eqx.Module):
    """A lidar and a scene without what a plan leaves out, and the plan: all that tracing and recording need.

    Setups are made by `reduce`. The plan is static; lidar and scene can be traced and differentiated.

    - `lidar`: a `Lidar`.
    - `scene`: a `Scene`.
    - `plan`: a `Plan`.

    **Example:**

    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(jitter=1.0), jl.Scene(ground=jl.Ground())
    >>> setup = jl.reduce(lidar, scene, jl.plan(lidar, scene, effects={"jitter": False}))
    >>> print(float(setup.lidar.jitter), setup.plan.off)
    0.0 ('jitter',)
    """

    lidar: Lidar
    scene: Scene
    plan: Plan = eqx.field(static=True)


def reduce(lidar: Lidar, scene: Scene, plan: Plan) -> Setup:
    """The lidar and the scene without what a plan leaves out, ready to be traced.

    **Arguments:**

    - `lidar`: a `Lidar`, with all its effects.
    - `scene`: a `Scene`, with all its effects.
    - `plan`: a `Plan` made by `jaxlidar.plan`.

    **Returns:** a `Setup`.

    **Example:**

    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(slope=10.0))
    >>> plan = jl.plan(lidar, scene, effects={"slope spread": False})
    >>> float(jl.reduce(lidar, scene, plan).scene.ground.slope)
    0.0
    """
    return Setup(*without(lidar, scene, plan.off), plan)
