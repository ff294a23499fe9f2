"""Shots that share light: agreement where much is in the way, where they can and where it pays, refusals."""

import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.survey.irradiance import Section, misplaced, patches, section_of
from tests.survey.test_simulate_many import (
    FAST,
    KEY,
    Dying,
    Stopped,
    agree,
    deviations,
    leaning,
    lidar,
    nadir,
    one_by_one,
    same,
    stand,
)


def ridges():
    """Terrain of slopes that light one another, below the stand."""
    heights = 1.5 * np.sin(np.arange(81.0) / 3.0)[:, None] * np.ones(81)
    return jl.Terrain(heights, 1.0, (-40.0, -40.0), reflectance=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [nadir, leaning], ids=["by node", "by shot"])
def test_shared_light_over_terrain_below_plates_and_air(kind):
    """All that photons can meet, at two wavelengths, and where all light goes."""
    survey = kind(4, wavelength=(532.0, 1064.0))
    leaf = jl.LeafOptics(np.array([0.1, 0.45]), np.array([0.1, 0.25]))
    plate = jl.Plate(16.0, 0.2, 0.5, coverage=0.5)
    canopy = jl.Canopy(stand().canopy.voxels, leaf=leaf)
    scene = jl.Scene(canopy, (plate,), ridges(), jl.Atmosphere(lidar_ratio=40.0))
    how = {"rtol": 0.1, "max_orders": 2}
    many = jl.simulate_many(survey, scene, key=KEY, **how, shared=True)
    waves = one_by_one(survey, scene, **how)
    # Both wavelengths have the same photons, and are not independent.
    assert agree(deviations(many, waves, slice(1, 2)))
    assert np.allclose(sum(many.energy_budget.values()), 1.0, atol=1e-3)
    for name in waves[0].components:
        mine = many.components[name].sum(axis=2)
        each = np.stack([w.components[name].sum(axis=1) for w in waves])
        assert np.allclose(mine, each, rtol=0.15, atol=2e-3), name
    for name, errors in many.energy_budget_stderr.items():
        one = np.stack([w.energy_budget[name] for w in waves])
        own = np.stack([w.energy_budget_stderr[name] for w in waves])
        assert np.all(np.abs(many.energy_budget[name] - one) < 5.0 * np.hypot(errors, own) + 1e-4), name
        # Over all shots together, whose photons are partly the same; a fifth too much is told.
        spread = 4.0 * np.hypot(errors.mean(axis=0), own.mean(axis=0)) + 1e-5
        found, expected = many.energy_budget[name].mean(axis=0), one.mean(axis=0)
        assert np.all(np.abs(found - expected) < spread), name
        assert name != "absorbed by ground" or np.all(np.abs(1.2 * found - expected) > spread)


def test_footprints_are_splines():
    axis = (0.3, 0.4, -(0.75**0.5))
    beams = [Section(1.0, gaussian, *way) for gaussian in (True, False) for way in ((), (axis,))]
    for beam, largest in zip(beams, (2e-4, 2e-4, 0.03, 0.03)):
        errors = [misplaced(np.array([0.3, -0.2]), beam, spacing) for spacing in (1.0, 0.35)]
        assert errors[1] < largest < errors[0]
    survey = nadir(8)
    found = patches(survey, 0.01)
    assert np.allclose(found.coefficients.sum(axis=(1, 2)), 1.0, atol=1e-5)
    # What they put elsewhere is known by place.
    off = [misplaced(p, section_of(survey), found.spacing) for p in survey.position]
    assert np.allclose(np.sqrt((found.astray**2).sum(axis=(1, 2))), off, rtol=1e-4)
    # Their means are where the beams aim.
    number = np.arange(found.coefficients.shape[1])
    for axis in (0, 1):
        along = found.coefficients.sum(axis=2 - axis)
        mean = found.spacing * (found.first[:, axis] + (along * number).sum(axis=1))
        assert np.allclose(mean, survey.position[:, axis], atol=1e-2)


def test_light_is_shared_where_it_can_be_and_pays():
    near = jl.Survey.grid(lidar(), (-6, -6), (6, 6), 3.0)
    assert jl.simulate_many(near, stand(), key=KEY, **FAST).info["shared"]
    apart = jl.Survey.grid(lidar(), (-20, -20), (20, 20), 20.0)
    assert not jl.simulate_many(apart, stand(), key=KEY, **FAST).info["shared"]


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
def test_light_that_cannot_be_shared(survey, scene, reason):
    with pytest.raises(ValueError, match=f"shared = True, but .*{reason}"):
        jl.simulate_many(survey, scene, key=KEY, rtol=0.05, shared=True)


@pytest.mark.parametrize("survey", [nadir(2, field_of_view=0.4), leaning(2)])
def test_shots_that_lean_or_have_a_field_of_view_do_not_share_order_one(survey):
    with pytest.raises(ValueError, match="shared = True, but one order is followed"):
        jl.simulate_many(survey, stand(), key=KEY, rtol=0.05, max_orders=1, shared=True)


@pytest.mark.slow
def test_shared_light_does_not_depend_on_how_it_is_traced(tmp_path):
    survey, how = jl.Survey.grid(lidar(), (-20, -20), (20, 20), 2.0), {"rtol": 0.05, "max_orders": 2}
    many = jl.simulate_many(survey, stand(), key=KEY, **how)
    assert many.info["shared"]
    assert np.all(many.error <= 0.05)
    dying = Dying([1, 3])
    assert same(many, jl.simulate_many(survey, stand(), key=KEY, **how, executor=dying))
    assert len(dying.given) == 2 + len(set(dying.given)) > 4

    def stop(progress):
        if progress.done > 100:
            raise Stopped

    path = tmp_path / "many.nc"
    with pytest.raises(Stopped):
        jl.simulate_many(survey, stand(), key=KEY, **how, path=path, progress=stop)
    assert same(many, jl.simulate_many(survey, stand(), key=KEY, **how, path=path))


def test_plans_of_surveys_bound_what_parallel_light_changes():
    """It falls as the distance grows, and is that of a narrower footprint at least."""
    survey = nadir(3)
    rows = {effect.name: effect for effect in jl.plan(survey, stand()).effects}
    row = rows["spreading of rays"]
    assert not row.simulated
    assert 1.5 * 13.0 / 2e4 < row.bound < 0.005
    far = {
        effect.name: effect for effect in jl.plan(nadir(3, altitude=4e5, divergence=0.025), stand()).effects
    }
    assert far["spreading of rays"].bound < row.bound / 10
    limited = jl.plan(nadir(3, field_of_view=0.5), stand())
    wider = {effect.name: effect for effect in limited.effects}["spreading of rays"].bound
    assert row.bound + 1.9 * 13.0 / 2e4 < wider < 0.01
    spread = jl.plan(jl.Survey(lidar(), [(0, 0)] * 2, [0.0, 10.0]), stand())
    assert "spreading of rays" not in {effect.name for effect in spread.effects}


def test_a_grid_that_is_too_coarse_is_no_answer():
    hats = nadir(6, profile="top-hat", altitude=4e5, divergence=0.025)
    with pytest.raises(ValueError, match=r"the finest grid misplaces .* % of the light, at rtol = 0.0005"):
        jl.simulate_many(hats, stand(), key=KEY, rtol=5e-4, max_orders=1, shared=True)
