"""Arguments of a wrong kind or shape give one sentence before anything compiles; and the text of `help`.

Tests check the types of arguments before the library does (see conftest), so that the messages are read in a
process of its own.
"""

import dataclasses
import inspect
import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from jaxlidar.extend import check_integer, check_key, check_kinds

ROOT = Path(__file__).resolve().parents[1]

DEFINITIONS = """
import jax, jax.numpy as jnp, numpy as np, jaxlidar as jl
cube, points = np.full((2, 2, 2), 0.5), np.zeros((4, 3))
voxels = jl.VoxelMap.from_lad(cube, voxel_size=1.0)
plate, leaf, rule = jl.Plate(height=1.0, reflectance=0.2), jl.LeafOptics(0.4, 0.3), jl.Rule("A", lambda: "A")
tree = jl.turtle("F")
leaves = jax.vmap(lambda n: jl.Prospect(N=n))(jnp.ones(2))
"""
WRONG_KIND = {
    "jl.Scene(ground=0.3)": "ground is a float; admissible is a Ground or None, as in",
    "jl.Scene(plates=plate)": "plates is a Plate; admissible is a tuple, as in (plate,)",
    "jl.Scene(plates=0.5)": "plates is a float; admissible is a tuple",
    "jl.Scene(plates=(jl.Ground(),))": "plates has a Ground; admissible is a tuple of Plate",
    "jl.Scene(ground=plate)": "ground is a Plate; admissible is a Ground",
    "jl.Scene(canopy=[1.0])": "canopy is a list; admissible is a Canopy or None",
    "jl.Scene(canopy=voxels)": "canopy is a VoxelMap; admissible is a Canopy or None, as in",
    "jl.Scene(atmosphere=23.0)": "atmosphere is a float; admissible is an Atmosphere or None",
    "jl.Canopy(cube, leaf=leaf)": "voxels is an array of float64; admissible is a VoxelMap",
    "jl.Canopy(voxels, leaf=0.4)": "leaf is a float; admissible are leaf optics",
    "jl.Canopy(voxels, leaf=jl.Prospect)": "leaf is the class Prospect; admissible are leaf optics",
    "jl.Canopy(voxels, leaf=jl.spectrum('gravel'))": "leaf is a Spectrum; admissible are leaf",
    "jl.Canopy(voxels, leaf=leaf, bark=leaf)": "bark is a LeafOptics; admissible are real numbers",
    "jl.Canopy(voxels, leaf=leaf, hotspot='on')": "hotspot is a str; admissible is True or False",
    "jl.Canopy(voxels, leaf=lambda w: w).leaf_optics([1.0])": "leaf returns an array of float64;",
    "jl.leaf_mesh(cube, key=jax.random.key(0))": "voxels_or_tree is an array of float64; admissible",
    "jl.leaf_mesh(voxels, key=0)": "key is an int; admissible is a JAX random key",
    "jl.leaf_mesh(voxels, key=jax.random.key(0), leaf=jl.Isotropic(0.5))": "leaf is an Isotropic; admissible",
    "jl.leaf_mesh(voxels, key=jax.random.key(0), leaf=jl.spectrum('gravel'))": "leaf is a Spectrum;",
    "jl.leaf_mesh(voxels, key=jax.random.key(0), leaf=lambda w: w)": "leaf returns an array of float64;",
    "jl.Ground(law='Lambertian')": "law is a str; admissible is a law of reflection",
    "jl.Plate(0.0, 0.2, law=jl.Lambertian)": "law is the class Lambertian; admissible is a law",
    "jl.Ground(reflectance='soil')": "reflectance is a str; admissible are real numbers or a",
    "jl.VoxelMap.from_lad(cube, voxel_size=1.0, leaf_angles=30.0)": "leaf_angles is a float;",
    "jl.VoxelMap.from_lad(None, voxel_size=1.0)": "lad is None; admissible are real numbers",
    "jl.Lidar(pulse=6.0)": "pulse is a float; admissible is a pulse, such as",
    "jl.Lidar(receiver=None)": "receiver is None; admissible is a Receiver",
    "jl.Lidar(altitude='1000')": "altitude is a str; admissible are real numbers",
    "jl.Lidar(energy=np.array(1j))": "energy is an array of complex128; admissible are real",
    "jl.Receiver(photon_noise=1)": "photon_noise is an int; admissible is True or False",
    "jl.record(np.ones((1, 2)), 1064.0, jl.Receiver(), key=0)": "key is an int; admissible is a",
    "jl.record(np.ones((1, 2)), 1.0, jl.PhotonCounter())": "receiver is a PhotonCounter; admissible is a Rec",
    "jl.PhotonCounter().count(plate, key=None)": "key is None; admissible is a JAX random key",
    "jl.PhotonCounter().count(np.ones((1, 2)), key=jax.random.key(0))": "wave is an array of float64;",
    "jl.PhotonCounter(dead_time='3.2')": "dead_time is a str; admissible are real numbers",
    "jl.Atmosphere(visibility='clear')": "visibility is a str; admissible are real numbers",
    "jl.Prospect(Cab='40')": "Cab is a str; admissible are real numbers",
    "jl.Habit(trunk=0.3)": "trunk is a float; admissible is a Branching",
    "jl.grow(tree)": "habit is a Tree; admissible is a Habit or None",
    "jl.forest([tree], density=1.0, area=(9.0, 9.0))": "one of habits is a Tree; admissible is a",
    "jl.LSystem('A', rule)": "rules is a Rule; admissible is a sequence of Rule",
    "jl.Rule('A', 'B')": "produce is a str; admissible is a function of the parameters",
    "jl.voxelise(jl.Habit(), 0.2)": "trees is a Habit; admissible is a Tree or several",
    "jl.voxelise(tree, 0.2, samples='8')": "samples is a str; admissible is an integer of at least",
    "jl.voxelise_points(points, 0.2, leaf_area=1.0, is_wood=np.ones(4, int))": "is_wood is an",
    "jl.GaussianPulse(fwhm='6')": "fwhm is a str; admissible are real numbers",
    "jl.SampledPulse('a', [0.0, 1.0])": "time is a str; admissible are real numbers",
    "jl.Spectrum([400.0, 900.0], plate)": "reflectance is a Plate; admissible are real numbers",
    "jl.spectrum(1064.0)": "name is a float; admissible is a name that jaxlidar.spectrum_names lists",
    "jl.Canopy(voxels, leaf=leaf, sides=cube)": "sides is an array of float64; admissible is one of 'open'",
    "jl.leaf_surface('glass')": "n is a str; admissible are real numbers",
    "jl.first_return_window(np.arange(3.0), np.ones(3), 2.0, None)": "threshold is None; admissible are",
    "jl.Survey.of(jl.Survey(jl.Lidar(), [(0, 0)]))": "lidar is a Survey; admissible is a Lidar",
    "jl.Survey.join(None)": "surveys is None; admissible is a sequence of Survey",
    "jl.Survey.join(jl.Survey(jl.Lidar(), [(0, 0)]))": "surveys is a Survey; admissible is a sequence of",
    "jl.simulate(jl.Lidar(), jl.Scene(), key=jax.random.key(0)).save('a.nc', 'x')": "case is a str; admiss",
    "jl.Tree(*[[0.0]] * 9)": "start is a list; admissible is a NumPy array",
}
WRONG_SHAPE = {
    "jl.Lidar(altitude=(1.0, 2.0))": "altitude has shape (2,); admissible is one number",
    "jl.Lidar(wavelength=np.ones((2, 2)))": "wavelength has shape (2, 2); admissible is one number",
    "jl.Lidar(energy=[[1.0], [1.0, 2.0]])": "energy has rows of different lengths; admissible is a",
    "jl.Survey.scan(jl.Lidar(), jl.Conical(15, 8), (0, 0), (0, 9), 9, [1, 2])": "pulse_rate has shape (2,)",
    "jl.GaussianPulse(fwhm=(3.0, 6.0))": "fwhm has shape (2,); admissible is one number",
    "jl.Prospect(Cab=[[1.0], [2.0, 3.0]])": "Cab has rows of different lengths; admissible is a regular",
    "jl.Habit(height=[[1.0], [2.0, 3.0]])": "height has rows of different lengths; admissible is a",
    "jl.first_return_window(np.arange(3.0), 1.0, 2.0)": "time has shape (3,); admissible is one per bin",
    "jl.leaf_surface(0.5)": "n = 0.5 is outside the admissible range [1, inf)",
    "jl.VoxelMap.from_probability(cube, voxel_size=np.nan)": "voxel_size = nan is outside",
    "jl.Ground(reflectance=np.full((2, 2), 0.1))": "reflectance has shape (2, 2); admissible is",
    "jl.Ground(reflectance=[])": "reflectance has shape (0,); admissible is one number, one per",
    "jl.Canopy(voxels, leaf=leaf, bark=np.full((1, 1), 0.1))": "bark has shape (1, 1); admissible",
    "jl.Isotropic(np.full((2, 2), 0.1))": "albedo has shape (2, 2); admissible is a number or one",
    "jl.VoxelMap.from_lad(cube, voxel_size=(1, 1))": "voxel_size has shape (2,); admissible is one",
    "jl.record(np.ones((2, 3)), [1.0] * 3, jl.Receiver())": "wavelength has shape (3,); admissible",
    "jl.record(np.ones(3), 1064.0, jl.Receiver())": "energy has shape (3,); admissible is (...,",
    "jl.PhotonCounter(pixels=2.5)": "pixels = 2.5 is outside the admissible range [1, inf) of integers",
    "jl.Prospect().jacobian([1064.0])": "N has shape (); admissible are traits of shape (leaves,)",
    "leaves.jacobian([1064.0], 2.5)": "batch_size = 2.5 is outside the admissible",
    "jl.Receiver(bits=8.5, saturation=1.0)": "bits = 8.5 is outside the admissible range [1, 24] of",
    "jl.Habit(height=(1.0, 2.0))": "height has shape (2,); admissible is one number",
    "jl.Habit(stems=2.5)": "stems = 2.5 is outside the admissible range [1, inf) of integers",
    "jl.Branching(laterals=1.5)": "laterals = 1.5 is outside the admissible range [1, inf) of",
    "jl.Branching(share=(0.1, 0.2, 0.3))": "share has shape (3,); admissible is (2,)",
    "jl.forest(density=1.0, area=9.0)": "area has shape (); admissible is (2,)",
    "jl.forest(density=1.0, area=(9.0, 9.0), size=1.0)": "size has shape (); admissible is (2,)",
    "jl.forest(density=1.0, area=(9.0, 9.0), individuals=2.5)": "individuals = 2.5 is outside",
    "jl.LSystem('A', [rule]).rewrite(2.5)": "steps = 2.5 is outside the admissible range [0, inf)",
    "jl.turtle('F', position=(0.0, 0.0))": "position has shape (2,); admissible is (3,)",
    "jl.voxelise(tree, 0.2, samples=np.inf)": "samples = inf is outside the admissible range [1,",
    "jl.voxelise(tree, 0.2, origin=(0, 0), shape=(5, 5, 5))": "origin has shape (2,); admissible",
    "jl.voxelise(tree, 0.2, origin=(0, 0, 0), shape=(5.5, 5, 5))": "shape = 5.5 is outside the",
    "jl.voxelise_points(points[:, :2], 0.2, leaf_area=1.0)": "points has shape (4, 2); admissible",
    "jl.voxelise_points(points, 0.2, leaf_area=1.0, is_wood=np.ones(3, bool))": "is_wood has shape",
    "jl.io.stack_shots([])": "shots is empty; admissible are one or more",
    "jl.Terrain(cube[0], 1.0).height_at(np.zeros(3), np.zeros(2))": "y has shape (2,); admissible is (3,)",
    "tree.translated(1.0)": "offset has shape (); admissible is (3,)",
}


def test_wrong_kinds_and_shapes_are_refused_in_one_sentence():
    code = DEFINITIONS + "import json\nerrors = []\nfor text in " + repr([*WRONG_KIND, *WRONG_SHAPE]) + ":\n"
    code += "    try:\n        eval(text)\n        errors.append(('nothing', text))\n"
    code += "    except Exception as error:\n        errors.append((type(error).__name__, str(error)))\n"
    code += "print(json.dumps(errors))"
    process = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT
    )
    errors = json.loads(process.stdout)
    for (error, message), (expression, expected) in zip(
        errors, (WRONG_KIND | WRONG_SHAPE).items(), strict=True
    ):
        assert error == ("TypeError" if expression in WRONG_KIND else "ValueError"), (
            expression,
            error,
            message,
        )
        assert message.startswith(expected), (expression, message)
        assert "\n" not in message


CALL_ENTRY_POINTS = """
import jax, jax.numpy as jnp, numpy as np, jaxlidar as jl, inversion
lidar, scene, key = jl.Lidar(), jl.Scene(ground=jl.Ground()), jax.random.key(0)
plate, plan = jl.Plate(height=1.0, reflectance=0.2), jl.plan(lidar, scene)
unknowns = [
    inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="a"),
    inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="b"),
]
y, t = np.ones((1, 4)), np.arange(4.0)
def problem(observed, lidar, scene):
    time = None if observed is None else t
    return inversion.Problem(observed, lidar, scene, unknowns, noise=1.0, time=time)
CALLS = {
    "simulate": lambda l, s, k: jl.simulate(l, s, key=k),
    "simulate with a plan": lambda l, s, k: jl.simulate(l, s, key=k, plan=plan),
    "plan": lambda l, s, k: jl.plan(l, s),
    "reduce": lambda l, s, k: jl.make_setup(l, s, plan),
    "energy_budget": lambda l, s, k: jl.energy_budget(l, s, key=k),
    "trace_scene": lambda l, s, k: jl.trace_scene(jl.make_setup(l, s, plan), k),
    "retrieve": lambda l, s, k: inversion.retrieve(problem(y, l, s), key=k),
    "retrieve_many": lambda l, s, k: inversion.retrieve_many(problem(y[None], l, s), key=k),
    "cramer_rao": lambda l, s, k: inversion.cramer_rao(problem(None, l, s), key=k),
    "profile_likelihood": lambda l, s, k: inversion.profile_likelihood(
        problem(y, l, s), "a", [0.0, 1.0], key=k
    ),
}
WRONG_ARGUMENTS = {
    "swapped": (scene, lidar, key),
    "a list of lidars": ([lidar, lidar], scene, key),
    "a list of scenes": (lidar, [scene, scene], key),
    "a plate": (lidar, plate, key),
    "the class": (jl.Lidar, scene, key),
    "no scene": (lidar, None, key),
    "a seed": (lidar, scene, 0),
}
import json
from jax import monitoring
events, errors = [], {}
monitoring.register_event_duration_secs_listener(lambda name, *_, **__: events.append(name))
for name, call in CALLS.items():
    for case, arguments in WRONG_ARGUMENTS.items():
        events.clear()
        try:
            call(*arguments)
            outcome = "nothing", ""
        except Exception as error:
            outcome = type(error).__name__, str(error)
        errors[f"{name}: {case}"] = (*outcome, [event for event in events if "backend_compile" in event])
print(json.dumps(errors))
"""
MESSAGES = {
    "swapped": "lidar is a Scene",
    "a list of lidars": "lidar",
    "a list of scenes": "scene",
    "a plate": "scene is a Plate; admissible is",
    "the class": "lidar is the class Lidar; admissible",
    "no scene": "scene is None; admissible is",
    "a seed": "key is an int; admissible is a JAX random key",
}


def test_every_entry_point_refuses_wrong_kinds_before_anything_compiles():
    process = subprocess.run(
        [sys.executable, "-c", CALL_ENTRY_POINTS], check=True, capture_output=True, text=True, cwd=ROOT
    )
    errors = json.loads(process.stdout)
    # A plan needs no key, and many footprints may have a lidar or a scene each: lists of another length.
    assert errors.pop("plan: a seed")[0] == errors.pop("reduce: a seed")[0] == "nothing"
    for several in ("lidars", "scenes"):
        error, message, _ = errors.pop(f"retrieve_many: a list of {several}")
        assert error == "ValueError"
        assert message.endswith("has 2 elements; admissible is one, or 1 as observed")
    for case, (error, message, compiled) in errors.items():
        assert error == "TypeError", (case, message)
        assert message.startswith(MESSAGES[case.partition(": ")[2]]), (case, message)
        assert "\n" not in message
        assert compiled == [], case


LIDAR, SCENE, GROUND = jl.Lidar(), jl.Scene(), jl.Ground()


@pytest.mark.parametrize(
    ("lidar", "scene", "says"),
    [
        (SCENE, LIDAR, "lidar is a Scene and scene is a Lidar: they are swapped"),
        ([LIDAR], SCENE, "lidar is a list; admissible is one Lidar: .* in a loop .*retrieve_many"),
        ((LIDAR, LIDAR), SCENE, "lidar is a tuple; admissible is one Lidar"),
        (jl.Lidar, SCENE, "lidar is the class Lidar; admissible is a Lidar"),
        (None, SCENE, "lidar is None; admissible is a Lidar"),
        (LIDAR, None, "scene is None; admissible is a Scene"),
        (LIDAR, LIDAR, "scene is a Lidar; admissible is a Scene"),
        (LIDAR, [SCENE], "scene is a list; admissible is one Scene"),
        (LIDAR, GROUND, r"scene is a Ground; admissible is a Scene, as in Scene\(ground=ground\)"),
        (
            LIDAR,
            jl.Plate(1.0, 0.2),
            r"scene is a Plate; admissible is a Scene, as in Scene\(plates=\(plate,\)\)",
        ),
    ],
)
def test_arguments_that_are_no_lidar_or_no_scene_are_refused(lidar, scene, says):
    with pytest.raises(TypeError, match=says):
        check_kinds(lidar, scene)


def test_a_traced_lidar_and_scene_are_accepted():
    @jax.jit
    def run(lidar, scene):
        check_kinds(lidar, scene)
        return lidar.altitude

    assert float(run(LIDAR, jl.Scene(ground=GROUND))) == 1000.0
    lidars = jax.vmap(lambda a: jl.Lidar(altitude=a))(np.array([10.0, 20.0]))
    assert jax.vmap(run, in_axes=(0, None))(lidars, SCENE).tolist() == [10.0, 20.0]


@pytest.mark.parametrize("key", [0, None, "seed", 1.5, np.zeros(2), LIDAR, jax.random.key])
def test_arguments_that_are_no_key_are_refused(key):
    with pytest.raises(TypeError, match=r"key is .*; admissible is a JAX random key, as jax.random.key\(0\)"):
        check_key(key)


def test_several_keys_are_refused():
    for several in (jax.random.split(jax.random.key(0), 3), jax.random.split(jax.random.PRNGKey(0), 3)):
        with pytest.raises(ValueError, match=r"key has shape \(3,.*several keys; admissible is one"):
            check_key(several)


def test_keys_of_both_styles_are_accepted_concrete_or_traced():
    for make in (jax.random.key, jax.random.PRNGKey):
        key = make(0)

        def run(key):
            check_key(key)
            return jax.random.uniform(key)

        assert float(run(key)) == float(jax.jit(run)(key))
        assert jax.vmap(run)(jax.random.split(key, 3)).shape == (3,)


def test_numbers_that_are_no_integer_are_refused():
    assert check_integer("n", np.int64(3)) == check_integer("n", 3.0) == check_integer("n", np.array(3)) == 3
    assert isinstance(check_integer("n", 3.0), int)
    for wrong in (2.5, np.nan, np.inf, 0):
        with pytest.raises(
            ValueError, match=r"n = .* is outside the admissible range \[1, inf\) of integers"
        ):
            check_integer("n", wrong)
    for wrong in ("3", None, [3], 1j):
        with pytest.raises(TypeError, match=r"n is .*; admissible is an integer of at least 1"):
            check_integer("n", wrong)
    with pytest.raises(TypeError, match="that JAX is tracing"):
        jax.jit(lambda n: check_integer("n", n))(3)


NAMESPACES = (jl, jl.io, jl.plot, inversion)
PUBLIC = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in NAMESPACES
    for name in module.__all__
    if inspect.isclass(getattr(module, name))
}
FIND_SUMMARIES = """
import inspect, json, pydoc, inversion, jaxlidar as jl
positions = {}
for module in (jl, jl.io, jl.plot, inversion):
    for name in module.__all__:
        if inspect.isclass(value := getattr(module, name)):
            text = pydoc.render_doc(value, renderer=pydoc.plaintext)
            positions[f"{module.__name__}.{name}"] = text.find(inspect.getdoc(value).split("\\n")[0])
print(json.dumps(positions))
"""


@pytest.mark.slow
def test_help_begins_with_the_summary_of_a_class():
    """It follows name and arguments within ten lines; for classes that users construct, even sooner."""
    process = subprocess.run(
        [sys.executable, "-c", FIND_SUMMARIES], check=True, capture_output=True, text=True, cwd=ROOT
    )
    positions = json.loads(process.stdout)
    assert positions.keys() == PUBLIC.keys()
    assert {name for name, at in positions.items() if not 0 <= at < 800} == set()
    for cls in (jl.Lidar, jl.Scene, jl.Canopy, jl.VoxelMap, jl.Ground, jl.Plate, jl.Prospect):
        assert positions[f"jaxlidar.{cls.__name__}"] < 500
        assert cls.__final__


def test_a_short_signature_keeps_names_and_defaults():
    lidar_parameters = inspect.signature(jl.Lidar).parameters
    # The sensor is an argument, kept as the position.
    assert list(lidar_parameters) == [*(field.name for field in dataclasses.fields(jl.Lidar)), "sensor"]
    names = ("altitude", "position", "divergence", "profile")
    assert [str(lidar_parameters[name].default) for name in names] == [
        "1000.0",
        "(0.0, 0.0)",
        "0.3",
        "gaussian",
    ]
    leaf_parameters = inspect.signature(jl.Prospect).parameters
    assert list(leaf_parameters)[:2] == ["N", "Cab"]
    assert leaf_parameters["Cp"].kind is inspect.Parameter.KEYWORD_ONLY
    # An instance is called with wavelengths.
    assert list(inspect.signature(jl.Prospect()).parameters) == ["wavelengths"]
