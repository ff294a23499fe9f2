"""Masks are not dropped, and booleans and times are no numbers, whatever takes them.

NumPy's `asarray` drops the mask of an array, and takes booleans and times for numbers. Each argument of each
public entry point (tests.entry_points) is given as a masked array, as booleans and as times: it is refused by
its name, or, where NaN stands for a missing number, masked elements give what NaN gives.

Tests check the types of arguments before the library does (see conftest), so that the calls are made in a
process of its own.
"""

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
from jaxlidar._checks import as_array, as_numpy, check_integer, check_range, concrete
from tests.entry_points import ENTRY_POINTS

ROOT = Path(__file__).resolve().parents[1]

CALL_ENTRY_POINTS = """
import json, warnings
import jax, matplotlib, numpy as np
matplotlib.use("Agg")
warnings.simplefilter("ignore")
from tests.entry_points import ENTRY_POINTS

def first_masked(x):
    mask = np.zeros(np.shape(x), bool)
    mask[(0,) * mask.ndim] = True
    return np.ma.array(np.asarray(x), mask=mask)

def first_nan(x):
    array = np.array(x, float)
    array[(0,) * array.ndim] = np.nan
    return array

def booleans(x):
    return np.ones(np.shape(x), bool) if np.ndim(x) else True

def times(x):
    return np.ones(np.shape(x), "m8[s]") if np.ndim(x) else np.timedelta64(1, "s")

def numbers(result):
    leaves = jax.tree.leaves(result)
    return [np.asarray(leaf) for leaf in leaves if isinstance(leaf, jax.Array | np.ndarray | float)]

def outcome(call, argument, value):
    try:
        return "accepted", "", numbers(call.function(**{**call.arguments, argument: value}))
    except Exception as error:
        return type(error).__name__, str(error), []

results = {}
for name, make_call in ENTRY_POINTS.items():
    call = make_call()
    for argument, value in call.arguments.items():
        message = call.messages.get(argument, argument)
        for kind, change in (("masked", first_masked), ("booleans", booleans), ("times", times)):
            error, text, masked = outcome(call, argument, change(value))
            missing = kind == "masked" and argument in call.missing
            if missing:
                expected = outcome(call, argument, first_nan(value))[2]
                same = [np.array_equal(a, b, equal_nan=True) for a, b in zip(masked, expected, strict=True)]
                error = "accepted as NaN" if error == "accepted" and all(same) else "not as NaN"
            results.setdefault(name, []).append((argument, message, kind, missing, error, text))
print(json.dumps(results))
"""


@pytest.fixture(scope="module")
def outcomes():
    process = subprocess.run(
        [sys.executable, "-c", CALL_ENTRY_POINTS], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert process.returncode == 0, process.stderr[-3000:]
    return json.loads(process.stdout)


@pytest.mark.parametrize("name", ENTRY_POINTS)
def test_masks_booleans_and_times(outcomes, name):
    for argument, message, kind, missing, error, text in outcomes[name]:
        case = (argument, kind, error, text)
        if missing:
            assert error == "accepted as NaN", case
            continue
        assert error in ("ValueError", "TypeError"), case
        assert message in text, case
        assert "\n" not in text, case


# Public names that take no numbers of their own: results, whose numbers come from the library; warnings;
# abstract classes and laws, whose methods are called with traced vectors; and functions of the objects that
# the others make.
RESULTS = (
    *("Waveform", "Progress", "PhotonEvents", "Waveforms", "SurveyProgress", "Truth", "Truths"),
    *("EnergyBudget", "Acquisition", "DiscreteReturns", "InstrumentValue", "CompilationCache"),
    *("SceneWaveforms", "ReflectanceFactor", "inversion.Design", "inversion.LogDensity"),
    *("Plan", "Effect", "Setup", "Response", "AnalogReturns", "io.DemRead", "io.GediShot", "io.MeshRead"),
    *("io.NeonImpulse", "io.NeonRead", "io.PointCloud", "io.Returns", "io.Scanner", "io.ShotStack"),
    *(
        "Inventory",
        "io.TreeRead",
        "io.VoxelsRead",
        "io.AirborneShots",
        "inversion.Retrieval",
        "inversion.Retrievals",
    ),
    *("inversion.Step", "inversion.RetrievalProgress", "inversion.AveragingKernel", "inversion.CramerRao"),
    *("inversion.Profile", "inversion.Verdict", "inversion.Echoes", "inversion.EchoPoints"),
    *("inversion.SignalEnds", "inversion.GroundAndCanopy", "inversion.GediMetrics"),
    *(
        "inversion.PhotonHeights",
        "inversion.Geolocation",
        "PointCanopy",
        "inversion.Amplitudes",
        "inversion.LeafFit",
        "LeafSurface",
        "inversion.GediSettings",
    ),
    *("io.ColumnAxis", "io.Column", "io.ShotTable", "io.PhotonImpulse", "io.PhotonTrack"),
    *("inversion.TableProgress", "inversion.Comparison", "inversion.ComparisonStatistics"),
    *("inversion.ComparedColumn", "inversion.SceneRetrieval", "inversion.SceneStep"),
    "inversion.ShotResponse",
)
OF_OBJECTS = (
    *("instrument", "instruments", "instrument_sources", "compilation_cache", "simulate_scenes"),
    *("ground_position", "io.read_trajectory", "io.read_inventory"),
    # Its numbers are those of a lidar, and of `plan`; the noise may be a function.
    "inversion.design",
    *("total_reflectance", "open", "rerun", "Scene", "load_coefficients", "spectrum_names"),
    *("read_spectrum_csv", "Symbol", "Word", "LSystem", "trim_empty_layers", "truth_of", "make_setup"),
    *("trace_scene", "waveform_of", "Lambertian", "EqualAngle", "spectrum", "Plane"),
    *("io.atomic_write", "io.keep_as_netcdf", "io.read_case", "io.read_las_waveforms", "io.read_neon"),
    *(
        "io.read_lvis_l1b",
        "io.read_lvis_l2",
        "io.read_pulsewaves",
        "io.save",
        "io.stack_shots",
        "io.write_case",
        "plot.accuracy",
    ),
    *("plot.energy_budget", "plot.leaf_on_and_off", "plot.scene", "inversion.judge_fit"),
    *("inversion.judge_fits", "inversion.echo_points"),
)


def public_names():
    for prefix, module in (("", jl), ("io.", jl.io), ("plot.", jl.plot), ("inversion.", inversion)):
        for name in module.__all__:
            value = getattr(module, name)
            is_warning = inspect.isclass(value) and issubclass(value, Warning)
            if callable(value) and not is_warning and not name.startswith("Abstract"):
                yield f"{prefix}{name}"


def test_every_public_name_is_called_or_takes_no_numbers():
    called = {name.split()[0].removesuffix("()") for name in ENTRY_POINTS}
    heads = {name if "." not in name else name.rpartition(".")[0] for name in called}
    missing = set(public_names()) - called - heads - {*RESULTS, *OF_OBJECTS}
    assert missing == set()


# -- the conversions ---------------------------------------------------------------------------------------

MASKED = np.ma.array([1.0, 2.0], mask=[False, True])


@pytest.mark.parametrize("masked", [MASKED, [1.0, np.ma.masked], [MASKED[1], 3.0], (MASKED, [3.0, 4.0])])
def test_masked_elements_are_refused_or_become_nan(masked):
    for convert in (as_array, as_numpy):
        with pytest.raises(ValueError, match="x has masked elements; admissible is an array without a mask"):
            convert(masked, "x")
        converted = convert(masked, "x", missing=True)
        assert int(np.isnan(converted).sum()) == 1
    assert int(np.isnan(concrete(masked)).sum()) == 1
    with pytest.raises(ValueError, match="x has masked elements"):
        check_range("x", masked, 0.0)


def test_an_array_without_masked_elements_is_an_array():
    whole = np.ma.array([1.0, 2.0], mask=[False, False])
    for convert in (as_array, as_numpy):
        assert convert(whole, "x").tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    "wrong",
    [
        *(True, np.True_, np.ones(2, bool), [1.0, False], jax.numpy.ones(2, bool)),
        *(np.timedelta64(1, "s"), np.ones(2, "m8[ns]"), np.ones(2, "M8[s]"), np.ones(2, object), 1j),
    ],
)
def test_what_is_no_number_is_refused(wrong):
    for convert in (as_array, as_numpy, check_integer):
        arguments = ("x", wrong) if convert is check_integer else (wrong, "x")
        with pytest.raises(TypeError, match="x is "):
            convert(*arguments)


def test_a_masked_node_of_a_terrain_is_refused():
    """It was taken for the number below the mask: a reflectance of 0.157 in place of 0.300."""
    heights = np.ma.masked_equal(np.where(np.eye(3) > 0, -9999.0, 0.0), -9999.0)
    with pytest.raises(ValueError, match="heights has masked elements"):
        jl.Terrain(heights, spacing=1.0)


@pytest.mark.slow
def test_masked_bands_of_a_leaf_are_left_out():
    """Bands below the mask hold a number that would move N from 1.6 to 1.9."""
    bands = np.arange(500.0, 2400.0, 50.0)
    spectra = [np.asarray(s, float) for s in jl.Prospect(N=1.6)(bands)]
    is_bad = (bands > 1300) & (bands < 1500)
    masked = [np.ma.array(np.where(is_bad, 0.9, s), mask=is_bad) for s in spectra]
    nan = [np.where(is_bad, np.nan, s) for s in spectra]
    fit, expected = inversion.invert_leaves(bands, *masked), inversion.invert_leaves(bands, *nan)
    assert float(fit.traits["N"][0]) == float(expected.traits["N"][0]) == pytest.approx(1.6, abs=0.01)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("[lidar]\naltitude = true\n", "altitude"),
        ("[lidar]\nwavelength = [true, false]\n", "wavelength"),
        ("[lidar]\npulse = {kind = 'GaussianPulse', fwhm = true}\n", "fwhm"),
        ("[scene.ground]\nreflectance = false\n", "reflectance"),
        ("[scene.atmosphere]\nvisibility = true\n", "visibility"),
        ("[simulate]\nseed = true\n", "seed"),
    ],
)
def test_booleans_of_a_case_are_no_numbers(tmp_path, text, field):
    (tmp_path / "case.toml").write_text(text)
    with pytest.raises(TypeError, match=rf"case\.toml: .*{field}"):
        jl.io.read_case(tmp_path / "case.toml")


@pytest.mark.parametrize("name", ["rtol", "max_orders", "max_step"])
def test_booleans_of_arguments_of_a_case_are_no_numbers(tmp_path, name):
    text = f"[lidar]\n[scene.ground]\n[simulate]\nseed = 0\n{name} = true\n"
    (tmp_path / "case.toml").write_text(text)
    with pytest.raises(TypeError, match=f"{name} is a bool"):
        jl.io.read_case(tmp_path / "case.toml").simulate()
