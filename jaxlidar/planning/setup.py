"""`Setup`: a lidar and a scene without the effects that a plan leaves out."""

import dataclasses
from typing import final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxlidar._fields.checks import check_kind, has_tracers, is_traced
from jaxlidar._fields.ranges import inadmissible
from jaxlidar.planning.effects import without_effects
from jaxlidar.planning.local_origin import move_aim_to_origin
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.plan_check import is_covered
from jaxlidar.scenes.scene import Scene, check_kinds
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import Lidar


@final
class Setup(eqx.Module):
    """A lidar and a scene without the effects that a plan leaves out, and the plan.

    A setup is the input of `trace_scene` and `waveform_of`; `make_setup` makes one. Lidar and scene can be
    traced and differentiated.

    - `lidar`: a `Lidar`.
    - `scene`: a `Scene`.
    - `plan`: a `Plan`.
    - `admissible`: a factor by which waveforms are multiplied: 1, or NaN where a traced value lies outside
      its range.
    - `is_covered`: True, or False where the plan does not cover the traced lidar and scene: then
      `Waveform.lost` is 1 at least.

    **Example:**

    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(jitter=1.0), jl.Scene(ground=jl.Ground())
    >>> setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene, effects={"jitter": False}))
    >>> print(float(setup.lidar.jitter), setup.plan.off)
    0.0 ('jitter',)
    """

    lidar: Lidar
    scene: Scene
    plan: Plan
    admissible: Float[Array, ""]
    is_covered: Bool[Array, ""]

    def nan_unless_covered(self) -> Float[Array, ""]:
        """Return a factor for results that do not have `lost`: `admissible`, and NaN where not covered."""
        return jnp.where(self.is_covered, self.admissible, jnp.nan)


def make_setup(lidar: Lidar, scene: Scene, plan: Plan) -> Setup:
    """Make the setup of a lidar and a scene: without the effects that a plan leaves out, about the aim point.

    **Arguments:**

    - `lidar`: a `Lidar`, with all its effects.
    - `scene`: a `Scene`, with all its effects.
    - `plan`: a `Plan` made by `jaxlidar.plan`.

    Within a JAX transformation values cannot be refused: waveforms are NaN where a traced value lies outside
    the range that its class states. `jaxlidar.extend.reasons` says which. `Waveform.lost` is 1 where the plan
    does not cover the lidar and the scene.

    **Returns:** a `Setup`.

    **Raises:** TypeError for arguments of another kind; ValueError where heights of terrain are being traced
    with a plan for a plane, leaf or bark with a plan for a map that has none, or meshes with a plan that
    leaves them out.

    **Example:**

    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(slope=10.0))
    >>> plan = jl.plan(lidar, scene, effects={"slope spread": False})
    >>> float(jl.make_setup(lidar, scene, plan).scene.ground.slope)
    0.0
    """
    check_kinds(lidar, scene)
    check_kind("plan", plan, Plan, "a Plan that jaxlidar.plan made")
    # What the plan found to be flat or empty is not simulated: traced, it would lose its derivatives.
    ground = scene.ground
    if lidar.scan is not None:
        # Shots do not depend on the scan pattern: lidars with and without one share compiled programs.
        lidar = dataclasses.replace(lidar, scan=None)
    if plan.scope.flat_terrain and isinstance(ground, Terrain) and is_traced(ground.heights):
        raise ValueError(
            "the plan takes the terrain for a plane, but its heights are being traced by a JAX "
            'transformation; make the plan with effects={"relief": True}'
        )
    for name in plan.scope.empty_materials:
        if scene.canopy is not None and is_traced(getattr(scene.canopy.voxels, name)):
            raise ValueError(
                f"the plan is for a map whose {name} is zero everywhere, but {name} is being traced by a JAX "
                f'transformation; make the plan with effects={{"{name}": True}}'
            )
    if plan.scope.unreached_meshes and has_tracers(scene.meshes):
        raise ValueError(
            "the plan leaves out meshes that no ray meets, but they are being traced by a JAX "
            'transformation; make the plan with effects={"meshes": True}'
        )
    # A traced value cannot raise an error. NaN in all waveforms cannot be overlooked, and costs one product.
    admissible, covered = jnp.ones(()), jnp.asarray(True)
    if has_tracers((lidar, scene, plan)):
        admissible = jnp.where(inadmissible((lidar, scene)), jnp.nan, admissible)
        covered = is_covered(plan, lidar, scene)
    return Setup(*without_effects(*move_aim_to_origin(lidar, scene), plan.off), plan, admissible, covered)
