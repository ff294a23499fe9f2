"""A plan serves a lidar and a scene, or is refused with numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning.plan_check import check_plan

KEY = jax.random.key(0)
LEAF = jl.LeafOptics(0.4, 0.3)


def stand(extinction=0.1, height=6.0, size=1.0, base=0.0, **canopy_fields):
    shape = (8, 8, round(height / size))
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.full(shape, extinction), voxel_size=size, origin=(-4 * size, -4 * size, base)
    )
    return jl.Canopy(voxels, leaf=canopy_fields.pop("leaf", LEAF), **{"hotspot": False, **canopy_fields})


LIDAR = jl.Lidar(divergence=0.3)
SCENE = jl.Scene(canopy=stand(sides="periodic"), ground=jl.Ground(reflectance=0.3))
PLANES = jl.Scene(
    plates=(jl.Plate(3.0, 0.3, 0.3), jl.Plate(5.0, 0.2, coverage=0.5)), ground=jl.Ground(reflectance=0.3)
)


def canopy(**changes):
    return dataclasses.replace(SCENE, canopy=stand(**({"sides": "periodic"} | changes)))


def narrower(width):
    """Return the scene with voxels of another width and the same height."""
    assert SCENE.canopy is not None
    voxels = SCENE.canopy.voxels
    size = np.array([width, width, voxels.voxel_size[2]])
    return dataclasses.replace(
        SCENE, canopy=dataclasses.replace(SCENE.canopy, voxels=dataclasses.replace(voxels, voxel_size=size))
    )


def ground(**changes):
    return dataclasses.replace(SCENE, ground=jl.Ground(**({"reflectance": 0.3} | changes)))


def planes(first=PLANES.plates[0], second=PLANES.plates[1], **changes):
    return dataclasses.replace(PLANES, plates=(first, second), **changes)


def lidar(**changes):
    return jl.Lidar(**({"divergence": 0.3} | changes))


# Lidars and scenes that differ from those of the plan, and the message.
MISFITS = {
    "ground below": (LIDAR, ground(height=-60.0), r"covers returns .* the scene has .* to 400"),
    "canopy above": (LIDAR, canopy(base=2.0), "rays start 6.301 m .*; the scene reaches to 8 m"),
    "smaller voxels": (LIDAR, canopy(size=0.25), "segments of a ray; the scene may have"),
    "narrower voxels": (LIDAR, narrower(0.1), "voxels along a flight; the scene may have"),
    "brighter leaves": (LIDAR, canopy(leaf=jl.LeafOptics(0.5, 0.49)), "orders, for albedos up to 0.7"),
    "hot spot": (LIDAR, canopy(hotspot=True), "has hotspot = False; the canopy has hotspot = True"),
    "no ground": (LIDAR, dataclasses.replace(SCENE, ground=None), r"has leaf, ground; the scene has leaf"),
    "a plate more": (LIDAR, dataclasses.replace(SCENE, plates=PLANES.plates), r"also has plate 1\.R"),
    "straight leaves": (LIDAR, canopy(transmission="straight"), r"has leaf\.T; .* is not scattered"),
    "narrow pulse": (lidar(pulse=jl.GaussianPulse(1.0)), SCENE, "features of 2.55 ns; .* of 0.425 ns"),
    "long pulse": (
        lidar(pulse=jl.GaussianPulse(9.0)),
        SCENE,
        "for a pulse from .* to 14.01 ns; the lidar's lasts from .* to 21.02 ns",
    ),
    "jitter": (lidar(jitter=4.0), SCENE, "for a pulse from"),
    "other samples": (lidar(sampling_interval=0.5), SCENE, "samples of 1 ns; sampling_interval = 0.5"),
    "oblique beam": (lidar(zenith=20.0), SCENE, "for a beam at nadir; zenith = 20"),
    "wide beam": (lidar(divergence=30.0, altitude=300.0), ground(slope=30.0), "its rays start"),
}


@pytest.mark.parametrize("name", list(MISFITS))
def test_a_plan_that_does_not_fit_is_refused_with_numbers(name):
    other_lidar, other_scene, message = MISFITS[name]
    plan = jl.plan(LIDAR, SCENE, describe=False)
    with pytest.raises(ValueError, match=f"the plan does not fit: .*{message}"):
        jl.simulate(other_lidar, other_scene, key=KEY, plan=plan)


PLANE_MISFITS = {
    "a plate lost": (dataclasses.replace(PLANES, plates=PLANES.plates[:1]), "plate"),
    "a canopy": (dataclasses.replace(PLANES, canopy=SCENE.canopy), r"also has leaf\.R"),
    "gaps": (planes(first=jl.Plate(3.0, 0.3, 0.3, coverage=0.5)), "cover everything; the scene's have gaps"),
    "transmitted light": (planes(second=jl.Plate(5.0, 0.2, 0.2, coverage=0.5)), r"also has plate 2\.T"),
    "a mirror": (planes(ground=jl.Ground(law=jl.Specular(0.1))), "which are mirrors"),
}


@pytest.mark.parametrize("name", list(PLANE_MISFITS))
def test_a_plan_of_planes_that_does_not_fit_is_refused(name):
    scene, message = PLANE_MISFITS[name]
    with pytest.raises(ValueError, match=f"the plan does not fit: .*{message}"):
        check_plan(jl.plan(LIDAR, PLANES, max_orders=3, describe=False), LIDAR, scene)


def test_a_plan_serves_its_scene_and_smaller_ones():
    plan = jl.plan(LIDAR, SCENE, describe=False)
    served = [
        (LIDAR, SCENE),
        (lidar(wavelength=(532.0, 1064.0), energy=1.0, altitude=1010.0), SCENE),
        (LIDAR, ground(reflectance=0.1, aspect=90.0)),
        (LIDAR, canopy(extinction=2.0)),
        (LIDAR, canopy(leaf=jl.LeafOptics(0.1, 0.0))),
        (lidar(position=(3.0, -2.0)), SCENE),
        (lidar(divergence=0.1), SCENE),
        (lidar(pulse=jl.ExponentiallyModifiedGaussianPulse(6.0, 0.1)), SCENE),
    ]
    for other_lidar, other_scene in served[:-1]:
        check_plan(plan, other_lidar, other_scene)
    with pytest.raises(ValueError, match="for a pulse from"):
        check_plan(plan, *served[-1])


def test_switched_off_effects_may_differ():
    off = {"multiple scattering": False, "slope spread": False}
    plan = jl.plan(LIDAR, SCENE, effects=off, describe=False)
    check_plan(plan, LIDAR, ground(slope=20.0))
    check_plan(plan, LIDAR, canopy(leaf=jl.LeafOptics(0.5, 0.5)))


def test_a_window_of_the_user_may_leave_light_out():
    plan = jl.plan(LIDAR, SCENE, window=(-20.0, 5.0), describe=False)
    check_plan(plan, LIDAR, SCENE)
    with pytest.raises(ValueError, match="covers returns"):
        check_plan(plan, LIDAR, ground(height=-80.0))


def test_a_plan_together_with_its_arguments_is_refused():
    plan = jl.plan(LIDAR, SCENE, describe=False)
    with pytest.raises(ValueError, match="plan is given together with max_orders, window"):
        jl.simulate(LIDAR, SCENE, key=KEY, plan=plan, max_orders=2, window=(0.0, 5.0))


def test_light_outside_the_bins_is_reported_as_lost_under_a_transformation():
    """A plan for ground at 0 m serves ground neither at -1 m nor at -20 m."""
    flat = jl.Scene(ground=jl.Ground(reflectance=0.4))
    plan = jl.plan(LIDAR, flat, describe=False)

    @jax.jit
    @jax.vmap
    def waves(height):
        scene = eqx.tree_at(lambda s: s.ground.height, flat, height)
        return jl.simulate(LIDAR, scene, key=KEY, plan=plan)

    mapped = waves(jnp.array([0.0, -1.0, -20.0]))
    np.testing.assert_allclose(mapped.lost[:, 0], [0.0, 1.0, 1.0], atol=1e-5)
    for name, fraction in mapped.energy_budget.items():
        assert np.isfinite(fraction).all(), name
    np.testing.assert_allclose(sum(mapped.energy_budget.values()), 1.0, atol=1e-5)
    marked = jax.vmap(lambda wave: wave.nan_where_lost())(mapped)
    assert np.isnan(marked.reflectance).all(axis=(1, 2)).tolist() == [False, True, True]
    np.testing.assert_array_equal(marked.reflectance[0], mapped.reflectance[0])
    with pytest.raises(ValueError, match="share = 0"):
        mapped.nan_where_lost(0.0)


def with_bark(extinction):
    bark = np.full((4, 4, 4), extinction)
    voxels = jl.VoxelMap.from_extinction(leaf=np.full((4, 4, 4), 0.3), bark=bark, voxel_size=1.0)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=LEAF, bark=0.3, hotspot=False), ground=jl.Ground(reflectance=0.3)
    )


def test_a_material_of_zero_extinction_is_not_in_the_scene():
    without_bark, with_little_bark = with_bark(0.0), with_bark(1e-3)
    plan = jl.plan(LIDAR, without_bark)
    assert {row.name: row.reason for row in plan.effects}["bark"] == "zero everywhere"
    assert plan.config.channels == ("leaf.R", "leaf.T", "ground.R")
    assert jl.make_setup(LIDAR, without_bark, plan).scene.canopy.voxels.bark is None
    plan_with_bark = jl.plan(LIDAR, without_bark, effects={"bark": True}, describe=False)
    assert "bark.R" in plan_with_bark.config.channels
    assert "bark" not in plan_with_bark.off
    check_plan(plan_with_bark, LIDAR, with_little_bark)
    with pytest.raises(ValueError, match="for a map without bark"):
        check_plan(plan, LIDAR, with_little_bark)
    with pytest.raises(ValueError, match=r'make the plan with effects={"bark": True}'):
        eqx.filter_eval_shape(lambda scene: jl.make_setup(LIDAR, scene, plan).admissible, without_bark)


def test_a_map_of_zeros_is_no_canopy():
    zeros = jl.VoxelMap.from_extinction(leaf=np.zeros((4, 4, 4)), voxel_size=1.0)
    ground = jl.Ground(reflectance=0.3)
    plan = jl.plan(
        LIDAR, jl.Scene(canopy=jl.Canopy(zeros, leaf=LEAF, hotspot=False), ground=ground), describe=False
    )
    assert plan.orders == 1
    assert not plan.is_random
