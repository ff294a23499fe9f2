"""Unknowns that change extinction alone: which they are, and a fit's Jacobian without tangents.

The Jacobian of a model whose columns of extinction are scored is compared with that of the same model where
they are pushed through the trace as tangents, on the same keys: they differ in rounding alone.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.fit import extinction
from inversion.fit.model import Model
from inversion.fit.unknowns import settle

KEY = jax.random.key(7)
LIDAR = jl.Lidar(wavelength=(532.0, 1064.0), divergence=2.0)
LAYERS = 6
LEAF = np.random.default_rng(2).uniform(0.0, 1.0, (4, 4, LAYERS))


def scene_with(**canopy):
    voxels = jl.VoxelMap.from_extinction(leaf=LEAF, bark=0.2 * LEAF, voxel_size=0.5, origin=(-1.0, -1.0, 1.0))
    given = {"leaf": jl.Prospect(), "bark": 0.3, **canopy}
    return jl.Scene(canopy=jl.Canopy(voxels, **given), ground=jl.Ground(reflectance=0.4, slope=5.0))


def scale_layers(scene, share):
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda k: k * share[None, None])


def scale_all(scene, share):
    where = lambda s: (s.canopy.voxels.leaf, s.canopy.voxels.bark)  # noqa: E731
    return eqx.tree_at(where, scene, replace_fn=lambda k: k * share)


def scale_area_and_pigment(scene, share):
    return eqx.tree_at(lambda s: s.canopy.leaf.Cab, scale_all(scene, share), 40.0 * share)


LAYER_SHARES = inversion.Unknown(
    apply=scale_layers, name="layers", bounds=(0.1, 4.0), start=np.linspace(0.8, 1.2, LAYERS)
)
FACTOR = inversion.Unknown(apply=scale_all, name="factor", bounds=(0.1, 4.0), start=1.1)
BOTH = inversion.Unknown(apply=scale_area_and_pigment, name="both", bounds=(0.1, 4.0), start=1.1)
# One of them between the others, so that columns have to be sorted.
UNKNOWNS = [
    inversion.Unknown("canopy.leaf.Cab", bounds=(5.0, 100.0)),
    LAYER_SHARES,
    inversion.Unknown("ground.height", bounds=(-1.0, 0.5)),
    FACTOR,
    inversion.Unknown("ground.reflectance", bounds=(0.1, 0.9)),
]


def model_of(scene, unknowns=UNKNOWNS, lidar=LIDAR, orders=3, **given):
    settled = settle(unknowns, scene)
    sizes = {"n_photons": 256, "n_rays": 64, "window": (-60.0, 60.0), "describe": False}
    plan = jl.plan(lidar, scene, max_orders=orders, **sizes)
    plan = dataclasses.replace(plan, **given)
    return Model(lidar, scene, plan, settled, KEY), np.concatenate([np.ravel(s.start) for s in settled])


def kinds(model):
    return [place.kind for place in model.problem.places]


@pytest.mark.parametrize("few", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_jacobians_are_the_same_as_with_tangents(monkeypatch, precision, few):
    """With voxels that have the numbers of the two columns which move them, and with slopes in all."""
    monkeypatch.setattr(extinction, "FEW", few)
    model, start = model_of(scene_with())
    assert kinds(model) == ["optical", "extinction", "geometric", "extinction", "optical"]
    assert (model.problem.most, model.problem.at_once) == (2 if few == 4 else LAYERS + 1, 1)
    monkeypatch.setattr(extinction, "COLUMNS", 1)
    other, _ = model_of(scene_with())
    assert kinds(other) == ["optical", "geometric", "geometric", "geometric", "optical"]
    assert other.problem.at_once == LAYERS + 2
    scored, pushed = model(start), other(start)
    scale = np.abs(pushed.jacobian).max(axis=(0, 1))
    assert scale.min() > 0
    rtol = 2e-5 if precision == "float32" else 1e-12
    assert np.max(np.abs(scored.jacobian - pushed.jacobian) / scale) < rtol
    np.testing.assert_allclose(scored.total, pushed.total, rtol=rtol, atol=rtol * pushed.total.max())


def test_what_changes_optics_or_places_as_well_is_geometric():
    assert kinds(model_of(scene_with(), [BOTH])[0]) == ["geometric"]
    assert kinds(model_of(scene_with(), [FACTOR])[0]) == ["extinction"]


def test_where_scores_do_not_serve_columns_are_pushed():
    """Leaves that transmit straight on, many wavelengths, one column off nadir, little memory."""
    assert kinds(model_of(scene_with(transmission="straight"), [FACTOR])[0]) == ["geometric"]
    many = jl.Lidar(wavelength=np.linspace(500.0, 900.0, 17))
    assert kinds(model_of(scene_with(), [FACTOR], many, orders=1)[0]) == ["geometric"]
    slant = jl.Lidar(zenith=10.0)
    assert kinds(model_of(scene_with(), [FACTOR], slant)[0]) == ["geometric"]
    assert kinds(model_of(scene_with(), [LAYER_SHARES], slant)[0]) == ["extinction"]
    settled = settle([LAYER_SHARES], scene_with())
    plan = model_of(scene_with(), [LAYER_SHARES])[0].problem.plan
    room = extinction.sorted_places(LIDAR, scene_with(), plan, settled)[2]
    assert room > 0
    for share, kind in ((2.1, "extinction"), (1.9, "geometric")):
        scope = plan.scope._replace(max_memory=1e-9 * share * room)
        limited = dataclasses.replace(plan, scope=scope)
        places, _, _ = extinction.sorted_places(LIDAR, scene_with(), limited, settled)
        assert [place.kind for place in places] == [kind]


def test_voxels_that_other_unknowns_move_into_several_layers_have_all_slopes(monkeypatch):
    """At the start each voxel lies in one layer of the profile; with the ground at other heights, in two."""
    monkeypatch.setattr(extinction, "FEW", 1)
    voxels = jl.VoxelMap.from_lad(np.full((1, 1, 10), 0.5), voxel_size=1.0, origin=(-0.5, -0.5, -2.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4))
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))
    height = inversion.Unknown("ground.height", bounds=(-1.0, 1.0))
    profile = inversion.Unknown(
        apply=inversion.put_profile, name="profile", bounds=(0.01, 2.0), start=np.full(5, 0.5)
    )
    for unknowns, most in (([profile], 1), ([height, profile], 2)):
        assert extinction._most(scene, settle(unknowns, scene), [len(unknowns) - 1]) == most


@pytest.mark.slow
def test_layers_are_retrieved():
    """A fit through scores finds the shares that a waveform without noise was simulated with."""
    scene = scene_with()
    truth = scale_layers(scene, jnp.linspace(0.7, 1.3, LAYERS))
    wave = jl.simulate(LIDAR, truth, key=jax.random.key(1), max_orders=1)
    fit = inversion.retrieve(
        wave, LIDAR, scene, [LAYER_SHARES], noise=1e-5, key=KEY, max_orders=1, n_rays=8192
    )
    np.testing.assert_allclose(fit.values["layers"], np.linspace(0.7, 1.3, LAYERS), atol=0.05)
