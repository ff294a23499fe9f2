"""Shared illumination: agreement with single shots in a complex scene, the choice of strategy, refusals."""

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.survey.footprint_splines import BeamSection, fit_footprints, section_of, spline_error
from jaxlidar.survey.results import OPTIONAL_ARRAYS
from jaxlidar.survey.shared_illumination import GroupContribution, make_group_context, sum_contributions
from jaxlidar.trace.photons.entry_nodes import cubic_bspline
from tests.survey.test_simulate_many import (
    FAST,
    KEY,
    Dying,
    Stopped,
    agree,
    deviations,
    lidar,
    nadir,
    oblique,
    same,
    simulate_each,
    stand,
)


def ridges():
    """Return terrain of slopes that light one another, below the stand."""
    heights = 1.5 * np.sin(np.arange(81.0) / 3.0)[:, None] * np.ones(81)
    return jl.Terrain(heights, 1.0, (-40.0, -40.0), reflectance=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [nadir, oblique], ids=["by node", "by shot"])
def test_shared_illumination_over_terrain_below_plates_and_air(kind):
    """Waveforms, components and energy budgets agree over everything that photons can meet."""
    survey = kind(4, wavelength=(532.0, 1064.0))
    leaf = jl.LeafOptics(np.array([0.1, 0.45]), np.array([0.1, 0.25]))
    plate = jl.Plate(16.0, 0.2, 0.5, coverage=0.5)
    canopy = jl.Canopy(stand().canopy.voxels, leaf=leaf, hotspot=False)
    scene = jl.Scene(canopy, (plate,), ridges(), jl.Atmosphere(lidar_ratio=40.0))
    options = {"rtol": 0.1, "max_orders": 2}
    shared = jl.simulate_many(survey, scene, key=KEY, **options, shared=True)
    waves = simulate_each(survey, scene, **options)
    # Both wavelengths have the same photons, and are not independent.
    assert agree(deviations(shared, waves, slice(1, 2)))
    assert np.allclose(sum(shared.energy_budget.values()), 1.0, atol=1e-3)
    for name in waves[0].components:
        shared_sums = shared.components[name].sum(axis=2)
        single_sums = np.stack([w.components[name].sum(axis=1) for w in waves])
        assert np.allclose(shared_sums, single_sums, rtol=0.15, atol=2e-3), name
    for name, errors in shared.energy_budget_stderr.items():
        single = np.stack([w.energy_budget[name] for w in waves])
        single_stderr = np.stack([w.energy_budget_stderr[name] for w in waves])
        bound = 5.0 * np.hypot(errors, single_stderr) + 1e-4
        assert np.all(np.abs(shared.energy_budget[name] - single) < bound), name
        # Means over all shots, whose photons are partly the same. Planted: a fifth too much of the ground.
        spread = 4.0 * np.hypot(errors.mean(axis=0), single_stderr.mean(axis=0)) + 1e-5
        mean, expected = shared.energy_budget[name].mean(axis=0), single.mean(axis=0)
        assert np.all(np.abs(mean - expected) < spread), name
        assert name != "absorbed by ground" or np.all(np.abs(1.2 * mean - expected) > spread)


def test_standard_errors_of_the_energy_budget_are_those_of_its_sums():
    """All that is scattered may escape or not: the standard error of what returns is its own.

    It was that of the light that escaped where this is smaller: 0 in place of 0.2 A / (pi R^2).
    """
    beam, scene = lidar(), jl.Scene(ground=jl.Ground())
    setup = jl.make_setup(beam, scene, jl.plan(beam, scene))
    sums = {
        "returned": 0.4,
        "relative_energy": 0.4,
        "returned_outside": 0.0,
        "escaped": 0.5,
        "flown_outside": 0.1,
        "unfollowed": 0.1,
    }
    stderr = {
        "returned": 0.2,
        "relative_energy": 0.2,
        "returned_outside": 0.0,
        "escaped": 0.0,
        "flown_outside": 0.03,
        "unfollowed": 0.04,
    }
    energy, energy_stderr = (
        {**{name: np.full((1, 1), x) for name, x in values.items()}, "absorbed": np.full((1, 1, 1), 0.05)}
        for values in (sums, stderr)
    )
    samples = (1, setup.plan.n_samples)
    contribution = GroupContribution(
        shots=np.zeros(1, int),
        lines=np.zeros((1, 3, *samples)),
        energy=energy,
        variance=np.zeros((1, *samples)),
        energy_variance={name: a**2 for name, a in energy_stderr.items()},
        photons=np.ones(1, int),
    )
    context = make_group_context(setup, spacing=1.0, view_geometry=None)
    results = sum_contributions(context, [contribution], slice(0, 1), OPTIONAL_ARRAYS)
    solid_angle_over_pi = float(beam.aperture_area) / (np.pi * float(beam.range_to_reference) ** 2)
    expected = {
        "returned": 0.2 * solid_angle_over_pi,
        "escaped": 0.0,
        "absorbed by ground": 0.05,
        "after the window": 0.03,
        "unfollowed": 0.04,
    }
    assert results["energy_budget_stderr"].keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(results["energy_budget_stderr"][name], [[value]], rtol=1e-5, err_msg=name)


def test_splines_fit_footprints():
    axis = (0.3, 0.4, -(0.75**0.5))
    beams = [BeamSection(1.0, gaussian, *oblique) for gaussian in (True, False) for oblique in ((), (axis,))]
    for beam, largest in zip(beams, (2e-4, 2e-4, 0.03, 0.03)):
        errors = [spline_error(np.array([0.3, -0.2]), beam, spacing) for spacing in (1.0, 0.35)]
        assert errors[1] < largest < errors[0]
    survey = nadir(8)
    splines = fit_footprints(survey, 0.01)
    assert np.allclose(splines.coefficients.sum(axis=(1, 2)), 1.0, atol=1e-5)
    # The energy that they misplace, by node, adds up to their error.
    errors = [spline_error(p, section_of(survey), splines.spacing) for p in survey.position]
    assert np.allclose(np.sqrt((splines.misplaced_energy**2).sum(axis=(1, 2))), errors, rtol=1e-4)
    # Their centroids are where the beams aim.
    number = np.arange(splines.coefficients.shape[1])
    for axis in (0, 1):
        along = splines.coefficients.sum(axis=2 - axis)
        mean = splines.spacing * (splines.first_node[:, axis] + (along * number).sum(axis=1))
        assert np.allclose(mean, survey.position[:, axis], atol=1e-2)


def misplaced_light(transmittances, size):
    """Return errors of top hats above columns with these transmittances, and the estimates of the errors.

    Relative to the light that passes in the mean. There is no Monte Carlo error: the light of nodes is
    integrated on a raster. `transmittances`: (n, n). `size`: of columns, m.
    """
    survey = nadir(16, profile="top-hat")
    splines = fit_footprints(survey, 0.006)
    # Twelve raster cells per spacing of the grid resolve splines, edges of columns, and the beam's edge.
    cell = splines.spacing / 12.0
    extent = 0.5 * size * len(transmittances)
    raster = np.arange(-extent + 0.5 * cell, extent, cell)
    column = np.minimum(((raster + extent) / size).astype(int), len(transmittances) - 1)
    nodes = np.arange(splines.coefficients.shape[1])
    errors, estimates = [], []
    for (x, y), first, coefficients, misplaced in zip(
        survey.position, splines.first_node, splines.coefficients, splines.misplaced_energy
    ):
        # No spline of the footprint, of 5 m, reaches beyond 9 m.
        near_x, near_y = (np.flatnonzero(np.abs(raster - centre) < 9.0) for centre in (x, y))
        light = transmittances[np.ix_(column[near_x], column[near_y])]
        along_x, along_y = (
            cubic_bspline(raster[near, None] / splines.spacing - (first[k] + nodes)) / 12.0
            for k, near in enumerate((near_x, near_y))
        )
        returned = along_x.T @ light @ along_y
        distance = np.hypot(raster[near_x, None] - x, raster[None, near_y] - y)
        beam = np.clip(0.5 + (5.0 - distance) / cell, 0.0, 1.0)
        errors.append(np.sum(coefficients * returned) - np.sum(beam * light) / np.sum(beam))
        estimates.append(np.sqrt(np.sum((misplaced * returned) ** 2)))
    return np.array(errors) / transmittances.mean(), np.array(estimates) / transmittances.mean()


def error_over_estimate(transmittances, size):
    """Return the root mean square error of the grid over its estimate."""
    errors, estimates = misplaced_light(transmittances.astype(float), size)
    return np.sqrt(np.mean(errors**2) / np.mean(estimates**2))


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_the_error_of_the_grid_is_estimated_from_above(size):
    """Root mean square error over the estimate, for columns smaller and larger than the grid's spacing.

    Where half of the columns let light pass and half do not, it is between a quarter and 1; where they differ
    by a fifth, a fraction of that.
    """
    random, number = np.random.default_rng(4), int(44.0 / size)
    halves = random.permutation(np.arange(number**2) % 2).reshape(number, number)
    assert 0.25 < error_over_estimate(halves, size) < 1.0
    assert error_over_estimate(0.8 + 0.2 * halves, size) < 0.15


def test_the_error_of_the_grid_is_larger_where_light_returns_from_few_small_columns():
    sparse = np.random.default_rng(4).uniform(size=(88, 88)) < 0.05
    assert error_over_estimate(sparse, 0.5) > 1.0


@pytest.mark.slow
def test_light_is_shared_where_footprints_overlap():
    overlapping = jl.Survey.grid(lidar(), (-6, -6), (6, 6), 3.0)
    assert jl.simulate_many(overlapping, stand(), key=KEY, **FAST).info["shared"]
    separate = jl.Survey.grid(lidar(), (-20, -20), (20, 20), 20.0)
    assert not jl.simulate_many(separate, stand(), key=KEY, **FAST).info["shared"]


MIRROR = jl.Ground(law=jl.Specular(roughness=0.1))
STRAIGHT = {"transmission": "straight"}


@pytest.mark.parametrize(
    ("survey", "scene", "reason"),
    [
        (jl.Survey(lidar(), [(0, 0)] * 2, [0.0, 10.0]), stand(), "shots have more than one direction"),
        (nadir(2, altitude=100.0), stand(), "light that is not parallel changes up to .* %"),
        (nadir(2), stand(ground=MIRROR), "a surface is a mirror"),
        (nadir(2), stand(**STRAIGHT), "transmission = 'straight'"),
        (nadir(2), jl.Scene(ground=jl.Ground()), "nothing is random"),
    ],
)
def test_shots_that_cannot_share_light_are_refused(survey, scene, reason):
    with pytest.raises(ValueError, match=f"shared = True, but .*{reason}"):
        jl.simulate_many(survey, scene, key=KEY, rtol=0.05, shared=True)


@pytest.mark.parametrize("survey", [nadir(2, field_of_view=0.4), oblique(2)])
def test_oblique_and_limited_shots_do_not_share_first_order(survey):
    with pytest.raises(ValueError, match="shared = True, but one order is followed"):
        jl.simulate_many(survey, stand(), key=KEY, rtol=0.05, max_orders=1, shared=True)


@pytest.mark.slow
def test_shared_illumination_does_not_depend_on_workers_or_interrupts(tmp_path):
    survey, options = jl.Survey.grid(lidar(), (-20, -20), (20, 20), 2.0), {"rtol": 0.05, "max_orders": 2}
    waveforms = jl.simulate_many(survey, stand(), key=KEY, **options)
    assert waveforms.info["shared"]
    assert np.all(waveforms.error <= 0.05)
    dying = Dying([1, 3])
    assert same(waveforms, jl.simulate_many(survey, stand(), key=KEY, **options, executor=dying))
    assert len(dying.submitted) == 2 + len(set(dying.submitted)) > 4

    def stop(progress):
        if progress.done > 100:
            raise Stopped

    path = tmp_path / "many.zarr"
    with pytest.raises(Stopped):
        jl.simulate_many(survey, stand(), key=KEY, **options, path=path, progress=stop)
    assert same(waveforms, jl.simulate_many(survey, stand(), key=KEY, **options, path=path))


def test_plans_of_surveys_bound_the_effect_of_parallel_light():
    """The bound falls with distance, and is no less than the effect of a narrower footprint."""
    survey = nadir(3)
    rows = {effect.name: effect for effect in jl.plan(survey, stand()).effects}
    row = rows["spreading of rays"]
    assert not row.simulated
    assert 1.5 * 13.0 / 2e4 < row.bound < 0.005
    distant = {
        effect.name: effect for effect in jl.plan(nadir(3, altitude=4e5, divergence=0.025), stand()).effects
    }
    assert distant["spreading of rays"].bound < row.bound / 10
    limited = jl.plan(nadir(3, field_of_view=0.5), stand())
    wider = {effect.name: effect for effect in limited.effects}["spreading of rays"].bound
    assert row.bound + 1.9 * 13.0 / 2e4 < wider < 0.01
    spread = jl.plan(jl.Survey(lidar(), [(0, 0)] * 2, [0.0, 10.0]), stand())
    assert "spreading of rays" not in {effect.name for effect in spread.effects}


def test_a_grid_that_is_too_coarse_is_refused():
    hats = nadir(6, profile="top-hat", altitude=4e5, divergence=0.025)
    with pytest.raises(ValueError, match=r"the finest grid misplaces .* % of the light, at rtol = 0.0005"):
        jl.simulate_many(hats, stand(), key=KEY, rtol=5e-4, max_orders=1, shared=True)
