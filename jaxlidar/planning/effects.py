"""The effects that a plan lists, and the removal of those that are switched off from a lidar and a scene."""

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp

from jaxlidar._checks import concrete, concrete_number
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.shapes import Plane
from jaxlidar.scenes.surfaces import AbstractGround, Ground
from jaxlidar.scenes.terrain import Terrain

# In the order of the table; each can be switched.
NAMES = (
    "leaf",
    "bark",
    "plates",
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
    - `simulated`: whether it is simulated.
    - `reason`: why, in words.
    - `bound`: the most that leaving the effect out changes, in terms of `measure`, in [0, 1]: for the worst
      wavelength, everything else as planned, over a window that covers the scene. For an effect that is
      simulated it says how large the effect may be. It is 1, which always holds, where no better bound is
      simple.
    - `measure`: how waveforms with and without the effect are compared. "sum": difference of the sums over
      all samples, relative to the larger sum. "samples": sum of the absolute differences of samples, relative
      to both sums together; where the sums are equal, the share of the energy that is found in other samples.

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


def only_planes(scene: Scene) -> bool:
    """Whether the scene consists of infinite planes alone, each of them the same throughout."""
    return scene.canopy is None and planes(scene)


def planes(scene: Scene) -> bool:
    """Whether all surfaces of the scene are infinite planes, each of them the same throughout."""
    return all(isinstance(s.shape, Plane) and s.pattern is None for s in scene.surfaces)


def is_flat(ground: AbstractGround | None) -> bool:
    """Whether the ground is terrain whose heights, which must be known, lie in a plane."""
    return isinstance(ground, Terrain) and ground.relief and ground.is_plane()


def flattened(scene: Scene, effects: Mapping[str, bool] | None) -> Scene:
    """The scene with flat terrain as a plane, unless `effects` asks for relief."""
    if not is_flat(scene.ground) or (effects or {}).get("relief") is True:
        return scene
    return without_relief(scene)


def empty(scene: Scene, effects: Mapping[str, bool] | None = None) -> tuple[str, ...]:
    """Which of "leaf" and "bark" are known to be zero everywhere, but for those that `effects` asks for."""
    if scene.canopy is None:
        return ()
    known = {name: concrete(getattr(scene.canopy.voxels, name)) for name in ("leaf", "bark")}
    asked = effects or {}
    return tuple(n for n, a in known.items() if a is not None and not a.any() and asked.get(n) is not True)


def without_relief(scene: Scene) -> Scene:
    """The scene with its terrain, if there is any, as a plane."""
    ground = scene.ground
    if not isinstance(ground, Terrain) or not ground.relief:
        return scene
    return dataclasses.replace(scene, ground=ground.without_relief())


def can_light_itself(scene: Scene) -> bool:
    """Whether light that is scattered in the scene can meet the scene again; that of one plane cannot."""
    surfaces = scene.surfaces
    return scene.canopy is not None or len(surfaces) > 1 or any(s.shape.lights_itself for s in surfaces)


def present(lidar: Lidar, scene: Scene) -> dict[str, bool]:
    """Whether a lidar and a scene have each effect of `NAMES`."""
    canopy, air, ground = scene.canopy, scene.atmosphere, scene.ground
    return {
        "leaf": canopy is not None and canopy.voxels.leaf is not None,
        "bark": canopy is not None and canopy.voxels.bark is not None,
        "plates": bool(scene.plates),
        "ground": scene.ground is not None,
        "relief": isinstance(ground, Terrain) and ground.relief,
        "slope spread": isinstance(ground, Ground) and concrete_number(ground.slope) > 0,
        "multiple scattering": can_light_itself(scene),
        "specular return": any(isinstance(s.law, AbstractMirror) for s in scene.surfaces),
        "divergence": concrete_number(lidar.divergence) > 0,
        "field of view": lidar.field_of_view is not None,
        "hot spot": canopy is not None and canopy.hotspot,
        "atmospheric extinction": air is not None,
        "atmospheric backscatter": air is not None and air.lidar_ratio is not None,
        "jitter": concrete_number(lidar.jitter) > 0,
    }


def switched_off(
    effects: Mapping[str, bool] | None, has: Mapping[str, bool], max_orders: int | None
) -> tuple[str, ...]:
    """Names of the effects that the lidar and the scene have and that `effects` switches off.

    **Raises:** ValueError for names or values that are inadmissible, and where `effects` switches on what is
    not in the scene or contradicts itself or `max_orders`.
    """
    effects = effects or {}
    for name, value in effects.items():
        if name not in NAMES:
            raise ValueError(f"effects: {name!r} is none of {', '.join(map(repr, NAMES))}")
        if value is not True and value is not False:
            raise ValueError(f"effects[{name!r}] = {value!r}; admissible is True or False")
        if value and not has[name]:
            there = ", ".join(repr(n) for n in NAMES if has[n]) or "none"
            raise ValueError(
                f"effects[{name!r}] = True, but it is not in the scene; admissible to switch on: {there}"
            )
    orders = effects.get("multiple scattering")
    if max_orders is not None and orders is not None and orders != (max_orders > 1):
        raise ValueError(
            f"effects['multiple scattering'] = {orders}, but max_orders = {max_orders}; they must agree"
        )
    off = tuple(name for name in NAMES if has[name] and effects.get(name) is False)
    for name, needs in (
        ("atmospheric backscatter", ("atmospheric extinction",)),
        ("relief", ("ground",)),
        ("slope spread", ("ground",)),
        ("hot spot", ("leaf", "bark")),
    ):
        needed = [n for n in needs if has[n]]
        if effects.get(name) and all(n in off for n in needed):
            raise ValueError(
                f"effects[{name!r}] = True, but {' and '.join(map(repr, needed))} = False; "
                "admissible with it is True"
            )
    return off


def without(lidar: Lidar, scene: Scene, off: tuple[str, ...]) -> tuple[Lidar, Scene]:
    """The lidar and the scene without the effects named in `off`. Applied twice, it changes nothing more.

    Without its extinction the air is removed, and its backscatter with it. "multiple scattering" and
    "specular return" belong neither to the lidar nor to the scene: the plan's orders and the tracer leave
    them out.
    """
    if not off:
        return lidar, scene
    if "divergence" in off:
        lidar = dataclasses.replace(lidar, divergence=jnp.zeros_like(lidar.divergence))
    if "field of view" in off:
        lidar = dataclasses.replace(lidar, field_of_view=None)
    if "jitter" in off:
        lidar = dataclasses.replace(lidar, jitter=jnp.zeros_like(lidar.jitter))
    canopy, ground, air = scene.canopy, scene.ground, scene.atmosphere
    if canopy is not None:
        canopy = _thinned(canopy, off)
    if "relief" in off:
        ground = without_relief(scene).ground
    if isinstance(ground, Ground) and "slope spread" in off:
        ground = _levelled(ground, lidar)
    if air is not None and "atmospheric backscatter" in off:
        air = dataclasses.replace(air, lidar_ratio=None)
    return lidar, Scene(
        canopy=canopy,
        plates=() if "plates" in off else scene.plates,
        ground=None if "ground" in off else ground,
        atmosphere=None if "atmospheric extinction" in off else air,
    )


def _thinned(canopy: Canopy, off: tuple[str, ...]) -> Canopy | None:
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


def _levelled(ground: Ground, lidar: Lidar) -> Ground:
    """Level ground through the point where the beam axis meets the slope, if it does."""
    normal, axis = ground.shape.upward, lidar.direction
    rise = normal[2] * ground.height - jnp.sum(normal[:2] * lidar.position)
    towards = jnp.sum(normal * axis)
    met = towards < -1e-6
    height = jnp.where(met, rise / jnp.where(met, towards, -1.0) * axis[2], ground.height)
    return dataclasses.replace(ground, height=height, slope=jnp.zeros_like(ground.slope))
