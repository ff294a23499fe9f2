"""The effects that a plan lists, and the removal of those that are switched off from a lidar and a scene.

An effect is a material ("leaf"), a property ("hot spot") or a process ("multiple scattering") that can be
left out of a simulation. "slope spread" is the slope-induced pulse broadening: a sloping ground spreads its
return over the range of heights within the footprint. Most effects are left out by simulating another lidar
or scene, in which the effect is absent, so that the tracer needs no switches.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from jaxlidar._fields.checks import concrete, concrete_number
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import Plane
from jaxlidar.scenes.surfaces import AbstractGround, Ground
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import Lidar

# In the order of the table. Each can be switched off.
EFFECT_NAMES = (
    "leaf",
    "bark",
    "plates",
    "meshes",
    "ground",
    "relief",
    "slope spread",
    "multiple scattering",
    "specular return",
    "divergence",
    "field of view",
    "hot spot",
    "atmospheric extinction",
    "atmospheric backscatter",
    "jitter",
)


@dataclasses.dataclass(frozen=True)
class Effect:
    """One row of a plan's table: an effect, whether it is simulated, why, and a bound on what it changes.

    - `name`: of the effect, as in the first column of the printed plan.
    - `simulated`: True if it is simulated.
    - `reason`: why, in words.
    - `bound`: the most that leaving the effect out changes, in terms of `measure`, in [0, 1]: for the worst
      wavelength, everything else as planned, over a window that covers the scene. For an effect that is
      simulated it says how large the effect may be. It is 1, which always holds, where no better bound is
      simple.
    - `measure`: how waveforms with and without the effect are compared. "sum": difference of the sums over
      all samples, relative to the larger sum. "samples": sum of the absolute differences of samples, relative
      to the sum of the two sums; where these are equal, the fraction of the energy that moves between
      samples.

    **Example:**

    >>> import jaxlidar as jl
    >>> plan = jl.plan(jl.Lidar(), jl.Scene(ground=jl.Ground(slope=10.0)))
    >>> spread = {effect.name: effect for effect in plan.effects}["slope spread"]
    >>> print(spread.simulated, f"{spread.bound:.2f}", spread.measure)
    True 0.02 samples
    """

    name: str
    simulated: bool
    reason: str
    bound: float
    measure: str


def consists_of_planes(scene: Scene) -> bool:
    """Return True if the scene has no canopy and all its surfaces are infinite, uniform planes."""
    return scene.canopy is None and surfaces_are_planes(scene)


def has_smooth_footprint(lidar: Lidar) -> bool:
    """Return True if what is seen of the footprint is smooth but for circles, as `product_rule` needs."""
    return lidar.level_divergence is None or lidar.field_of_view is None


def surfaces_are_planes(scene: Scene) -> bool:
    """Return True if all surfaces of the scene are infinite planes with the same optics everywhere."""
    return all(isinstance(s.shape, Plane) and s.pattern is None for s in scene.surfaces)


def is_plane_terrain(ground: AbstractGround | None) -> bool:
    """Return True if the ground is terrain whose heights, which must be concrete, lie in a plane."""
    return isinstance(ground, Terrain) and ground.relief and ground.is_plane()


def replace_plane_terrain(lidar: Lidar, scene: Scene, effects: Mapping[str, bool] | None) -> Scene:
    """Return the scene with terrain that lies in a plane as a plane, unless `effects` asks for relief."""
    # A plane is met in closed form; the search for a ray's first crossing of a height field is not needed.
    ground = scene.ground
    if not is_plane_terrain(ground) or (effects or {}).get("relief") is True:
        return scene
    # Footprints of a lidar with an altitude lie on the terrain. A sensor sees past its border, where a plane
    # would go on.
    if lidar.has_sensor_position and isinstance(ground, Terrain) and ground.sides == "open":
        return scene
    return without_relief(scene)


def find_empty_materials(scene: Scene, effects: Mapping[str, bool] | None = None) -> tuple[str, ...]:
    """Return those of "leaf" and "bark" whose extinction is zero everywhere, unless `effects` asks for them.

    A map that a JAX transformation traces never counts as empty: it may have derivatives where it is zero.
    """
    if scene.canopy is None:
        return ()
    effects = effects or {}
    empty = []
    for name in ("leaf", "bark"):
        extinction = concrete(getattr(scene.canopy.voxels, name))
        if extinction is not None and not extinction.any() and effects.get(name) is not True:
            empty.append(name)
    return tuple(empty)


def effects_of_family(scenes: Sequence[Scene]) -> dict[str, bool]:
    """Return the effects to ask for in a plan of several scenes of one structure: name and True.

    What is zero in one of them may not be in another: a material that is absent from one, and the relief of
    terrain that is a plane in one, where its heights change. Their arrays are concrete.
    """
    names = {name for scene in scenes for name in find_empty_materials(scene)}
    terrains = [scene.ground for scene in scenes if isinstance(scene.ground, Terrain)]
    change = any(not np.array_equal(t.heights, terrains[0].heights) for t in terrains)
    if change and any(is_plane_terrain(t) for t in terrains):
        names.add("relief")
    return dict.fromkeys(sorted(names), True)


def without_relief(scene: Scene) -> Scene:
    """Return the scene with its terrain, if it has one, as a plane."""
    ground = scene.ground
    if not isinstance(ground, Terrain) or not ground.relief:
        return scene
    return dataclasses.replace(scene, ground=ground.without_relief())


def allows_interreflection(scene: Scene) -> bool:
    """Return True if scattered light can meet the scene again (interreflection); a single plane's cannot."""
    surfaces = scene.surfaces
    return scene.canopy is not None or len(surfaces) > 1 or any(s.shape.lights_itself for s in surfaces)


def present_effects(lidar: Lidar, scene: Scene) -> dict[str, bool]:
    """Return, for each effect of `EFFECT_NAMES`, True if the lidar and the scene have it."""
    canopy, air, ground = scene.canopy, scene.atmosphere, scene.ground
    return {
        "leaf": canopy is not None and canopy.voxels.leaf is not None,
        "bark": canopy is not None and canopy.voxels.bark is not None,
        "plates": bool(scene.plates),
        "meshes": bool(scene.meshes),
        "ground": scene.ground is not None,
        "relief": isinstance(ground, Terrain) and ground.relief,
        "slope spread": isinstance(ground, Ground) and concrete_number(ground.slope) > 0,
        "multiple scattering": allows_interreflection(scene),
        "specular return": any(isinstance(s.law, AbstractMirror) for s in scene.surfaces),
        "divergence": concrete_number(lidar.divergence) > 0,
        "field of view": lidar.field_of_view is not None,
        "hot spot": canopy is not None and canopy.hotspot,
        "atmospheric extinction": air is not None,
        "atmospheric backscatter": air is not None and air.lidar_ratio is not None,
        "jitter": concrete_number(lidar.jitter) > 0,
    }


def switched_off_effects(
    effects: Mapping[str, bool] | None, present: Mapping[str, bool], max_orders: int | None
) -> tuple[str, ...]:
    """Return the names of the effects that are present and that `effects` switches off.

    **Arguments:**

    - `effects`: the user's switches, by name.
    - `present`: for each effect, True if the lidar and the scene have it (`present_effects`).
    - `max_orders`: the user's number of orders of scattering, or None.

    **Raises:** ValueError for names or values that are inadmissible, and where `effects` switches on what is
    not in the scene or contradicts itself or `max_orders`.
    """
    effects = effects or {}
    for name, value in effects.items():
        if name not in EFFECT_NAMES:
            raise ValueError(f"effects: {name!r} is none of {', '.join(map(repr, EFFECT_NAMES))}")
        if value is not True and value is not False:
            raise ValueError(f"effects[{name!r}] = {value!r}; admissible is True or False")
        if value and not present[name]:
            available = ", ".join(repr(n) for n in EFFECT_NAMES if present[n]) or "none"
            raise ValueError(
                f"effects[{name!r}] = True, but it is not in the scene; admissible to switch on: {available}"
            )
    orders = effects.get("multiple scattering")
    if max_orders is not None and orders is not None and orders != (max_orders > 1):
        raise ValueError(
            f"effects['multiple scattering'] = {orders}, but max_orders = {max_orders}; they must agree"
        )
    off = tuple(name for name in EFFECT_NAMES if present[name] and effects.get(name) is False)
    # An effect cannot be asked for without what it is an effect of. With several names, any of them will do.
    for name, carriers in (
        ("atmospheric backscatter", ("atmospheric extinction",)),
        ("relief", ("ground",)),
        ("slope spread", ("ground",)),
        ("hot spot", ("leaf", "bark")),
    ):
        present_carriers = [n for n in carriers if present[n]]
        if effects.get(name) and all(n in off for n in present_carriers):
            raise ValueError(
                f"effects[{name!r}] = True, but {' and '.join(map(repr, present_carriers))} = False; "
                "admissible with it is True"
            )
    return off


def without_effects(lidar: Lidar, scene: Scene, off: tuple[str, ...]) -> tuple[Lidar, Scene]:
    """Return the lidar and the scene without the effects named in `off`.

    Applied twice, it changes nothing more.
    Without its extinction the air is removed, and its backscatter with it. "multiple scattering" and
    "specular return" belong neither to the lidar nor to the scene: the plan's orders and the tracer leave
    them out.
    """
    if not off:
        return lidar, scene
    if "divergence" in off:
        no_width = {"divergence": jnp.zeros_like(lidar.divergence), "level_divergence": None}
        lidar = dataclasses.replace(lidar, **no_width)
    if "field of view" in off:
        lidar = dataclasses.replace(lidar, field_of_view=None)
    if "jitter" in off:
        lidar = dataclasses.replace(lidar, jitter=jnp.zeros_like(lidar.jitter))
    canopy, ground, air = scene.canopy, scene.ground, scene.atmosphere
    if canopy is not None:
        canopy = _canopy_without_effects(canopy, off)
    if "relief" in off:
        ground = without_relief(scene).ground
    if isinstance(ground, Ground) and "slope spread" in off:
        ground = _level_ground(ground, lidar)
    if air is not None and "atmospheric backscatter" in off:
        air = dataclasses.replace(air, lidar_ratio=None)
    return lidar, dataclasses.replace(
        scene,
        canopy=canopy,
        plates=() if "plates" in off else scene.plates,
        meshes=() if "meshes" in off else scene.meshes,
        ground=None if "ground" in off else ground,
        atmosphere=None if "atmospheric extinction" in off else air,
    )


def _canopy_without_effects(canopy: Canopy, off: tuple[str, ...]) -> Canopy | None:
    """Return the canopy without its effects in `off`; None if neither leaf nor bark remains."""
    leaf = None if "leaf" in off else canopy.voxels.leaf
    bark = None if "bark" in off else canopy.voxels.bark
    if leaf is None and bark is None:
        return None
    return dataclasses.replace(
        canopy,
        voxels=dataclasses.replace(
            canopy.voxels,
            leaf=leaf,
            bark=bark,
            leaf_angles=None if leaf is None else canopy.voxels.leaf_angles,
        ),
        leaf=None if leaf is None else canopy.leaf,
        bark=None if bark is None else canopy.bark,
        hotspot=canopy.hotspot and "hot spot" not in off,
    )


def _level_ground(ground: Ground, lidar: Lidar) -> Ground:
    """Return level ground through the point where the beam axis meets the sloping plane.

    With the plane's upward normal n, its height h at the origin, the aim point p and the axis d, the axis
    p + t d meets the plane n . x = n_z h at t = (n_z h - n . p) / (n . d), where its height is t d_z. Without
    the slope the delay of the axis is then unchanged, and the waveforms differ by the spread alone.
    """
    normal, axis = ground.shape.upward, lidar.direction
    aim = lidar.aim_point
    normal_distance = normal[2] * ground.height - jnp.sum(normal * aim)
    normal_cosine = jnp.sum(normal * axis)
    # A beam that runs along the slope, or comes from beneath, does not meet it: the height stays. The divisor
    # is replaced there so that derivatives stay finite.
    meets = normal_cosine < -1e-6
    axis_height = aim[2] + normal_distance / jnp.where(meets, normal_cosine, -1.0) * axis[2]
    height = jnp.where(meets, axis_height, ground.height)
    return dataclasses.replace(ground, height=height, slope=jnp.zeros_like(ground.slope))
