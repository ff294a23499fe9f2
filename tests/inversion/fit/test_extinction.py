"""Unknowns that change extinction only: their detection, and a fit's Jacobian by score functions.

The Jacobian of a model whose extinction columns come from scores is compared with that of the same model with
tangents pushed through the trace, on the same keys: they differ only by rounding.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.fit import model as fit_model
from inversion.fit.model import ForwardModel, choose_jacobian_methods, max_columns_per_voxel
from inversion.fit.unknowns import bind_unknowns, flat_start
from tests.helpers import BY_PRECISION, ask

KEY = jax.random.key(7)
LIDAR = jl.Lidar(wavelength=(532.0, 1064.0), divergence=2.0)
LAYERS = 6
LEAF = np.random.default_rng(2).uniform(0.0, 1.0, (4, 4, LAYERS))


def scene_with(**canopy):
    voxels = jl.VoxelMap.from_extinction(leaf=LEAF, bark=0.2 * LEAF, voxel_size=0.5, origin=(-1.0, -1.0, 1.0))
    canopy = {"leaf": jl.Prospect(), "bark": 0.3, "hotspot": False, **canopy}
    return jl.Scene(canopy=jl.Canopy(voxels, **canopy), ground=jl.Ground(reflectance=0.4, slope=5.0))


def scale_layers(scene, factors):
    return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda k: k * factors[None, None])


def scale_extinction(scene, factor):
    tables = lambda s: (s.canopy.voxels.leaf, s.canopy.voxels.bark)  # noqa: E731
    return eqx.tree_at(tables, scene, replace_fn=lambda k: k * factor)


def scale_extinction_and_pigment(scene, factor):
    return eqx.tree_at(lambda s: s.canopy.leaf.Cab, scale_extinction(scene, factor), 40.0 * factor)


LAYER_FACTORS = inversion.Unknown(
    apply=scale_layers, name="layers", bounds=(0.1, 4.0), start=np.linspace(0.8, 1.2, LAYERS)
)
EXTINCTION_FACTOR = inversion.Unknown(apply=scale_extinction, name="factor", bounds=(0.1, 4.0), start=1.1)
EXTINCTION_AND_PIGMENT = inversion.Unknown(
    apply=scale_extinction_and_pigment, name="extinction and pigment", bounds=(0.1, 4.0), start=1.1
)
# Dependences alternate, so that columns have to be sorted.
UNKNOWNS = [
    inversion.Unknown("canopy.leaf.Cab", bounds=(5.0, 100.0)),
    LAYER_FACTORS,
    inversion.Unknown("ground.height", bounds=(-1.0, 0.5)),
    EXTINCTION_FACTOR,
    inversion.Unknown("ground.reflectance", bounds=(0.1, 0.9)),
]


def model_of(scene, unknowns=UNKNOWNS, lidar=LIDAR, orders=3):
    """Return a model of few photons, and the unknowns' starting values."""
    bound = bind_unknowns(unknowns, scene)
    sizes = {"n_photons": 2048, "n_rays": 64, "window": (-60.0, 60.0), "describe": False}
    plan = jl.plan(lidar, scene, max_orders=orders, **sizes)
    return ForwardModel(lidar, scene, plan, bound, KEY), flat_start(bound)


def dependences(model):
    return [setter.dependence for setter in model.inputs.setters]


@BY_PRECISION
@pytest.mark.parametrize("dense_columns", [4, 8])
@pytest.mark.slow
def test_jacobians_are_the_same_as_with_tangents(monkeypatch, precision, dense_columns):
    """With voxels that list the two columns which move them, and with derivatives of all columns in each."""
    monkeypatch.setattr(fit_model, "DENSE_COLUMNS", dense_columns)
    with_scores, start = model_of(scene_with())
    assert dependences(with_scores) == ["optical", "extinction", "geometric", "extinction", "optical"]
    forward = with_scores.inputs
    assert forward.columns_per_voxel == (2 if dense_columns == 4 else LAYERS + 1)
    assert forward.tangents_per_pass == 1
    monkeypatch.setattr(fit_model, "MAX_SCORED_COLUMNS", 1)
    with_tangents, _ = model_of(scene_with())
    assert dependences(with_tangents) == ["optical", "geometric", "geometric", "geometric", "optical"]
    assert with_tangents.inputs.tangents_per_pass == LAYERS + 2
    scored, pushed = with_scores(start), with_tangents(start)
    scale = np.abs(pushed.jacobian).max(axis=(0, 1))
    assert scale.min() > 0
    rtol = 2e-5 if precision == "float32" else 1e-12
    assert np.max(np.abs(scored.jacobian - pushed.jacobian) / scale) < rtol
    atol = rtol * pushed.reflectance.max()
    np.testing.assert_allclose(scored.reflectance, pushed.reflectance, rtol=rtol, atol=atol)


def test_unknowns_that_change_optics_as_well_are_geometric():
    assert dependences(model_of(scene_with(), [EXTINCTION_AND_PIGMENT])[0]) == ["geometric"]
    assert dependences(model_of(scene_with(), [EXTINCTION_FACTOR])[0]) == ["extinction"]


def test_columns_are_tangents_where_scores_do_not_serve():
    """Straight transmission, many wavelengths, one column off nadir, little memory."""
    straight = scene_with(transmission="straight")
    assert dependences(model_of(straight, [EXTINCTION_FACTOR])[0]) == ["geometric"]
    hyperspectral = jl.Lidar(wavelength=np.linspace(500.0, 900.0, 17))
    model, _ = model_of(scene_with(), [EXTINCTION_FACTOR], hyperspectral, orders=1)
    assert dependences(model) == ["geometric"]
    off_nadir = jl.Lidar(zenith=10.0)
    assert dependences(model_of(scene_with(), [EXTINCTION_FACTOR], off_nadir)[0]) == ["geometric"]
    assert dependences(model_of(scene_with(), [LAYER_FACTORS], off_nadir)[0]) == ["extinction"]
    bound = bind_unknowns([LAYER_FACTORS], scene_with())
    plan = model_of(scene_with(), [LAYER_FACTORS])[0].inputs.plan
    size = choose_jacobian_methods(LIDAR, scene_with(), plan, bound).score_bytes
    assert size > 0
    # Scores may take half of the plan's memory.
    for factor, dependence in ((2.1, "extinction"), (1.9, "geometric")):
        scope = dataclasses.replace(plan.scope, max_memory=1e-9 * factor * size)
        limited = dataclasses.replace(plan, scope=scope)
        methods = choose_jacobian_methods(LIDAR, scene_with(), limited, bound)
        assert [setter.dependence for setter in methods.setters] == [dependence]


def test_columns_of_voxels_are_found_at_other_values_than_the_start(monkeypatch):
    """At the start each voxel lies in one layer of the profile; with the ground at other heights, in two."""
    monkeypatch.setattr(fit_model, "DENSE_COLUMNS", 1)
    voxels = jl.VoxelMap.from_lad(np.full((1, 1, 10), 0.5), voxel_size=1.0, origin=(-0.5, -0.5, -2.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.4))
    height = inversion.Unknown("ground.height", bounds=(-1.0, 1.0))
    profile = inversion.Unknown(
        apply=inversion.put_profile, name="profile", bounds=(0.01, 2.0), start=np.full(5, 0.5)
    )
    for unknowns, most in (([profile], 1), ([height, profile], 2)):
        assert max_columns_per_voxel(scene, bind_unknowns(unknowns, scene)) == most


@pytest.mark.slow
def test_layers_are_retrieved():
    """A fit with scores recovers the factors that a waveform without noise was simulated with."""
    scene = scene_with()
    truth = scale_layers(scene, jnp.linspace(0.7, 1.3, LAYERS))
    wave = jl.simulate(LIDAR, truth, key=jax.random.key(1), max_orders=1)
    fit = ask(
        inversion.retrieve,
        wave,
        LIDAR,
        scene,
        [LAYER_FACTORS],
        noise=1e-5,
        key=KEY,
        max_orders=1,
        n_rays=1024,
    )
    np.testing.assert_allclose(fit.values["layers"], np.linspace(0.7, 1.3, LAYERS), atol=0.05)


def put_top(scene, extinction):
    return eqx.tree_at(
        lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda leaf: leaf.at[..., 3:].set(extinction)
    )


@pytest.mark.slow
@pytest.mark.parametrize(("zenith", "method"), [(0.0, "extinction"), (10.0, "geometric")])
def test_leaves_above_the_occupied_voxels_would_attenuate(zenith, method):
    """Black leaves in empty layers and in layers of next to no leaf: the same paths, and the same derivative.

    Straight down by score functions, and else by tangents.

    Planted: a derivative that is 2 % off.
    """
    leaf = jnp.zeros((1, 1, 6)).at[..., :3].set(0.1)
    voxels = jl.VoxelMap.from_extinction(leaf=leaf, voxel_size=(40.0, 40.0, 1.0), origin=(-20.0, -20.0, 3.0))
    plate = jl.Plate(height=2.0, reflectance=0.6, transmittance=0.3)
    scene = jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(1e-6), sides="periodic"),
        plates=(plate,),
        ground=jl.Ground(reflectance=0.9),
    )
    top = inversion.Unknown(apply=put_top, name="top", bounds=(0.0, 0.5), start=0.1)
    model, _ = model_of(scene, [top], lidar=jl.Lidar(divergence=0.5, zenith=zenith), orders=4)
    assert dependences(model) == [method]
    in_empty, in_thin = (model(np.array([value])).jacobian[..., 0].sum() for value in (0.0, 1e-6))
    assert in_empty == pytest.approx(in_thin, rel=1e-4)
    assert 0.98 * in_empty != pytest.approx(in_thin, rel=1e-4)
