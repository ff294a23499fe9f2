"""Leaves in clumps as a prior: its field, and the leaf area that wide footprints do not see without it."""

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.scene.clumps import _smoothing

DENSITY = 0.6


def stand(lad):
    voxels = jl.VoxelMap.from_lad(lad, voxel_size=1.0)
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4)), ground=jl.Ground(reflectance=0.3)
    )


def crowns(side=24, layers=12, number=46, seed=1):
    """Return ellipsoids 3.2 m wide and 5 m high on the average, over two fifths of the area."""
    random, lad = np.random.default_rng(seed), np.zeros((side, side, layers))
    x, y, z = np.meshgrid(*(np.arange(n) + 0.5 for n in lad.shape), indexing="ij")
    for _ in range(number):
        east, north, radius = *random.uniform(0, side, 2), random.uniform(1.0, 2.2)
        top, bottom = random.uniform(0.6, 0.95) * layers, random.uniform(0.2, 0.4) * layers
        middle, half = 0.5 * (top + bottom), 0.5 * (top - bottom)
        distance = np.hypot((x - east) / radius, (y - north) / radius) ** 2 + ((z - middle) / half) ** 2
        lad[distance < 1.0] = DENSITY
    return lad


def test_the_field_has_unit_variance_and_the_stated_correlation():
    matrix = _smoothing(200, 4.0)
    covariance = (matrix @ matrix.T)[100]
    distance = np.arange(200) - 100
    np.testing.assert_allclose(covariance, np.exp(-0.5 * (distance / 4.0) ** 2), atol=1e-6)
    # Also at the ends, where the kernel is cut off.
    np.testing.assert_allclose(np.sum(matrix**2, axis=1), 1.0)


def test_clumps_have_their_density_and_size():
    scene = stand(np.zeros((96, 96, 16)))
    unknown = inversion.clumped_leaves(scene, density=DENSITY, size=(10.0, 6.0), key=jax.random.key(0))
    lad = 2.0 * np.asarray(unknown.apply(scene, unknown.start).canopy.voxels.leaf)
    assert 0.99 * DENSITY < lad.max() <= DENSITY
    is_clump = lad > 0.5 * DENSITY
    # The field is above one standard deviation over 16 % of the space.
    assert 0.12 < is_clump.mean() < 0.20
    # Chords: the volume of clumps over the area of their faces. Those of ellipsoids are 2/3 of a diameter.
    for axis, diameter in ((0, 10.0), (1, 10.0), (2, 6.0)):
        faces = np.sum(np.diff(is_clump.astype(int), axis=axis) == 1)
        assert is_clump.sum() / faces == pytest.approx(2.0 / 3.0 * diameter, rel=0.2)


def test_equal_priors_share_programs_and_keys_differ():
    scene = stand(np.zeros((4, 4, 3)))
    arguments = {"density": 0.5, "size": (2.0, 3.0)}
    first, second = (inversion.clumped_leaves(scene, key=jax.random.key(n), **arguments) for n in range(2))
    assert first.apply == second.apply
    assert hash(first.apply) == hash(second.apply)
    assert np.abs(np.asarray(first.start) - np.asarray(second.start)).max() > 0.1
    np.testing.assert_allclose(np.asarray(first.start).mean(axis=(0, 1)), 0.0, atol=1e-6)


@pytest.mark.slow
def test_clumps_restore_leaf_area_that_a_smooth_prior_misses():
    """Both priors explain the records alike: the difference between them is prior knowledge alone."""
    lad = crowns()
    lidar = jl.Lidar(wavelength=1064.0, altitude=1000.0, divergence=10.0, pulse=jl.GaussianPulse(4.0))
    survey = jl.Survey.grid(lidar, (0.0, 0.0), (24.0, 24.0), 3.0)
    with pytest.warns(jl.OffMapWarning):
        waves = jl.simulate_many(survey, stand(lad), key=jax.random.key(0), max_orders=1)
    noise = 0.02 * float(waves.reflectance.max())
    observed = waves.reflectance + noise * np.random.default_rng(0).normal(size=waves.reflectance.shape)
    smooth = inversion.Unknown(
        "canopy.voxels.leaf",
        bounds=(0.0, 2.0),
        name="leaf",
        start=np.full(lad.shape, 0.05),
        prior=inversion.MarkovField(0.1),
    )
    clumps = inversion.clumped_leaves(stand(lad), density=DENSITY, size=(3.2, 6.0), key=jax.random.key(2))
    error = {}
    for unknown in (smooth, clumps):
        fit = inversion.retrieve_scene(
            observed,
            survey,
            stand(lad),
            [unknown],
            noise=noise,
            time=waves.time,
            key=jax.random.key(1),
            max_orders=1,
            draws=0,
            held_out=0.0,
        )
        assert float(fit.misfit) < 1.1
        leaf = 2.0 * np.asarray(fit.scene.canopy.voxels.leaf)
        error[unknown.name] = leaf.sum() / lad.sum() - 1.0
        assert np.corrcoef(leaf.sum(axis=(0, 1)), lad.sum(axis=(0, 1)))[0, 1] > 0.96
    assert error["leaf"] < -0.2
    # Ellipsoids are not the clumps of the field: the prior is near the truth, and so is the result.
    assert abs(error["clumps"]) < 0.15


def test_bad_arguments_are_refused_by_name():
    scene = stand(np.zeros((2, 2, 2)))

    def run(scene=scene, **changes):
        arguments = {"density": 0.5, "size": (3.0, 4.0), "key": jax.random.key(0)} | changes
        return inversion.clumped_leaves(scene, **arguments)

    for changes, message in (
        ({"density": 0.0}, "density = 0"),
        ({"size": (3.0, -1.0)}, "size = -1"),
        ({"size": 3.0}, r"size has the shape \(\); admissible is \(2,\)"),
        ({"scene": jl.Scene(ground=jl.Ground())}, "scene has no canopy with leaf"),
    ):
        with pytest.raises(ValueError, match=message):
            run(**changes)
