"""Scores of extinction against tangents pushed through the trace: the same numbers, to rounding.

A crown of 6 x 5 x 8 random voxels over ground, four orders, the same keys and photons for both. The tangents
are those of `jax.jvp`, of the same estimator: both differ only in the order in which they add up. A voxel
without any extinction is among those that move. The tolerance is 1e-5 of the largest derivative in single
precision and 1e-13 in double; leaving out the way back, or a collision, is wrong by 1e-2 or more.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.spectral.apply_optics import derivatives_to_samples, make_waveform_model, setup_optics
from jaxlidar.trace.derivatives.score_functions import make_slopes
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.photons import higher_orders
from jaxlidar.trace.response import trace_with_scores
from tests.helpers import BY_PRECISION

RANDOM = np.random.default_rng(5)
LEAF, BARK = RANDOM.uniform(0, 1, (6, 5, 8)), RANDOM.uniform(0, 0.3, (6, 5, 8))
LEAF[2, 2, 5] = 0.0


class ScoreCase(NamedTuple):
    """A scene, its unknowns, and the largest number of unknowns that change one voxel."""

    unknowns: str
    max_columns: int
    bark: bool = False
    slope: float = 0.0
    zenith: float = 0.0
    plates: int = 0
    angles: str | None = None
    orders: int = 4
    hotspot: bool = False
    sides: str = "open"
    field_of_view: float | None = None
    phase: bool = False
    air: bool = False


CASES = {
    "layers": ScoreCase("layers", 1),
    "group, bark, slope, off nadir": ScoreCase("group", 2, bark=True, slope=10.0, zenith=12.0),
}
MORE_CASES = {
    "factor": ScoreCase("factor", 1, bark=True, slope=10.0),
    "layers, off nadir": ScoreCase("layers", 1, zenith=12.0),
    "layers, two to a voxel": ScoreCase("overlapping", 2, bark=True, slope=10.0, zenith=12.0),
    "layers, plate": ScoreCase("layers", 1, plates=1, zenith=12.0, orders=3),
    "layers, leaf angles": ScoreCase("layers", 1, angles="planophile", zenith=12.0),
    "layers, hot spot": ScoreCase("layers", 1, hotspot=True),
    "layers, periodic": ScoreCase("layers", 1, sides="periodic", slope=10.0),
    "layers, field of view": ScoreCase("layers", 1, zenith=12.0, field_of_view=2.0),
    "layers, phase function": ScoreCase("layers", 1, phase=True, slope=10.0),
    "layers, air": ScoreCase("layers", 1, air=True),
    "layers, one order": ScoreCase("layers", 1, bark=True, zenith=12.0, orders=1),
}
START = {"layers": jnp.ones(8), "overlapping": jnp.ones(9), "factor": jnp.ones(1), "group": jnp.ones(2)}


def build(case: ScoreCase, x: jax.Array) -> jl.Scene:
    leaf, bark = jnp.asarray(LEAF), jnp.asarray(BARK)
    match case.unknowns:
        case "layers":
            leaf = leaf + 0.1 * (x - 1.0)[None, None] + leaf * (x - 1.0)[None, None]
        case "overlapping":
            leaf, bark = leaf * x[None, None, :8] * x[8], bark * x[8]
        case "factor":
            leaf, bark = leaf * x[0], bark * x[0]
        case "group":
            leaf, bark = leaf.at[2:4, 2:4, 3:6].multiply(x[0]), bark * x[1]
    geometry = {"voxel_size": 0.5, "origin": (-1.5, -1.25, 1.0)}
    if case.angles is not None:
        voxels = jl.VoxelMap.from_lad(leaf, leaf_angles=case.angles, **geometry)
    else:
        voxels = jl.VoxelMap.from_extinction(leaf=leaf, bark=bark if case.bark else None, **geometry)
    optics = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
    leaves = jl.HenyeyGreenstein(albedo=0.8, g=0.3) if case.phase else optics
    return jl.Scene(
        canopy=jl.Canopy(voxels, leaf=leaves, hotspot=case.hotspot, bark=0.3, sides=case.sides),
        atmosphere=jl.Atmosphere() if case.air else None,
        plates=(jl.Plate(height=0.7, reflectance=0.3, coverage=0.5),) * case.plates,
        ground=jl.Ground(height=0.2, reflectance=0.5, slope=case.slope, aspect=30.0),
    )


def tangents_and_scores(case: ScoreCase):
    """Return the reflectance and its derivatives, once by tangents and once by scores."""
    # In the precision in use.
    start = jnp.asarray(np.asarray(START[case.unknowns]), jnp.result_type(float))
    seen = {"zenith": case.zenith, "azimuth": 0.0, "field_of_view": case.field_of_view}
    lidar = jl.Lidar(divergence=2.0, wavelength=(532.0, 1064.0), **seen)
    sizes = {"max_orders": case.orders, "n_photons": 4096, "n_rays": 128, "window": (-60.0, 80.0)}
    plan = jl.plan(lidar, build(case, start), **sizes)
    key, directions = jax.random.key(3), jnp.eye(start.size, dtype=start.dtype)

    def setup_at(x):
        return jl.make_setup(lidar, build(case, x), plan)

    def total(x):
        setup = setup_at(x)
        return jl.total_reflectance(jl.trace_scene(setup, key, reverse=False), setup)

    @jax.jit
    def by_tangents(x):
        return jax.vmap(lambda t: jax.jvp(total, (x,), (t,)), out_axes=(None, 0))(directions)

    def extinction(x):
        medium = build_device_scene(setup_at(x), derivatives="forward").medium
        assert medium is not None
        return medium.leaf, medium.bark

    @jax.jit
    def by_scores(x):
        setup = setup_at(x)
        device_scene, optics = build_device_scene(setup, derivatives="forward"), setup_optics(setup)
        leaf, bark = jax.vmap(lambda t: jax.jvp(extinction, (x,), (t,))[1])(directions)
        slopes = make_slopes(device_scene, leaf, bark, optics, case.max_columns)
        device_scene = dataclasses.replace(device_scene, slopes=slopes)
        response, fine = trace_with_scores(device_scene, optics, key)
        return jl.total_reflectance(response, setup), derivatives_to_samples(fine, make_waveform_model(setup))

    return by_tangents(start), by_scores(start)


def relative_difference(case: ScoreCase) -> float:
    """Return the largest difference of the derivatives over the largest derivative."""
    (total, columns), (same, scored) = tangents_and_scores(case)
    rounding = 10 * float(jnp.finfo(total.dtype).eps)
    np.testing.assert_allclose(same, total, rtol=0, atol=rounding * float(jnp.max(total)))
    return float(jnp.max(jnp.abs(scored - columns)) / jnp.max(jnp.abs(columns)))


TOLERANCE = {"float32": 1e-5, "float64": 1e-13}


@pytest.mark.slow
@BY_PRECISION
@pytest.mark.parametrize("name", CASES)
def test_scores_are_tangents(name, precision):
    assert relative_difference(CASES[name]) < TOLERANCE[precision]


@pytest.mark.slow
@pytest.mark.parametrize("name", MORE_CASES)
def test_more_scores_are_tangents(name, precision):
    assert relative_difference(MORE_CASES[name]) < TOLERANCE[precision]


@pytest.mark.slow
@pytest.mark.parametrize("left_out", ["vertical_depth_slopes", "collision_score"])
def test_a_wrong_score_is_rejected(left_out, monkeypatch):
    """Without the way back to the sensor, or without what collisions add."""
    right = getattr(higher_orders, left_out)
    monkeypatch.setattr(higher_orders, left_out, lambda *a: 0.0 * right(*a))
    assert relative_difference(CASES["layers"]) > 1e-2


@pytest.mark.slow
def test_a_voxel_that_too_many_columns_move_is_not_a_number():
    """A wrong promise spoils the derivatives, rather than being believed."""
    (_, _), (_, scored) = tangents_and_scores(
        MORE_CASES["layers, two to a voxel"]._replace(max_columns=1, orders=1)
    )
    assert bool(jnp.any(jnp.isnan(scored)))
