"""Figures: data and units that are drawn, on the given axes or new ones."""

import equinox as eqx
import jax
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxlidar as jl
from jaxlidar import plot
from jaxlidar.formats.icesat2 import PhotonTrack
from jaxlidar.plot.style import check_waveform

matplotlib.use("agg")

WAVELENGTHS = (532.0, 1064.0, 1550.0)


def canopy_scene(**ground):
    voxels = jl.VoxelMap.from_extinction(
        leaf=np.full((2, 3, 4), 0.3), bark=np.full((2, 3, 4), 0.02), voxel_size=1.0, origin=(-1.0, -1.5, 2.0)
    )
    leaf = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
    return jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, bark=0.3, hotspot=False), ground=jl.Ground(**ground))


@pytest.fixture(scope="module")
def wave():
    lidar = jl.Lidar(wavelength=WAVELENGTHS, divergence=1.0)
    sizes = {"n_photons": 2048, "n_rays": 64, "max_orders": 3, "window": (-60.0, 120.0)}
    return jl.simulate(lidar, canopy_scene(), key=jax.random.key(0), **sizes)


@pytest.fixture
def axes():
    return Figure().subplots()


def lines_of(axes):
    """Return the data of the lines by their labels."""
    return {line.get_label(): line.get_xydata() for line in axes.lines}


def test_waveform_has_height_upward_and_its_components(wave, axes):
    assert plot.waveform(wave, axes, wavelength=1064.0) is axes
    lines = lines_of(axes)
    assert np.allclose(lines["total"][:, 0], wave.reflectance[1])
    assert np.allclose(lines["total"][:, 1], wave.height)
    assert np.allclose(lines["scattered twice\nor more"][:, 0], wave.components["higher"][1])
    named = {text.get_text() for text in axes.get_legend().get_texts()}
    assert named == {"leaf", "bark", "ground", "scattered twice\nor more", "total"}
    assert axes.get_ylabel() == "height (m)"
    assert axes.get_xlabel() == "apparent reflectance\nper sample of 1 ns"
    low, high = axes.get_ylim()
    assert low < 0 < 6 < high
    assert axes.get_xlim()[0] == 0


def test_waveform_of_several_wavelengths_draws_their_totals(wave, axes):
    plot.waveform(wave, axes)
    assert [name for name in lines_of(axes) if name[0] != "_"] == ["532 nm", "1064 nm", "1550 nm"]


def test_waveform_band_is_in_standard_errors(wave, axes):
    plot.waveform(wave, axes, wavelength=532.0, components=False, sigma=3.0)
    wide, narrow = axes.collections
    i = int(np.argmax(wave.stderr[0]))
    at = np.isclose(wide.get_paths()[0].vertices[:, 1], float(wave.height[i]))
    width = np.ptp(wide.get_paths()[0].vertices[at, 0])
    assert np.isclose(width, 6.0 * float(wave.stderr[0, i]), rtol=1e-3)
    at = np.isclose(narrow.get_paths()[0].vertices[:, 1], float(wave.height[i]))
    assert np.isclose(np.ptp(narrow.get_paths()[0].vertices[at, 0]), 0.5 * width, rtol=1e-3)


def test_waveform_in_joules(wave, axes):
    plot.waveform(wave, axes, wavelength=1550.0, quantity="energy", label="sent back", color="red")
    (line,) = axes.lines
    assert np.allclose(line.get_xdata(), wave.energy[2])
    assert (line.get_label(), line.get_color()) == ("sent back", "red")
    assert axes.get_xlabel() == "energy per sample of 1 ns (J)"


def test_empty_and_noisy_waveforms_are_drawn(wave, axes):
    empty = jax.tree.map(jax.numpy.zeros_like, wave)
    plot.waveform(empty, axes, wavelength=0.0)
    axes.clear()
    noisy = jax.tree.map(lambda a: a - 0.001, wave)
    plot.waveform(noisy, axes, wavelength=float(noisy.wavelength[0]))
    assert axes.get_xlim()[0] < 0


def one_sample(wave):
    """Return the largest sample of a waveform as a waveform."""
    i = int(np.argmax(wave.reflectance[1]))
    return jax.tree.map(lambda a: a[..., i : i + 1] if a.shape[-1:] == wave.time.shape else a, wave)


def test_single_points_have_markers(wave):
    """Planted: lines of one point, which are not seen."""
    single = one_sample(wave)
    drawn = [
        plot.waveform(single, Figure().subplots(), wavelength=1064.0),
        plot.spectrum(jl.Prospect(), Figure().subplots(), wavelength=[1064.0]),
        plot.spectrum(jl.spectrum("soil-medium"), Figure().subplots(), wavelength=[1064.0]),
        plot.fit(single, single.reflectance, 0.1, Figure().subplots(1, 2), wavelength=1064.0)[0],
    ]
    for axes in drawn:
        assert axes.lines
        assert all(line.get_marker() not in ("", "None") for line in axes.lines)


def test_many_wavelengths_have_a_colour_each_and_a_bar():
    """Planted: six colours in turn, and legends that leave the axes no room, of which matplotlib warns."""
    from matplotlib import pyplot

    lidar = jl.Lidar(wavelength=np.linspace(450.0, 2300.0, 12))
    wave = jl.simulate(lidar, jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    axes = plot.waveform(wave)
    assert len({line.get_color() for line in axes.lines}) == 12
    assert axes.get_legend() is None
    assert axes.figure.axes[1].get_ylabel() == "wavelength (nm)"
    pair = plot.fit(wave, 1.01 * wave.reflectance, 0.001)
    assert [text.get_text() for text in pair[0].get_legend().get_texts()] == ["observed", "fitted"]
    assert len({line.get_color() for line in pair[0].lines}) == 12
    for figure in (axes.figure, pair[0].figure):
        figure.canvas.draw()
        assert min(ax.get_window_extent().height for ax in figure.axes) > 0.6 * figure.bbox.height
        pyplot.close(figure)


def texts_of(axes):
    return [text.get_text() for text in axes.texts]


def test_figures_without_anything_to_draw_say_so(wave):
    missing = np.full(wave.reflectance.shape, np.nan)
    axes = plot.residuals(wave, missing, 0.1, Figure().subplots())
    assert texts_of(axes) == ["no values"]
    # A missing sample is left blank: neither the others nor the limits of heights depend on it.
    part = np.array(wave.reflectance)
    part[:, 3] = np.nan
    axes = plot.residuals(wave, part, 0.1, Figure().subplots())
    whole = plot.residuals(wave, wave.reflectance, 0.1, Figure().subplots())
    assert texts_of(axes) == []
    assert axes.get_ylim() == whole.get_ylim()
    survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(10, 10), spacing=10.0)
    axes = plot.survey(survey, ax=Figure().subplots(), values=np.full(4, np.nan))
    assert texts_of(axes) == ["no values"]
    assert len(axes.figure.axes) == 1
    axes = plot.energy_budget(jax.tree.map(lambda a: 0.0 * a, wave), Figure().subplots())
    assert texts_of(axes) == ["no light"]
    dark = eqx.tree_at(lambda w: w.energy, wave, 0.0 * wave.energy)
    events = jl.PhotonCounter().count(dark, key=jax.random.key(0))
    with pytest.raises(ValueError, match="events has no event; admissible is one or more"):
        plot.photons(events)


def test_residuals_are_in_standard_deviations(wave, axes):
    observed = np.asarray(wave.reflectance) + 0.002
    observed[1, 5] += 1.0
    assert plot.residuals(wave, observed, 0.001, axes, wavelength=1064.0) is axes
    points = np.concatenate([line.get_xydata() for line in axes.lines if line.get_marker() == "o"])
    assert np.allclose(points[:, 0], 2.0, atol=1e-3)
    (beyond,) = [
        line.get_xydata() for line in axes.lines if line.get_marker() == ">" and len(line.get_xdata())
    ]
    assert np.allclose(beyond, [[0.97 * 5, float(wave.height[5])]])
    assert axes.get_xlim() == (-5.0, 5.0)


def test_scene_shows_canopy_plates_ground_and_beam(axes):
    scene = canopy_scene(height=0.5, slope=10.0, aspect=90.0)
    scene = jl.Scene(canopy=scene.canopy, ground=scene.ground, plates=(jl.Plate(1.0, 0.3),))
    lidar = jl.Lidar(divergence=2.0, position=(0.5, 0.0))
    assert plot.scene(scene, lidar, axes) is axes
    named = {text.get_text() for text in axes.get_legend().get_texts()}
    assert named == {"leaf", "bark", "ground", "plate", "beam (1/e²)"}
    leaf = axes.images[0]
    assert leaf.get_extent() == [-1.0, 1.0, 2.0, 6.0]
    assert np.allclose(leaf.get_array(), 1 - np.exp(-0.9))
    edges = [line.get_xydata() for line in axes.lines if line.get_label() == "beam (1/e²)"]
    at_ground = sorted(float(np.interp(0.0, e[:, 1], e[:, 0])) for e in edges)
    assert np.allclose(at_ground, [-0.5, 1.5], atol=0.01)
    # The ground falls eastward.
    outline = axes.collections[0].get_paths()[0].vertices
    top = {x: outline[outline[:, 0] == x, 1].max() for x in (outline[:, 0].min(), outline[:, 0].max())}
    (west, high), (east, low) = sorted(top.items())
    assert np.isclose((low - high) / (east - west), -np.tan(np.deg2rad(10.0)), rtol=1e-4)
    assert np.isclose(high, 0.5 - west * np.tan(np.deg2rad(10.0)), rtol=1e-4)
    assert axes.get_ylabel() == "height (m)"


def test_scene_from_the_east_and_of_a_tilted_beam(axes):
    lidar = jl.Lidar(zenith=20.0, azimuth=0.0, divergence=2.0)
    plot.scene(canopy_scene(), lidar, axes, along="x", legend=False)
    assert axes.get_xlabel() == "y, north (m)"
    assert axes.get_legend() is None
    first, second = (line.get_xydata() for line in axes.lines if line.get_label() == "beam (1/e²)")
    axis = 0.5 * (first + second)
    lean = np.diff(axis[:, 0]) / np.diff(axis[:, 1])
    # Light that travels north comes from the south.
    assert np.allclose(lean, -np.tan(np.deg2rad(20.0)), rtol=1e-3)


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("zenith", [0.0, 70.0, 90.0, 150.0])
def test_a_beam_from_its_sensor_is_in_the_figure(axes, along, zenith):
    """Planted: the width of the beam 1 m ahead of the sensor."""
    scene = jl.Scene(ground=jl.Ground(), plates=(jl.Plate(3.0, 0.3),))
    lidar = jl.Lidar(sensor=(40.0, 50.0, 1.7), zenith=zenith, azimuth=30.0)
    plot.scene(scene, lidar, axes, along=along)
    k = 0 if along == "y" else 1
    direction = np.asarray(lidar.direction, float)
    # To the ground, to the plate, or four times the height of the scene far.
    length = {0.0: 1.7, 70.0: 1.7 / np.cos(np.deg2rad(70.0)), 90.0: 12.0, 150.0: 1.3 / np.cos(np.pi / 6)}
    ends = np.array([40.0, 50.0])[k] + np.array([0.0, length[zenith] * direction[k]])
    low, high = axes.get_xlim()
    assert low < ends.min()
    assert ends.max() < high
    assert 1.79 < high - low < 2.0 + np.ptp(ends)
    bottom, top = axes.get_ylim()
    assert bottom < 0 < 3 < top < 4


def test_a_beam_from_its_sensor_is_as_wide_from_the_side_as_from_behind(axes):
    """Planted: edges that narrow where the beam travels along the view."""
    lidar = jl.Lidar(sensor=(0.0, 0.0, 10.0), zenith=60.0, azimuth=10.0, divergence=50.0)
    plot.scene(jl.Scene(ground=jl.Ground()), lidar, axes)
    edges = [line.get_xydata() for line in axes.lines if line.get_label() == "beam (1/e²)"]
    (start, first), (_, second) = edges
    middle = 0.5 * (first + second)
    length = np.linalg.norm(middle - start) / np.linalg.norm(np.asarray(lidar.direction)[[0, 2]])
    assert np.linalg.norm(first - second) == pytest.approx(0.05 * length, rel=1e-4)


@pytest.mark.parametrize("place", [{}, {"sensor": (0.0, 0.0, 1000.0)}])
@pytest.mark.parametrize(
    ("azimuth", "turn", "along", "width"),
    [
        # Seen northward, a beam that travels north shows its level axis, and from the east the other one.
        (0.0, 0.0, "y", 8.0),
        (0.0, 0.0, "x", 2.0),
        (90.0, 0.0, "y", 2.0),
        (0.0, 90.0, "y", 2.0),
        (0.0, 45.0, "y", np.sqrt(0.5 * (8.0**2 + 2.0**2))),
    ],
)
def test_an_elliptical_beam_is_as_wide_as_it_looks(axes, place, azimuth, turn, along, width):
    """Planted: the longer axis for both."""
    lidar = jl.Lidar(divergence=2.0, level_divergence=8.0, azimuth=azimuth, ellipse_turn=turn, **place)
    plot.scene(jl.Scene(ground=jl.Ground()), lidar, axes, along=along)
    edges = [line.get_xydata() for line in axes.lines if line.get_label() == "beam (1/e²)"]
    # From the lower end, as heights must increase.
    at_ground = [float(np.interp(0.0, *edge[np.argsort(edge[:, 1])].T[::-1])) for edge in edges]
    assert abs(at_ground[1] - at_ground[0]) == pytest.approx(width, rel=1e-3)


def test_terrain_is_drawn_at_the_middle_of_the_map(axes):
    heights = np.add.outer([0.0, 2.0, 1.0, 3.0], [0.0, 0.5])
    terrain = jl.Terrain(heights, (1.0, 3.0), (-1.5, -1.5))
    scene = jl.Scene(canopy=canopy_scene().canopy, ground=terrain)
    plot.scene(scene, ax=axes)
    outline = axes.collections[0].get_paths()[0].vertices
    for x, height in ((-1.0, 1.25), (-0.5, 2.25), (0.5, 1.25), (1.0, 2.25)):
        near = np.isclose(outline[:, 0], x, atol=2e-3)
        assert np.isclose(outline[near, 1].max(), height, atol=0.01)
    axes.clear()
    plot.scene(jl.Scene(ground=terrain), ax=axes, along="x")
    assert axes.get_xlim() == (-1.5, 1.5)


@pytest.mark.parametrize("along", ["x", "y"])
def test_scenes_in_map_coordinates_are_drawn_where_they_stand(axes, along):
    """Planted: limits that take in the origin of the map, and meshes that end at the voxels."""
    corner = np.array([4e5, 5.3e6, 700.0])
    canopy = canopy_scene().canopy
    voxels = eqx.tree_at(lambda v: v.origin, canopy.voxels, corner)
    canopy = eqx.tree_at(lambda c: c.voxels, canopy, voxels)
    corners = corner + np.array([[5, 6, 3], [9, 6, 3], [9, 11, 3]])
    roof = jl.MeshSurface((corners, [[0, 1, 2]]), reflectance=0.4)
    terrain = jl.Terrain(np.full((9, 9), 699.0), 5.0, corner[:2] - 10.0)
    end = corner + np.asarray(voxels.voxel_size) * voxels.shape
    k = 0 if along == "y" else 1
    plot.scene(jl.Scene(canopy=canopy, ground=terrain), ax=axes, along=along)
    np.testing.assert_allclose(axes.get_xlim(), [corner[k], end[k]], rtol=0, atol=1e-6)
    assert axes.get_ylim()[0] > 698.0
    plot.scene(jl.Scene(canopy=canopy, meshes=[roof], ground=terrain), ax=axes, along=along)
    np.testing.assert_allclose(axes.get_xlim(), [corner[k], corner[k] + (9, 11)[k]], rtol=0, atol=1e-6)
    axes.clear()
    plot.scene(jl.Scene(meshes=[roof]), ax=axes, along=along)
    np.testing.assert_allclose(axes.get_xlim(), corner[k] + np.array([(5, 9), (6, 11)][k]), rtol=0, atol=1e-6)
    assert 702.0 < axes.get_ylim()[0] < axes.get_ylim()[1] < 704.0
    axes.clear()
    plot.scene(jl.Scene(ground=jl.Ground(500.0)), ax=axes, along=along)
    assert axes.get_ylim()[0] > 499.0


def test_an_empty_scene_and_new_figures():
    from matplotlib import pyplot

    for axes in (plot.scene(jl.Scene()), plot.scene(jl.Scene(), jl.Lidar(profile="top-hat"))):
        assert axes.get_ylabel() == "height (m)"
        pyplot.close(axes.figure)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: plot.waveform(w, wavelength=700.0), "wavelength = 700 nm is none of the waveform's: 532"),
        (lambda w: plot.waveform(w, quantity="power"), "quantity = 'power' is none of"),
        (lambda w: plot.waveform(w, sigma=-1.0), "sigma = -1 is outside"),
        (lambda w: plot.residuals(w, np.zeros(3), 1.0), r"observed has shape \(3,\)"),
        (lambda w: plot.residuals(w, w.reflectance, np.ones(3)), r"noise has shape \(3,\)"),
        (lambda w: plot.residuals(w, w.reflectance, 0.0), "noise = 0 is outside"),
        (lambda w: plot.residuals(w, w.reflectance, 1.0, limit=0.0), "limit = 0 is outside"),
        (lambda w: plot.scene(jl.Scene(), along="z"), "along = 'z' is none of"),
    ],
)
def test_inadmissible_input_is_refused(wave, call, message):
    with pytest.raises(ValueError, match=message):
        call(wave)


def test_a_survey_is_drawn_where_its_beams_meet_the_terrain(axes):
    """At 400 m above sea level an oblique beam meets the ground 400 tan(zenith) before its aim point."""
    terrain = jl.Terrain(np.full((21, 21), 400.0), spacing=10.0, origin=(5e5 - 100.0, 5.2e6 - 100.0))
    # The aim point lies 400 m east of where the beam meets the terrain.
    survey = jl.Survey(
        jl.Lidar(altitude=1000.0, divergence=20.0), [(5e5 + 400.0, 5.2e6)], zenith=45.0, azimuth=90.0
    )
    plot.survey(survey, jl.Scene(ground=terrain), axes)
    (footprint,) = [c for c in axes.collections if hasattr(c, "_widths")]
    np.testing.assert_allclose(footprint.get_offsets()[0], [5e5, 5.2e6], atol=0.01)
    # 600 m of range per 1000 m: widths of the ellipse are in points of data, halved.
    np.testing.assert_allclose(np.ravel(footprint._heights)[0], 0.6 * 1e-2 * 1000 * np.sqrt(2.0), rtol=1e-3)
    assert len(axes.images) == 1
    axes.figure.canvas.draw()
    labels = [t.get_text() for t in axes.get_xticklabels()]
    assert 2 <= len(labels) <= 7
    assert all(len(label) == 6 and label.startswith(("4", "5")) for label in labels if label)
    # A track is a strip, which leaves its labels room.
    track = jl.Survey.track(jl.Lidar(), (5e5, 5.2e6), (5e5 + 4000.0, 5.2e6), 10.0)
    strip = plot.survey(track, ax=Figure().subplots())
    assert np.ptp(strip.get_ylim()) == pytest.approx(0.4 * np.ptp(strip.get_xlim()))
    assert len([y for y in strip.get_yticks() if strip.get_ylim()[0] <= y <= strip.get_ylim()[1]]) <= 2
    # Shots of sensors that meet no ground are drawn as their sensors.
    sky = jl.Survey(jl.Lidar(), sensor=[(5.0, 6.0, 2.0)], zenith=150.0)
    ax = Figure().subplots()
    plot.survey(sky, jl.Scene(ground=jl.Ground()), ax)
    np.testing.assert_allclose(ax.collections[0].get_offsets()[0], [5.0, 6.0])
    assert plot.scene(jl.Scene(ground=jl.Ground()), sky[0], Figure().subplots()).lines


def test_waveforms_of_a_survey_are_refused_with_what_to_draw():
    """Tests check annotations before the functions do; this is the check of all that draw one waveform."""
    survey = jl.Survey(jl.Lidar(), np.array([[0.0, 0.0], [5.0, 0.0]]))
    scene = jl.Scene(ground=jl.Ground())
    waveforms = jl.simulate_many(survey, scene, key=jax.random.key(0), rtol=0.1, max_orders=1)
    says = r"wave is a Waveforms of 2 shots; admissible is the Waveform of one shot, as in many\[0\]"
    with pytest.raises(TypeError, match=says):
        check_waveform(waveforms)
    assert plot.waveform(waveforms[0], Figure().subplots()).lines


def test_the_energy_budget_adds_up_to_100_percent(wave, axes):
    assert plot.energy_budget(wave, axes) is axes
    assert [t.get_text() for t in axes.get_yticklabels()] == ["532 nm", "1064 nm", "1550 nm"]
    ends = np.zeros(3)
    for bar in axes.patches:
        row = round(bar.get_y() + 0.4)
        ends[row] = max(ends[row], bar.get_x() + bar.get_width())
    assert np.allclose(ends, 100.0, atol=0.2)
    bars = {bar.get_label(): [rectangle.get_width() for rectangle in bar] for bar in axes.containers}
    assert np.allclose(bars["absorbed by leaf"], 100 * np.asarray(wave.energy_budget["absorbed by leaf"]))


def test_accuracy_has_the_error_and_the_target(wave, axes):
    steps = [jl.Progress(65536 * n, None, 0.1 * n, "photons", error=0.02 / n**0.5, rtol=0.01) for n in (4, 1)]
    assert plot.accuracy(steps, axes) is axes
    lines = lines_of(axes)
    assert np.allclose(lines["relative error"], [[65536, 0.02], [262144, 0.01]])
    assert np.allclose(np.prod(lines["square root of the photons"] ** [0.5, 1.0], axis=1), 0.01 * 512)
    assert "aim 0.01" in lines
    axes.clear()
    plot.accuracy([wave], axes)
    assert lines_of(axes)["relative error"][0, 0] == wave.info["photons"]
    with pytest.raises(ValueError, match="steps has no photons"):
        plot.accuracy([], axes)


def test_spectra_of_leaves_and_surfaces(axes):
    leaf = jl.Prospect(Cab=20.0)
    assert plot.spectrum(leaf, axes, wavelength=[532.0, 1064.0]) is axes
    lines = lines_of(axes)
    R, T = leaf([532.0, 1064.0])
    assert np.allclose(lines["reflectance"][:, 1], R)
    assert np.allclose(lines["transmittance"][:, 1], T)
    plot.spectrum(jl.LeafOptics(reflectance=0.9), axes, label="bright")
    plot.spectrum(jl.spectrum("soil-medium"), axes)
    assert {"bright", "soil-medium"} <= set(lines_of(axes))
    # The limits include the lines of all calls.
    assert axes.get_ylim()[1] > 0.9


def test_fit_shows_data_model_and_residuals(wave):
    observed = np.asarray(wave.reflectance) + 0.002
    pair = Figure().subplots(1, 2)
    waveform_axes, residual_axes = plot.fit(wave, observed, 0.001, pair, wavelength=1064.0)
    assert np.allclose(lines_of(waveform_axes)["observed"][:, 0], observed[1])
    assert np.allclose(lines_of(waveform_axes)["fitted"][:, 0], wave.reflectance[1])
    points = np.concatenate([line.get_xydata() for line in residual_axes.lines if line.get_marker() == "o"])
    assert np.allclose(points[:, 0], 2.0, atol=1e-3)
    with pytest.raises(ValueError, match="axes has 1 axes; admissible are 2"):
        plot.fit(wave, observed, 0.001, [waveform_axes])


def test_photons_are_drawn_at_their_heights_in_the_colours_of_their_labels(axes):
    wave = jl.simulate(jl.Lidar(energy=1e-9), jl.Scene(ground=jl.Ground(height=2.0)), key=jax.random.key(0))
    sun = jl.PhotonCounter(background_rate=1e7)
    events = sun.count(wave, key=jax.random.key(1), pulses=50)
    assert plot.photons(events, ax=axes) is axes
    lines = lines_of(axes)
    assert np.array_equal(lines["signal"][:, 1], events.height[events.signal])
    assert np.array_equal(lines["noise"][:, 1], events.height[~events.signal])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("shot", "height (m)")
    axes.clear()
    label = np.where(events.height > 2.0, 2, 1)
    plot.photons(events, [70.0], axes, label=label, color="red")
    lines = lines_of(axes)
    assert set(lines) == {"ground", "canopy"}
    # Photons are large enough to be seen, and the legend stands beside the axes.
    assert all(line.get_markersize() >= 3 for line in axes.lines)
    assert axes.get_legend().get_bbox_to_anchor().transformed(axes.transAxes.inverted()).x0 == pytest.approx(
        1.0
    )
    assert np.array_equal(lines["canopy"][:, 1], events.height[label == 2])
    assert np.all(lines["canopy"][:, 0] == 70.0)
    assert {line.get_color() for line in axes.lines} == {"red"}
    assert axes.get_xlabel() == "distance along the track (m)"
    with pytest.raises(ValueError, match=r"distance has shape \(2,\)"):
        plot.photons(events, [1.0, 2.0], axes)
    with pytest.raises(ValueError, match=r"label = 4 is outside the admissible range \[0, 3\]"):
        plot.photons(events, ax=axes, label=label + 2)


def test_a_recorded_track_is_drawn_about_its_ground(axes):
    n = 50
    zero, one = np.zeros(n), np.zeros(1)
    height = np.r_[np.full(25, 100.0), np.linspace(-200.0, 300.0, 25)]
    track = PhotonTrack(
        beam="gt1r",
        distance=np.arange(float(n)),
        height=height,
        latitude=zero,
        longitude=zero,
        time=zero,
        pulse=np.arange(n),
        confidence=np.repeat([4, 0], 25),
        quality=np.zeros(n, int),
        background_rate=zero,
        segment=np.zeros(n, int),
        segment_id=np.array([1]),
        segment_start=one,
        segment_length=one + 50.0,
        segment_latitude=one,
        segment_longitude=one,
        solar_elevation=one,
    )
    plot.photons(track, ax=axes)
    assert set(lines_of(axes)) == {"signal", "noise"}
    axes.clear()
    plot.photons(track, ax=axes, label=np.repeat([1, 0], 25))
    assert axes.get_ylim() == (90.0, 110.0)
    assert axes.get_xlabel() == "distance along the track (m)"
    with pytest.raises(ValueError, match="distance is given; admissible for a PhotonTrack is None"):
        plot.photons(track, [1.0], axes)
