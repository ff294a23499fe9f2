"""Where the axes of beams meet the ground, and where they meet none."""

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.planning.path_lengths import check_footprints_on_terrain


def test_axes_beside_open_terrain_meet_no_ground():
    """A simulation refuses what `ground_position` says to meet nothing, and takes the rest."""
    hill = jl.Terrain(np.add.outer(np.arange(21.0), np.zeros(11)), 1.0, (0.0, 0.0))
    scene, x = jl.Scene(ground=hill), np.array([-30.0, 5.0, 14.0, 60.0])
    survey = jl.Survey(jl.Lidar(divergence=0.2), np.stack([x, np.full(4, 5.0)], axis=1))
    points = jl.ground_position(survey, scene)
    met = np.isfinite(points).all(axis=1)
    assert met.tolist() == [False, True, True, False]
    # The terrain is as high as x.
    np.testing.assert_allclose(points[met], np.stack([x[met], [5.0, 5.0], x[met]], axis=1), atol=1e-4)
    with pytest.raises(ValueError, match="lies off the terrain"):
        jl.simulate_many(survey, scene, key=jax.random.key(0))
    rest = survey.subset(np.flatnonzero(met))
    many = jl.simulate_many(rest, scene, key=jax.random.key(0), max_orders=1, rtol=0.1)
    np.testing.assert_allclose(many.ground_height, x[met], atol=1e-3)


def test_level_beams_meet_a_hill():
    """Planted: a point that follows from its height is unknown for an axis without a slope."""
    hill = jl.Terrain(np.repeat(np.array([0.0, 0, 0, 50, 50, 50])[:, None], 6, axis=1), 10.0, (0.0, 0.0))
    lidar = jl.Lidar(sensor=(5.0, 25.0, 20.0))
    survey = jl.Survey(lidar, sensor=[(5.0, 25.0, 20.0)] * 2, zenith=[90.0, 90.0], azimuth=[90.0, 270.0])
    points = jl.ground_position(survey, jl.Scene(ground=hill))
    np.testing.assert_allclose(points, [[24.0, 25.0, 20.0], [np.nan] * 3], atol=1e-3)


def test_bounds_of_a_terrain_hold_for_lines_that_begin_far_beside_it():
    """Planted: nodes counted from the first line on, as many as the terrain has, end before the peak."""
    heights = np.zeros((21, 11))
    heights[18, 5] = 9.0
    shape = jl.Terrain(heights, 1.0, (0.0, 0.0)).shape
    points = np.array([[-30.0, 5.0, 20.0], [19.0, 5.0, 20.0]])
    _, low, high = shape.height_bounds_below(points, np.array([[0.0, 0.0, -1.0]] * 2))
    assert (low, high) == (0.0, 9.0)


def relief(origin=(0.0, 0.0)):
    x, y = np.indices((31, 21))
    return jl.Terrain(4.0 * np.sin(x / 3.0) * np.cos(y / 4.0), 1.0, origin)


def test_a_clipped_strip_has_the_shots_that_a_simulation_admits():
    """Each shot alone is the reference; planted: footprints without a width, borders without a margin."""
    rng, corner = np.random.default_rng(3), np.array([4e5, 5.3e6])
    scene = jl.Scene(ground=relief(corner))
    xy = corner + rng.uniform(-4.0, [34.0, 24.0], (250, 2))
    lidar = jl.Lidar(altitude=300.0, divergence=5.0)
    strip = jl.Survey(lidar, xy, rng.uniform(0, 25, 250), rng.uniform(0, 360, 250), gps_time=np.arange(250.0))

    def is_admitted(shot):
        try:
            check_footprints_on_terrain(shot, scene)
        except ValueError:
            return False
        return True

    expected = np.flatnonzero([is_admitted(shot) for shot in strip])
    kept = strip.within(scene)
    assert 50 < len(kept) < 200
    assert kept.gps_time.tolist() == expected.tolist()
    axes = jl.ground_position(strip, scene)
    assert np.isfinite(axes[:, 0]).sum() > len(kept)
    # The axis keeps the margin and the footprint; a margin outwards admits shots off the terrain.
    inner, outer = (strip.within(scene, margin=margin) for margin in (5.0, -3.0))
    place = jl.ground_position(inner, scene)[:, :2] - corner
    assert np.all((place > 5.0) & (place < [25.0, 15.0]))
    assert len(inner) < len(kept) < len(outer)


def test_shots_by_their_sensors_are_clipped_to_what_they_meet():
    """A beam past the terrain meets a crown that overhangs it; planted: ways behind the sensor count."""
    voxels = jl.VoxelMap.from_lad(np.ones((4, 4, 4)), voxel_size=1.0, origin=(28.0, 8.0, 10.0))
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4)), ground=relief())
    sensor = [(5.0, 10.0, 50.0), (5.0, 10.0, 50.0), (31.5, 10.0, 50.0), (31.5, 10.0, 50.0), (5.0, 10.0, 50.0)]
    survey = jl.Survey(
        jl.Lidar(), sensor=sensor, zenith=[10.0, 60.0, 0.0, 180.0, 175.0], azimuth=[90.0, 90.0, 0.0, 0.0, 0.0]
    )
    kept = survey.within(scene)
    assert kept.zenith.tolist() == [10.0, 0.0]


@pytest.mark.parametrize("ground", [None, jl.Ground()])
def test_without_open_terrain_shots_are_clipped_to_canopy_and_meshes(ground):
    corner = np.array([4e5, 5.3e6])
    voxels = jl.VoxelMap.from_lad(np.ones((4, 4, 2)), voxel_size=1.0, origin=(*corner, 0.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4))
    x = np.array([-0.5, 0.001, 2.0, 3.999, 4.5, 7.0])
    survey = jl.Survey(jl.Lidar(), corner + np.stack([x, np.full(6, 2.0)], axis=1))

    def kept_x(scene, **options):
        return (survey.within(scene, **options).position[:, 0] - corner[0]).round(3).tolist()

    scene = jl.Scene(canopy=canopy, ground=ground)
    assert kept_x(scene) == [0.001, 2.0, 3.999]
    assert kept_x(scene, margin=1.0) == [2.0]
    assert kept_x(scene, margin=-1.0) == [-0.5, 0.001, 2.0, 3.999, 4.5]
    triangle = np.array([[6.0, 0.0, 1.0], [8.0, 0.0, 1.0], [6.0, 4.0, 1.0]])
    triangle[:, :2] += corner
    mesh = jl.MeshSurface((triangle, [[0, 1, 2]]), reflectance=0.4)
    assert kept_x(jl.Scene(canopy=canopy, meshes=[mesh], ground=ground)) == [0.001, 2.0, 3.999, 4.5, 7.0]
    with pytest.raises(ValueError, match=r"no shot lies within the scene: .* margin = 3 m"):
        survey.within(scene, margin=3.0)
    # What has no end clips nothing.
    periodic = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.4), sides="periodic")
    plane = jl.Terrain(relief().heights, 1.0, relief=False)
    for endless in (
        jl.Scene(ground=jl.Ground()),
        jl.Scene(canopy=periodic, ground=ground),
        jl.Scene(ground=plane),
    ):
        assert len(survey.within(endless)) == 6


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("scene",), TypeError, "scene"),
        ((jl.Scene(ground=relief()), np.nan), ValueError, "margin"),
        (
            (jl.Scene(ground=relief((1e3, 0.0))),),
            ValueError,
            r"x = 5.00 to 20.00 m .* x = 1000.00 to 1030.00",
        ),
    ],
)
def test_what_clips_no_survey_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        jl.Survey(jl.Lidar(), [(5.0, 5.0), (20.0, 5.0)]).within(*arguments)


KEY = jax.random.key(4)


def strip_over_relief():
    xy = np.stack([np.linspace(-12.0, 40.0, 27), np.full(27, 10.0)], axis=1)
    return jl.Survey(jl.Lidar(), xy), jl.Scene(ground=relief())


OPTIONS = {"key": KEY, "max_orders": 1, "rtol": 0.2}


def test_shots_off_the_scene_are_empty_and_the_others_as_without_them():
    """Planted: the first rows of the results, in place of those of the shots that were traced."""
    survey, scene = strip_over_relief()
    many = jl.simulate_many(survey, scene, beyond="miss", **OPTIONS)
    kept = jl.simulate_many(survey.within(scene), scene, **OPTIONS)
    hits = np.isin(survey.position[:, 0], kept.position[:, 0])
    assert 5 < hits.sum() < 20
    assert not hits[0]
    for name in ("reflectance", "energy", "stderr", "error", "ground_height", "off_map"):
        np.testing.assert_array_equal(getattr(many, name)[hits], getattr(kept, name))
    for name in ("reflectance", "recorded", "stderr", "photons", "lost"):
        assert not getattr(many, name)[~hits].any()
    assert np.isnan(many.ground_position[~hits]).all()
    returns = many.returns()
    np.testing.assert_allclose(returns.position, kept.returns().position, rtol=1e-12)
    assert np.isin(returns.shot, np.flatnonzero(hits)).all()


def test_shots_off_the_scene_say_so_and_are_off_the_map():
    """Planted: the fractions of light off the map of the shots that were traced alone, zero for others."""
    voxels = jl.VoxelMap.from_lad(np.full((4, 4, 2), 0.3), voxel_size=10.0)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4))
    heights = np.zeros((5, 5))
    heights[2, 2] = 1.0
    terrain = jl.Terrain(heights, spacing=10.0)
    survey = jl.Survey.track(jl.Lidar(), (-10.0, 20.0), (50.0, 20.0), 10.0)
    with pytest.warns(jl.OffMapWarning, match="4 of 7 footprints lie partly outside the voxel map"):
        many = jl.simulate_many(survey, jl.Scene(canopy=canopy, ground=terrain), beyond="miss", **OPTIONS)
    np.testing.assert_allclose(many.off_map, [1.0, 0.5, 0.0, 0.0, 0.0, 0.5, 1.0], atol=0.02)
    missed = int(np.isnan(many.ground_height).sum())
    assert missed == many.info["missed"] >= 2
    assert f"{missed} miss the scene, and are empty" in str(many)
    assert many[0].info["stopped"] == "misses the scene"
    assert many[3].info["stopped"] != "misses the scene"


@pytest.mark.slow
def test_stores_keep_shots_off_the_scene(tmp_path):
    """Also where a run goes on after a chunk was damaged, and where `rerun` repeats it; and their truth."""
    survey, scene = strip_over_relief()
    path, options = tmp_path / "strip.zarr", {"beyond": "miss", "truth": True, **OPTIONS}
    many = jl.simulate_many(survey, scene, **options)
    is_empty = ~many.reflectance.any(axis=(1, 2))
    assert 10 < is_empty.sum() < len(survey)
    np.testing.assert_array_equal(np.isnan(many.truth.gap_probability).all(axis=1), is_empty)
    results = [jl.simulate_many(survey, scene, path=path, **options)]
    min(file for file in (path / "reflectance" / "c").rglob("*") if file.is_file()).write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="damaged"):
        results.append(jl.simulate_many(survey, scene, path=path, **options))
    for stored in (*results, jl.rerun(path)):
        np.testing.assert_array_equal(stored.reflectance, many.reflectance)
        np.testing.assert_array_equal(stored.truth.gap_probability, many.truth.gap_probability)


def test_beyond_refuses_what_it_cannot_do():
    survey, scene = strip_over_relief()
    with pytest.raises(ValueError, match=r"admissible are .* Survey.within keeps those, and .*beyond='miss'"):
        jl.simulate_many(survey, scene, key=KEY)
    with pytest.raises(ValueError, match=r"beyond = 'empty'.*refuse"):
        jl.simulate_many(survey, scene, key=KEY, beyond="empty")
    with pytest.raises(ValueError, match="no shot lies within the scene"):
        jl.simulate_many(survey[:2], scene, key=KEY, beyond="miss")
    parts = jl.SceneParts(lambda low, high: scene, z=(0.0, 5.0))
    with pytest.raises(ValueError, match=r"beyond = 'miss' is given with SceneParts"):
        jl.simulate_many(survey, parts, key=KEY, beyond="miss")
