"""Cases as TOML: every class is read bit for bit as it was written, and bad files are refused by place."""

import dataclasses
import inspect
import shutil
import tomllib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jaxlidar as jl
from jaxlidar.optics.coefficients import shipped
from jaxlidar.results.kinds import arguments_of, kinds

SCENES = sorted((Path(__file__).resolve().parents[2] / "examples" / "scenes").glob("*.toml"))
RANDOM = np.random.default_rng(0)
SPECTRUM = jl.Spectrum([400.0, 1000.1, 2400.0], [0.1, 1 / 3, 0.4], name="none", scale=0.7)
MAP = jl.VoxelMap(RANDOM.random((2, 3, 4)), RANDOM.random((2, 3, 4)) / 9, (0.1, 0.2, 1 / 3), (-0.1, 1e-9, 3))
ANGLED = jl.VoxelMap.from_lad(RANDOM.random((1, 1, 2)), voxel_size=0.7, leaf_angles="planophile")


def with_ground(**fields):
    """Return a scene of ground alone."""
    return jl.Scene(ground=jl.Ground(**fields))


def with_leaf(leaf, **fields):
    """Return a scene of a small canopy, with the optics of its leaves."""
    return jl.Scene(canopy=jl.Canopy(ANGLED, leaf=leaf, **fields))


def prospect_pro():
    """Return leaves of PROSPECT-PRO, of which the coefficients are given as a table."""
    table = shipped("PC")
    return jl.Prospect(N=1.7, Cp=1 / 900, Cc=0.005, version="PRO", coefficients=table)


# A lidar, survey or scene for every class that a case can hold, with values other than the defaults. The key
# is the name of the class, followed by a comma and what is special about this example.
EXAMPLES = {
    "Lidar": jl.Lidar(
        wavelength=(532.1, 1064.0), altitude=1 / 3e-4, energy=(1e-3, 2e-4), position=(0.1, -0.0), zenith=7.7,
        profile="top-hat", field_of_view=0.7, efficiency=0.3, jitter=0.123456789, azimuth=-1e-8,
    ),
    "Receiver": jl.Lidar(receiver=jl.Receiver(1e-17, 3e-15, 8, 1e-18, False, 2e-18, "first return")),
    "PhotonCounter": jl.Lidar(receiver=jl.PhotonCounter(4, 3.3, (0.1, 1 / 3), 1e6, 0.2, (-10.1, 1 / 3))),
    "PhotonCounter, with a scan": jl.Lidar(
        receiver=jl.PhotonCounter(), scan=jl.Oscillating(20.1, 1 / 3, motion="triangle")
    ),
    "GaussianPulse": jl.Lidar(pulse=jl.GaussianPulse(fwhm=0.1 + 0.2)),
    "RectangularPulse": jl.Lidar(pulse=jl.RectangularPulse(length=1e-3 / 7)),
    "ExponentiallyModifiedGaussianPulse": jl.Lidar(pulse=jl.ExponentiallyModifiedGaussianPulse(1.1, 2 / 3)),
    "SampledPulse": jl.Lidar(pulse=jl.SampledPulse([0.0, 0.3, 1.0], [1.0, 1 / 7, 0.0])),
    "SampledPulse, long": jl.Lidar(pulse=jl.SampledPulse(np.arange(200.0) / 7, RANDOM.random(200))),
    "Scene": jl.Scene(),
    "Ground": with_ground(height=1 / 3, reflectance=(0.1, 0.2), slope=89.9, aspect=-720.1),
    "Plate": jl.Scene(plates=[jl.Plate(1.1, 0.2, 0.3), jl.Plate(2.2, [0.1], 0.0, 0.5, 1.0, 2.0, "diffuse")]),
    "Terrain": jl.Scene(ground=jl.Terrain(
        RANDOM.random((3, 2)), (0.7, 1 / 3), (4e6 / 7, 1e-9), RANDOM.random((3, 2)), sides="periodic",
        relief=False,
    )),
    "Survey": jl.Survey(
        jl.Lidar(altitude=1 / 3e-4), 6e5 + RANDOM.random((40, 2)), RANDOM.random(40), 1 / 3
    ),
    "Survey, of a scanner": jl.Survey(
        jl.Lidar(), RANDOM.random((3, 2)), gps_time=3.2e8 + RANDOM.random(3), scan_angle=RANDOM.random(3)
    ),
    "Survey, sensors": jl.Survey(
        jl.Lidar(), sensor=6e5 + RANDOM.random((3, 3)), zenith=100 / 3, gps_time=RANDOM.random(3)
    ),
    "Lidar, sensor": jl.Lidar(sensor=6e5 + RANDOM.random(3), zenith=400 / 3),
    "EqualAngle": with_ground(law=jl.EqualAngle()),
    "Lambertian": jl.Scene(plates=(jl.Plate(1.0, 0.1, law=jl.Lambertian()),)),
    "Specular": with_ground(law=jl.Specular(roughness=0.0123)),
    "Atmosphere": jl.Scene(atmosphere=jl.Atmosphere(None, False, "kruse", 8000.1, 1200.2, 50.5, -1.0)),
    "Spectrum": with_ground(reflectance=SPECTRUM),
    "Spectrum, long": with_ground(reflectance=jl.spectrum("soil-medium")),
    "Canopy": jl.Scene(canopy=jl.Canopy(MAP, jl.LeafOptics(0.4), SPECTRUM, "straight", True, "periodic")),
    "VoxelMap": jl.Scene(canopy=jl.Canopy(MAP, jl.LeafOptics(0.4), 0.1, hotspot=False)),
    "LeafAngles": with_leaf(jl.LeafOptics(0.4, 0.3)),
    "LeafOptics": with_leaf(jl.LeafOptics((0.4, 0.3), (0.1, 1 / 3))),
    "Isotropic": with_leaf(jl.Isotropic((0.9, 1.0))),
    "HenyeyGreenstein": with_leaf(jl.LeafOptics(0.1), bark=jl.HenyeyGreenstein(0.9, 1 / 3)),
    "Prospect": with_leaf(jl.Prospect(N=1.1, Cab=1 / 3, version="5", alpha=39.123456789)),
    "Coefficients": with_leaf(prospect_pro()),
}  # fmt: skip


def case_of(example):
    """Return a case that holds a lidar, a survey or a scene."""
    fields = {jl.Lidar: "lidar", jl.Survey: "survey", jl.Scene: "scene"}
    return jl.io.Case(**{fields[type(example)]: example})


def round_trip(case, tmp_path):
    """Write a case, move its files to another folder, and read it."""
    jl.io.write_case(tmp_path / "a.toml", case)
    # The TOML file must refer to the file of its arrays by a relative path.
    (tmp_path / "moved").mkdir()
    for file in tmp_path.glob("a.*"):
        shutil.move(file, tmp_path / "moved")
    return jl.io.read_case(tmp_path / "moved" / "a.toml")


def bits(tree):
    """Return the type, shape and bytes of every array of a pytree."""
    return [
        (np.asarray(leaf).dtype, np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(tree)
    ]


def same(result, expected):
    """True if two pytrees are equal bit for bit, static fields included."""
    return jax.tree.structure(result) == jax.tree.structure(expected) and bits(result) == bits(expected)


@pytest.mark.parametrize("x64", [False, True], ids=["float32", "float64"])
@pytest.mark.parametrize("name", EXAMPLES)
def test_every_class_is_read_as_it_was_written(name, x64, tmp_path):
    with jax.enable_x64(x64):
        # Positions are arrays of NumPy, which have double precision in both modes.
        example = jax.tree.map(
            lambda x: jnp.asarray(x, float) / 1.0 if isinstance(x, jax.Array) else x, EXAMPLES[name]
        )
        if x64:
            # Values that single precision cannot hold.
            flight_lines = [s.flight_line for s in [example] if isinstance(s, jl.Survey)]
            example = jax.tree.map(lambda x: x * (1 - 2**-50), example)
            if flight_lines != [] and flight_lines[0] is not None:
                # Whole numbers.
                example = eqx.tree_at(lambda s: s.flight_line, example, flight_lines[0])
        case = case_of(example)
        result = round_trip(case, tmp_path)
        assert same((result.lidar, result.survey, result.scene), (case.lidar, case.survey, case.scene))


def test_a_difference_of_one_bit_is_detected():
    changed = with_ground(height=np.nextafter(np.float32(1 / 3), np.float32(1)), reflectance=(0.1, 0.2))
    assert not same(changed, with_ground(height=1 / 3, reflectance=(0.1, 0.2)))


def test_every_class_has_an_example():
    classes = {name for name, kind in kinds().items() if isinstance(kind, type)}
    # No lidar, survey or scene holds one of these: they make trees, surveys and the shapes of surfaces.
    plants, scan_patterns = (
        {"Habit", "Branching", "Stand"},
        {"Oscillating", "RotatingPolygon", "Conical", "Panorama", "Risley", "Trajectory"},
    )
    # Their arrays of whole numbers have tests of their own, in tests/scenes/test_mesh_surface.py.
    meshes = {"Mesh", "MeshSurface", "MeshInstances"}
    examples = {name.partition(",")[0] for name in EXAMPLES}
    assert classes - plants - scan_patterns - meshes - {"Plane"} == examples


def numeric_arguments(kind):
    """Generate the names of the arguments of a class or function that are numbers, by their annotations."""
    for name, argument in arguments_of(kind).items():
        annotation = str(argument.annotation)
        if any(word in annotation for word in ("Float", "float", "ArrayLike", "Reflectance")):
            yield name


def test_every_quantity_has_a_unit_or_is_a_pure_number():
    pure = {"N", "Cbrown", "albedo", "bits", "coverage", "efficiency", "g", "leaf", "bark", "probability"}
    pure |= {"reflectance", "transmittance", "scale", "power", "index", "absorption", "leaf_angles", "fill"}
    pure |= {"rtol", "atol", "n_photons", "n_rays", "lad", "upward", "foot", "a", "b"}
    pure |= {"detection_probability", "flight_line"}
    pure |= {
        "leaf_area_index",
        "wood_probability",
        "density",
        "shares",
        "size",
        "share",
        "exponent",
        "length_exponent",
        "bole",
        "twig",
        "beams",
    }
    for name, kind in kinds().items():
        for argument in numeric_arguments(kind):
            assert arguments_of(kind)[argument].unit or argument in pure, f"{name}.{argument}"


def test_key_and_arguments_of_a_case_are_read_as_they_were_written(tmp_path):
    arguments = {"rtol": 0.1, "effects": {"divergence": False}, "window": (-10.0, 1 / 3), "max_orders": 3}
    key = jax.random.split(jax.random.key(7))[1]
    result = round_trip(jl.io.Case(EXAMPLES["Lidar"], EXAMPLES["Canopy"], key, arguments), tmp_path)
    assert dict(result.arguments) == arguments
    assert result.key.dtype == key.dtype
    assert np.array_equal(jax.random.key_data(result.key), jax.random.key_data(key))


def test_raw_keys_and_keys_of_other_generators_are_read_as_they_were_written(tmp_path):
    for number, key in enumerate((jax.random.PRNGKey(5), jax.random.key(3, impl="rbg"))):
        folder = tmp_path / str(number)
        folder.mkdir()
        result = round_trip(jl.io.Case(key=key), folder).key
        assert result.dtype == key.dtype
        assert np.array_equal(jax.random.uniform(result), jax.random.uniform(key))


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_example_cases_can_be_read_and_planned(path, tmp_path):
    text = path.read_text()
    if "voxelise" in text:
        # Coarser voxels, for speed.
        shutil.copytree(path.parent, tmp_path, dirs_exist_ok=True)
        (tmp_path / path.name).write_text(text.replace("voxel_size = 0.25", "voxel_size = 2.0"))
        path = tmp_path / path.name
    case = jl.io.read_case(path)
    assert case.key is not None
    plan = jl.plan(case.lidar, case.scene, max_orders=case.arguments.get("max_orders"), describe=False)
    assert plan.n_samples > 1


def test_a_case_can_be_simulated(tmp_path):
    wave = jl.io.read_case(SCENES[[p.stem for p in SCENES].index("leaf_plate")]).simulate()
    assert np.allclose(wave.reflectance.sum(axis=1), [0.36, 0.66, 0.57], rtol=1e-4)
    with pytest.raises(ValueError, match="no lidar and no key"):
        jl.io.Case(scene=jl.Scene()).simulate()


def test_the_case_in_the_documentation_can_be_read(tmp_path):
    page = (Path(jl.__file__).parent / "formats" / "README.md").read_text()
    (block,) = [text.partition("```")[0] for text in page.split("```toml\n")[1:]]
    (tmp_path / "a.toml").write_text(block)
    np.savez(tmp_path / "plot.npz", lad=np.full((2, 2, 3), 0.5))
    case = jl.io.read_case(tmp_path / "a.toml")
    assert case.scene.canopy.voxels.shape == (2, 2, 3)
    assert isinstance(case.scene.ground.law, jl.EqualAngle)
    assert set(tomllib.loads(block)) == {"lidar", "scene", "simulate"}
    list_of_functions = page.partition("| functions |")[2]
    functions = {name for name, kind in kinds().items() if not isinstance(kind, type)}
    assert all(f"`{name}`" in list_of_functions for name in functions)


class CustomLaw(jl.AbstractLaw):
    """A law of a user's program, whose code a file cannot hold."""

    k: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def intensity_factor(self, incident, normal, view, half_angle):
        raise NotImplementedError

    albedo = sample = density = largest_intensity_factor = intensity_factor


# A class of a user's program may have the name of a class of jaxlidar.
CustomLambertian = type("Lambertian", (CustomLaw,), {})


def custom_leaf(wavelength):
    """Return reflectance and transmittance of a leaf."""
    return 0.4 + 0 * wavelength, 0.3 + 0 * wavelength


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (
            with_ground(law=CustomLaw()),
            "scene.ground.law is a CustomLaw, a class of your own: a file cannot hold",
        ),
        (with_ground(law=CustomLambertian()), "scene.ground.law is a Lambertian, a class of your own"),
        (with_leaf(custom_leaf), "scene.canopy.leaf is a function: a file cannot hold the code"),
    ],
)
def test_classes_and_functions_of_users_are_refused(scene, message, tmp_path):
    with pytest.raises(TypeError, match=message):
        jl.io.write_case(tmp_path / "a.toml", jl.io.Case(scene=scene))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[scen.ground]", "scen is not known; the nearest is scene$"),
        ("[lidar]\naltitud = 3", r"lidar.altitud is not known; the nearest is altitude"),
        ("[lidar]\nwavelenght = 3", r"lidar.wavelenght is not known; the nearest is wavelength"),
        ("[scene.ground]\nkind = 'Grund'", "scene.ground.kind = 'Grund' is no kind; the nearest is Ground"),
        (
            "[scene.ground]\nlaw = 'Lambertain'",
            "scene.ground.law = 'Lambertain' is no kind; the nearest are Lam",
        ),
        ("[scene.ground]\nslope = 95", r"scene.ground: slope = 95 is outside the admissible range \[0, 90\)"),
        (
            "[scene.ground]\nslope = {kind = 'Lidar'}",
            r"a.toml: scene.ground: ",
        ),
        ("[scene.ground]\nslope = 'steep'", "scene.ground.slope = 'steep' is a text; admissible is a number"),
        ("[[scene.plates]]\nheight = 1", "scene.plates.0: reflectance of Plate is missing"),
        ("[lidar.pulse]\nfwhm = 1", "lidar.pulse: kind is missing"),
        ("[scene]\nkind = 'Lidar'", r"a.toml: "),
        ("scene = 3", r"a.toml: "),
        ("lidar = [", r"no TOML: Invalid value \(at"),
        ("[simulate]\nrtoll = 3", "simulate.rtoll is not known; the nearest are rtol, atol"),
        ("[simulate]\nplan = 3", "simulate.plan is not known"),
        ("[simulate]\nseed = -1", r"simulate.seed = -1 is outside the admissible range \[0, 2147483647\]"),
        ("[simulate]\nseed = 1\nkey = [0, 1]", "both seed and key"),
        ("[simulate]\nkey = [0, -1]", r"simulate.key = \[0, -1\] is no row of whole numbers"),
        ("[simulate]\nkey = [0, 1, 2]\nkey_kind = 'threefry2x32'", "is no key of the kind 'threefry2x32'"),
        ("[simulate]\nkey = [0, 1]\nkey_kind = 'dice'", "is no key of the kind 'dice'"),
        ("[lidar]\nwavelength = {array = 'a'}", "array = 'a' has no file"),
        ("[lidar]\nwavelength = {file = 'b.npz', array = 'a'}", "b.npz: no such file"),
        ("[lidar]\nwavelength = {file = 'b.npz', aray = 'a'}", "kind is missing"),
        (
            "[scene.ground]\nreflectance = {kind = 'spectrum', name = 'sol'}",
            "name = 'sol' is no bundled spectrum",
        ),
        (
            "[scene.ground]\nreflectance = {kind = 'read_spectrum_csv', path = 'no.csv'}",
            "no.csv: no such file",
        ),
    ],
)
def test_bad_files_are_refused_with_the_place_of_the_fault(text, message, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=message) as refusal:
        jl.io.read_case(path)
    assert str(tmp_path) in str(refusal.value)


def test_paths_in_a_case_are_relative_to_its_folder(tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "soil.csv").write_text("400,0.1\n2400,0.4\n")
    lines = ["VOXEL SPACE", "#min_corner:(0,0,0)", "#max_corner:(1,1,2)", "#split:(1,1,2)"]
    lines += ["i j k PadBVTotal", "0 0 0 NaN", "0 0 1 1.5"]
    (tmp_path / "data" / "plot.vox").write_text("\n".join(lines))
    text = """
    [scene.canopy]
    leaf = {kind = "LeafOptics", reflectance = 0.4}
    voxels = {kind = "read_vox", path = "data/plot.vox", fill = 0.0}
    [scene.ground]
    reflectance = {kind = "read_spectrum_csv", path = "data/soil.csv"}
    """
    (tmp_path / "a.toml").write_text(text)
    monkeypatch.chdir("/")
    scene = jl.io.read_case(tmp_path / "a.toml").scene
    assert scene.canopy.voxels.leaf.tolist() == [[[0.0, 0.75]]]
    assert scene.ground.reflectance.name == "soil"
    (tmp_path / "a.toml").write_text(text.replace(", fill = 0.0", ""))
    with pytest.raises(ValueError, match=r"1 without a density.*give fill"):
        jl.io.read_case(tmp_path / "a.toml")


def test_terrain_is_read_from_its_file_and_written_as_numbers(tmp_path):
    head = "ncols 2\nnrows 2\nxllcorner 600000\nyllcorner 5200000\ncellsize 10\n"
    (tmp_path / "hill.asc").write_text(head + "7 8\n5 6\n")
    (tmp_path / "a.toml").write_text(
        "[scene.ground]\nkind = 'read_dem'\npath = 'hill.asc'\nreflectance = 0.2"
    )
    scene = jl.io.read_case(tmp_path / "a.toml").scene
    assert scene.ground.heights.tolist() == [[5.0, 7.0], [6.0, 8.0]]
    assert scene.ground.origin.tolist() == [600005.0, 5200005.0]
    jl.io.write_case(tmp_path / "b.toml", jl.io.Case(scene=scene))
    assert "# m" in next(x for x in (tmp_path / "b.toml").read_text().splitlines() if x.startswith("heights"))
    assert eqx.tree_equal(jl.io.read_case(tmp_path / "b.toml").scene, scene)


SURVEY = """
[lidar]
altitude = 500
[survey]
kind = "Survey.scan"
pattern = {kind = "Conical", half_angle = 20.0, frequency = 40.0}
start = [0, 0]
end = [0, 10]
speed = 50.0
pulse_rate = 25.0
[scene.ground]
[simulate]
seed = 0
max_orders = 1
"""


def test_a_case_defines_a_survey_by_its_flight_line_and_scan_pattern(tmp_path):
    (tmp_path / "a.toml").write_text(SURVEY)
    case = jl.io.read_case(tmp_path / "a.toml")
    line = {"start": (0, 0), "end": (0, 10), "speed": 50.0, "pulse_rate": 25.0}
    scan = jl.Conical(half_angle=20.0, frequency=40.0)
    assert same(case.survey, jl.Survey.scan(jl.Lidar(altitude=500.0), scan, **line))
    waveforms = case.simulate(path=tmp_path / "survey.zarr")
    assert waveforms.reflectance.shape[:2] == (6, 1)
    assert len(jl.open(tmp_path / "survey.zarr")) == 6
    with pytest.raises(ValueError, match=r"arguments\.atol is not known; the nearest"):
        jl.io.Case(survey=case.survey, arguments={"atol": 0.1})
    with pytest.raises(ValueError, match="the case has no scene and no key"):
        jl.io.Case(survey=case.survey).simulate()
    with pytest.raises(ValueError, match="without a survey"):
        jl.io.Case(jl.Lidar(), case.scene, case.key).simulate(path=tmp_path / "one.nc")


FLIGHT = """
[survey]
kind = "Survey.fly"
trajectory = {kind = "read_trajectory", path = "flight.csv"}
scan = {kind = "Conical", half_angle = 20.0, frequency = 40.0}
lidar = {altitude = 500}
lever_arm = [1.0, 0.0, 0.0]
"""


def test_a_case_defines_a_survey_by_a_trajectory(tmp_path):
    (tmp_path / "flight.csv").write_text("time,x,y,z,roll,pitch,yaw\n0,0,0,500,1,2,3\n1,0,60,500,1,2,3\n")
    (tmp_path / "a.toml").write_text(FLIGHT)
    flight = jl.Trajectory([0, 1], [(0, 0, 500), (0, 60, 500)], 1, 2, 3)
    expected = jl.Survey.fly(
        flight, jl.Conical(20.0, 40.0), lidar=jl.Lidar(altitude=500), lever_arm=(1, 0, 0)
    )
    assert same(jl.io.read_case(tmp_path / "a.toml").survey, expected)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.toml"
    jl.io.write_case(path, jl.io.Case(jl.Lidar()))
    text_before = path.read_text()

    def fail(self, *args, **kwargs):
        raise OSError("the disk is full")

    monkeypatch.setattr(Path, "write_text", fail)
    with pytest.raises(OSError, match="full"):
        jl.io.write_case(path, jl.io.Case(jl.Lidar(altitude=1.0)))
    monkeypatch.undo()
    assert path.read_text() == text_before
    assert list(tmp_path.iterdir()) == [path]


def test_inadmissible_cases_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"does not end in .toml"):
        jl.io.write_case(tmp_path / "a.txt", jl.io.Case())
    with pytest.raises(TypeError, match="lidar"):
        jl.io.Case(jl.Scene())
    with pytest.raises(ValueError, match=r"arguments.rtoll is not known; the nearest are rtol"):
        jl.io.Case(arguments={"rtoll": 1})
    with pytest.raises(TypeError, match="that JAX is tracing; a file can hold known numbers alone"):
        jax.jit(lambda h: jl.io.write_case(tmp_path / "a.toml", jl.io.Case(scene=with_ground(height=h))))(1.0)


def test_fields_are_written_with_their_units(tmp_path):
    jl.io.write_case(tmp_path / "a.toml", jl.io.Case(jl.Lidar(), with_ground(slope=5.0)))
    text = (tmp_path / "a.toml").read_text()
    for line in ("wavelength = [1064.0] # nm", "divergence = 0.3 # mrad", "slope = 5.0 # degrees"):
        assert line in text.splitlines()
    absent = {"field_of_view", "scan", "level_divergence", "ellipse_turn"}
    fields = {f.name for f in dataclasses.fields(jl.Lidar)} - absent
    assert fields <= set(tomllib.loads(text)["lidar"])
    assert set(inspect.signature(jl.Ground).parameters) <= set(tomllib.loads(text)["scene"]["ground"])
