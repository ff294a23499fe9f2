"""A check that a plan made earlier fits a lidar and a scene."""

from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.effects import without
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.scatterers import scene_optics, spell
from jaxlidar.scenes.scene import Scene


def check_plan(plan: Plan, lidar: Lidar, scene: Scene) -> None:
    """Refuse a plan that would miss parts of the scene.

    **Raises:** ValueError where the scene reaches higher than the plan's rays start, or has scatterers that
    the plan does not know.
    """
    lidar, scene = without(lidar, scene, plan.off)
    top = -0.5 * PathLengths(lidar, scene).first
    if top > plan.trace.upstream:
        raise ValueError(
            f"plan starts {plan.trace.upstream:g} m before the reference plane; admissible for this scene "
            f"is more than {top:g} m: make the plan for the scene that reaches highest"
        )
    missing = set(spell(scene_optics(lidar, scene)).letters) - set(plan.trace.letters)
    if missing:
        raise ValueError(
            f"plan has {', '.join(plan.trace.letters) or 'no scatterers'}; admissible for this scene is one "
            f"that also has {', '.join(sorted(missing))}: make the plan with it"
        )
