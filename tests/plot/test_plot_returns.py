"""Figures of discrete returns and stacks of waveforms: the places, colours and selections that are drawn."""

import jax
import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

import jaxlidar as jl
from jaxlidar import plot
from jaxlidar.plot.style import MATERIAL_COLOURS, material_colours

matplotlib.use("agg")

# Map coordinates, of which single precision keeps half a metre.
CORNER = np.array([5e5, 5.2e6])


def at(east, north):
    """Return a place by its distances from the corner, m."""
    return CORNER + np.array([east, north])


SLOPE = np.tan(np.deg2rad(20.0))


@pytest.fixture(scope="module")
def scene():
    """A plate over ground that rises eastward, in map coordinates."""
    x = np.linspace(0.0, 40.0, 5)
    heights = np.add.outer(SLOPE * x, np.zeros(5))
    ground = jl.Terrain(heights, spacing=10.0, origin=CORNER, relief=True)
    return jl.Scene(plates=[jl.Plate(height=30.0, reflectance=0.4, coverage=0.5)], ground=ground)


@pytest.fixture(scope="module")
def waves(scene):
    survey = jl.Survey.track(jl.Lidar(), start=at(5, 20), end=at(35, 20), spacing=10.0)
    return jl.simulate_many(survey, scene, key=jax.random.key(0), max_orders=1)


@pytest.fixture(scope="module")
def returns(waves):
    return waves.returns()


@pytest.fixture
def axes():
    return Figure().subplots()


def drawn_points(axes):
    """Return the points (n, 2) of each group by its label."""
    return {line.get_label(): line.get_xydata() for line in axes.lines if line.get_marker() == "o"}


def test_points_from_above_have_the_colours_of_their_materials(returns, axes):
    assert plot.points(returns, axes, colour_by="material") is axes
    groups = drawn_points(axes)
    assert set(groups) == {"plate", "ground"}
    for name, group in groups.items():
        chosen = returns.position[returns.material == name]
        np.testing.assert_array_equal(np.sort(group, axis=0), np.sort(chosen[:, :2], axis=0))
        (line,) = [line for line in axes.lines if line.get_label() == name]
        assert to_hex(line.get_color()).upper() == MATERIAL_COLOURS[name]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x, east (m)", "y, north (m)")


def test_the_ground_does_not_cover_what_stands_on_it(axes):
    """However many points either has; planted: the other way round, the order of their numbers is wrong."""
    position = np.stack([np.zeros(9), np.zeros(9), [0.0, 0.1, 9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 0.2]], axis=1)
    classes = np.where(position[:, 2] < 1.0, 2, 5)
    ones = np.ones(9, int)
    plot.points(jl.io.PointCloud(position, classes, ones, ones, ones, {}), axes)
    assert list(drawn_points(axes)) == ["ground", "high vegetation"]


def test_materials_of_meshes_are_told_apart():
    names = ["mesh:wall", "mesh:roof", "mesh:wire", "mesh:leaf", "mesh:wood", "ground", "mesh"]
    colours = material_colours(names)
    assert len({colours[name] for name in names[:-1]}) == len(names) - 1
    assert (colours["mesh:leaf"], colours["mesh:wood"]) == (
        MATERIAL_COLOURS["leaf"],
        MATERIAL_COLOURS["bark"],
    )
    assert colours["mesh"] == MATERIAL_COLOURS["mesh"]
    # Those of the individuals of a stand are numbered.
    assert material_colours(["mesh:leaf 12"]) == {"mesh:leaf 12": MATERIAL_COLOURS["leaf"]}
    assert material_colours(["plate 1"]) == {"plate 1": MATERIAL_COLOURS["plate"]}


def test_points_have_the_names_of_their_classes(returns, axes, tmp_path):
    plot.points(returns, axes)
    assert {name: len(group) for name, group in drawn_points(axes).items()} == {
        "ground": 4,
        "unclassified": 4,
    }
    returns.to_las(tmp_path / "strip.laz")
    recorded = Figure().subplots()
    plot.points(jl.io.read_las(tmp_path / "strip.laz"), recorded, legend=False)
    assert {name: len(group) for name, group in drawn_points(recorded).items()} == {
        "ground": 4,
        "unclassified": 4,
    }
    assert recorded.get_legend() is None


def test_points_coloured_by_height_have_a_bar(returns, axes):
    plot.points(returns, axes, colour_by="height above ground")
    (points,) = axes.collections
    values = np.sort(np.asarray(points.get_array()))
    assert np.allclose(values[:4], 0.0, atol=0.05)
    above = 30.0 - SLOPE * np.array([35.0, 25.0, 15.0, 5.0])
    assert np.allclose(values[4:], above, atol=0.1)
    assert axes.figure.axes[1].get_ylabel() == "height above ground (m)"


def test_an_oblique_view_has_all_points_and_equal_scales(returns):
    axes = Figure().add_subplot(projection="3d")
    assert plot.points(returns, axes, view="oblique", colour_by="material", azimuth=180.0) is axes
    assert sum(len(line.get_data_3d()[2]) for line in axes.lines) == len(returns)
    spans = [np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    assert np.allclose(np.divide(spans, axes._box_aspect), spans[0] / axes._box_aspect[0])
    # From the south: matplotlib's azimuth of -90 degrees.
    assert axes.azim == -90.0


def test_a_section_has_the_returns_of_its_width_over_the_ground(returns, scene, axes):
    """A line from north-west to south-east crosses the track at one shot; its neighbours are 7 m off."""
    start, end = at(15, 30), at(35, 10)
    plot.section(returns, start, end, axes, width=8.0, scene=scene, colour_by="material")
    groups = drawn_points(axes)
    # The middle of the line, 10 sqrt(2) from its start, is the shot at x = 25 m.
    assert np.allclose(groups["plate"], [[10 * np.sqrt(2.0), 30.0]], atol=0.02)
    assert np.allclose(groups["ground"], [[10 * np.sqrt(2.0), 25 * SLOPE]], atol=0.1)
    (ground,) = [line for line in axes.lines if line.get_label() == "_terrain"]
    distance, height = ground.get_data()
    assert np.allclose(height, SLOPE * (15.0 + distance / np.sqrt(2.0)), atol=2e-3)
    wide = Figure().subplots()
    plot.section(returns, start, end, wide, width=15.0, colour_by="material")
    assert len(drawn_points(wide)["ground"]) == 3


def test_a_section_leaves_the_ground_blank_where_there_is_none(returns, scene, axes):
    plot.section(returns, at(-20, 20), at(60, 20), axes, scene=scene)
    (ground,) = [line for line in axes.lines if line.get_label() == "_terrain"]
    distance, height = ground.get_data()
    np.testing.assert_array_equal(np.isfinite(height), (distance >= 20.0) & (distance <= 60.0))


def test_a_waterfall_has_the_waveforms_at_their_places(waves, axes):
    assert plot.waterfall(waves, axes, overlap=2.0) is axes
    totals = [line for line in axes.lines if line.get_label()[0] == "_"]
    assert len(totals) == len(waves)
    # From right to left; the largest sample of all reaches over two spacings.
    peaks = []
    for total, place, i in zip(totals, (30.0, 20.0, 10.0, 0.0), (3, 2, 1, 0)):
        x, height = total.get_data()
        wave = waves[i]
        k = int(np.argmax(wave.reflectance[0]))
        peaks.append(x.max() - place)
        assert height[np.argmax(x)] == pytest.approx(float(wave.height[k]))
        assert x.max() - place == pytest.approx(20.0 * wave.reflectance.max() / waves.reflectance.max())
    assert max(peaks) == pytest.approx(20.0)
    (ground,) = [line for line in axes.lines if line.get_label() == "true ground"]
    assert np.allclose(ground.get_ydata(), SLOPE * np.array([5.0, 15.0, 25.0, 35.0]), atol=0.1)
    named = {text.get_text() for text in axes.get_legend().get_texts()}
    assert named == {"true ground", "ground", "plate"}


def test_a_waterfall_of_chosen_shots_and_distances(waves, axes):
    plot.waterfall(waves, axes, shots=[3, -4], distance=[100.0, 70.0], quantity="recorded", legend=False)
    lefts = [line.get_xdata().min() for line in axes.lines if line.get_label()[0] == "_"]
    assert np.allclose(lefts, [100.0, 70.0], atol=0.2)
    assert axes.get_legend() is None
    assert axes.get_title().endswith("J per sample")


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda w, r: plot.points(r, view="below"), ValueError, "view = 'below' is none of"),
        (lambda w, r: plot.points(r, colour_by="colour"), ValueError, "colour_by = 'colour' is none of"),
        (lambda w, r: plot.points(r, size=0.0), ValueError, "size = 0 is outside"),
        (lambda w, r: plot.points(w.returns(threshold=1.0)), ValueError, "returns has no return"),
        (lambda w, r: plot.section(r, (0, 0), (0, 0)), ValueError, "start and end are both"),
        (
            lambda w, r: plot.section(r, (0, 0), (1, 0)),
            ValueError,
            r"no return lies within 1 m .* reach from",
        ),
        (lambda w, r: plot.section(r, (0, 0), (1, 0), width=0.0), ValueError, "width = 0 is outside"),
        (lambda w, r: plot.waterfall(w, shots=[9]), ValueError, r"shots = 9 is outside .* \[-4, 3\]"),
        (lambda w, r: plot.waterfall(w, shots=slice(0, 0)), ValueError, "shots has 0 shots; admissible"),
        (lambda w, r: plot.waterfall(w, distance=[1.0]), ValueError, r"distance has shape \(1,\)"),
        (lambda w, r: plot.waterfall(w, wavelength=700.0), ValueError, "wavelength = 700 nm is none"),
    ],
)
def test_inadmissible_input_is_refused(waves, returns, call, error, message):
    with pytest.raises(error, match=message):
        call(waves, returns)


def test_points_of_a_file_have_no_materials(returns, tmp_path):
    returns.to_las(tmp_path / "strip.las")
    cloud = jl.io.read_las(tmp_path / "strip.las")
    for colour_by in ("material", "height above ground"):
        with pytest.raises(TypeError, match=f"colour_by = '{colour_by}' of a PointCloud"):
            plot.points(cloud, Figure().subplots(), colour_by=colour_by)
