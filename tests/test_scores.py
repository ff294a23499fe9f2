"""Derivatives by extinction: scores of paths give what forward derivatives of the whole trace give."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import inversion.model
import jaxlidar as jl
from jaxlidar.trace import extinction
from jaxlidar.trace.extinction import can_be_scored, most_columns, slopes_of, total_and_columns

SHAPE = (4, 5, 6)
DENSITY = np.random.default_rng(0).uniform(0.05, 0.6, SHAPE)
LEAF = jl.LeafOptics(reflectance=(0.1, 0.45), transmittance=(0.05, 0.4))
LIDAR = jl.Lidar(wavelength=(660.0, 1064.0), divergence=4.0)
GROUND = jl.Ground(reflectance=0.3, slope=8.0, aspect=30.0)

# Keywords of the canopy, the rest of the scene, and the lidar.
SCENES = {
    "leaf over ground": ({}, {"ground": GROUND}, LIDAR),
    "hot spot": ({"hotspot": True}, {"ground": GROUND}, LIDAR),
    "periodic": ({"sides": "periodic"}, {"ground": GROUND}, LIDAR),
    "isotropic": ({"leaf": jl.Isotropic(albedo=0.9)}, {"ground": GROUND}, LIDAR),
    "no ground": ({}, {}, LIDAR),
    "air": ({}, {"ground": GROUND, "atmosphere": jl.Atmosphere()}, LIDAR),
    "plate": ({}, {"ground": GROUND, "plates": (jl.Plate(2.5, 0.3, 0.2, coverage=0.5),)}, LIDAR),
    "off nadir, field of view": (
        {},
        {"ground": GROUND},
        jl.Lidar(wavelength=(660.0, 1064.0), divergence=4.0, zenith=20.0, field_of_view=5.0),
    ),
}


def by_layer(voxels, values):
    """Layers of two levels each."""
    return eqx.tree_at(lambda v: v.leaf, voxels, voxels.leaf * jnp.repeat(values, 2)[None, None])


def by_factor(voxels, values):
    """All of leaf, and all of bark."""
    leaf, bark = voxels.leaf * values[0], None if voxels.bark is None else voxels.bark * values[-1]
    return dataclasses.replace(voxels, leaf=leaf, bark=bark)


def by_group(voxels, values):
    """Groups that overlap."""
    group = jnp.asarray(np.indices(SHAPE)[0] < 2, values.dtype)
    return eqx.tree_at(lambda v: v.leaf, voxels, voxels.leaf * (values[0] + values[1] * group))


CHANGES = {"layers": (by_layer, 3, 1), "factors": (by_factor, 2, 2), "groups": (by_group, 2, 2)}


def setups(name, change, *, bark=False, angles="spherical"):
    """The setup as a function of the values, and their start."""
    canopy, rest, lidar = SCENES[name]
    apply, count, most = CHANGES[change]
    given = {"voxel_size": 1.0, "origin": (-2.0, -2.5, 1.0)}
    if bark:
        voxels = jl.VoxelMap.from_extinction(leaf=DENSITY, bark=0.2 * DENSITY[::-1], **given)
    else:
        voxels = jl.VoxelMap.from_lad(2.0 * DENSITY, leaf_angles=angles, **given)

    def scene(values):
        return jl.Scene(
            canopy=jl.Canopy(apply(voxels, values), **{"leaf": LEAF, "bark": 0.4, **canopy}), **rest
        )

    start = jnp.linspace(0.8, 1.1, count)
    plan = jl.plan(lidar, scene(start), max_orders=4, n_photons=300, n_rays=40, window=(-60.0, 40.0))
    return (lambda values: jl.reduce(lidar, scene(values), plan)), start, most


def forward(setup_at, start, key):
    """Total and derivatives by tangents through everything."""

    def total(values):
        setup = setup_at(values)
        return jl.total_of(jl.trace_scene(setup, key, reverse=False), setup)

    value, push = jax.linearize(total, start)
    return value, jax.vmap(push)(jnp.eye(start.size, dtype=start.dtype))


def differences(setup_at, start, most):
    """Of total and derivatives, relative to the largest."""
    key = jax.random.key(3)
    value, columns = eqx.filter_jit(forward)(setup_at, start, key)
    _, total, scored = eqx.filter_jit(total_and_columns)(setup_at, start, key, most)
    assert scored.shape == columns.shape
    assert float(jnp.max(jnp.abs(columns))) > 0
    return tuple(
        float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(a))) for a, b in ((value, total), (columns, scored))
    )


# By default; all others take a minute.
QUICK = ("leaf over ground", "plate", "off nadir, field of view")


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in SCENES]
)
def test_scores_are_forward_derivatives(name):
    value, columns = differences(*setups(name, "layers"))
    assert value < 1e-6
    assert columns < 2e-5


@pytest.mark.parametrize("change", ["factors", "groups"])
def test_columns_that_share_voxels(change):
    assert max(differences(*setups("leaf over ground", change, bark=change == "factors"))) < 2e-5


def test_leaf_angles():
    assert max(differences(*setups("leaf over ground", "layers", angles="planophile"))) < 2e-5


def test_in_double_precision():
    with jax.enable_x64(True):
        assert max(differences(*setups("leaf over ground", "layers"))) < 1e-12


def test_scores_without_the_way_back_are_refused(monkeypatch):
    real = extinction.scores_of

    def planted(*args):
        scores = real(*args)
        return eqx.tree_at(lambda s: s.column, scores, jnp.zeros_like(scores.column))

    monkeypatch.setattr(extinction, "scores_of", planted)
    assert differences(*setups("leaf over ground", "layers"))[1] > 1e-3


def test_more_columns_than_told_are_not_a_number():
    setup_at, start, _ = setups("leaf over ground", "groups")
    slopes = slopes_of(setup_at, start)
    assert int(most_columns(slopes)) == 2
    _, total, columns = total_and_columns(setup_at, start, jax.random.key(0), 1)
    assert np.all(np.isfinite(total))
    assert not np.all(np.isfinite(columns))


def test_what_cannot_be_scored():
    setup_at, start, _ = setups("leaf over ground", "layers")
    assert can_be_scored(setup_at(start))
    lidar, scene = jl.Lidar(), jl.Scene(ground=GROUND)
    assert not can_be_scored(jl.reduce(lidar, scene, jl.plan(lidar, scene)))


def layers(scene, values):
    return eqx.tree_at(lambda s: s.canopy.voxels, scene, by_layer(scene.canopy.voxels, values))


def test_fits_score_what_changes_extinction_alone(monkeypatch):
    canopy = jl.Canopy(
        jl.VoxelMap.from_lad(DENSITY, voxel_size=1.0, origin=(-2.0, -2.5, 1.0)), leaf=LEAF, hotspot=True
    )
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))
    plan = jl.plan(LIDAR, scene, max_orders=3, n_photons=500, n_rays=64, window=(-60.0, 40.0))
    area = inversion.Unknown(apply=layers, name="area", bounds=(0.2, 3.0), start=np.array([1.0, 1.2, 0.9]))
    height = inversion.Unknown("ground.height", bounds=(-0.5, 0.5))
    key = jax.random.key(1)

    def evaluated(unknowns):
        settled = inversion.unknowns.settle(unknowns, scene)
        model = inversion.model.Model(LIDAR, scene, plan, settled, key)
        return model.problem.most, model(np.concatenate([np.ravel(s.start) for s in settled]).astype(float))

    most, alone = evaluated([area])
    assert most == 3
    assert evaluated([area, height])[0] == 0
    monkeypatch.setattr(inversion.model, "MOST_SCORED", 0)
    none, tangents = evaluated([area])
    assert none == 0
    np.testing.assert_allclose(alone.total, tangents.total, rtol=1e-5, atol=1e-9)
    scale = np.max(np.abs(tangents.jacobian))
    np.testing.assert_allclose(alone.jacobian, tangents.jacobian, rtol=0, atol=2e-5 * scale)
