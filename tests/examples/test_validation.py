"""The scripts of `examples/validation` run end to end, and their page is made from their records."""

import dataclasses
import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "validation"
SCRIPTS = sorted(
    p.stem for p in FOLDER.glob("*.py") if not p.stem.startswith("_") and p.stem != "make_readme"
)
# Modules in the folders of examples: a name may stand for several files, so imports must not be kept.
EXAMPLE_MODULES = (
    *("_common", "_crown", "_rami", "_validation", "_waveforms", "peers", "simulation_cost"),
    *("surveys", "recorded_clouds"),
)


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Return a function that runs a script as from the command line and returns its record."""
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in EXAMPLE_MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)

    def load(name):
        spec = importlib.util.spec_from_file_location(f"validation_{name}", FOLDER / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    def call(name, *arguments, planted=None):
        module = load(name)
        if planted is not None:
            planted(module)
        record = module.main([*map(str, arguments), "--out", str(tmp_path), "--quiet"])
        written = json.loads((tmp_path / f"{name}.json").read_text())
        assert written["summary"] == json.loads(json.dumps(record["summary"]))
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert record["rows"]
        return record

    yield call
    for name in EXAMPLE_MODULES:
        sys.modules.pop(name, None)


def over_error(record, word=""):
    """Return differences over their errors, of comparisons with a word in their name or case."""
    ratios = np.array([row["over error"] for row in record["rows"] if word in row["what"] + row["case"]])
    assert ratios.size
    return ratios


def holds(record, word=""):
    """True if all comparisons are within their bounds, or four standard errors."""
    most = [1.0 if "bound" in row else 4.0 for row in record["rows"] if word in row["what"] + row["case"]]
    return bool(np.all(np.abs(over_error(record, word)) <= most))


def test_the_page_is_made_from_the_records():
    code = "import make_readme; print(make_readme.page(), end='')"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=FOLDER, check=True
    )
    assert process.stdout == (FOLDER / "README.md").read_text()


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_has_its_record_and_its_picture(name):
    text = (FOLDER / "results" / f"{name}.json").read_text()
    record, page = json.loads(text), (FOLDER / "README.md").read_text()
    assert record["script"] == name
    assert "/" not in json.dumps(record["summary"]).replace("/cm2", "")
    assert f"](results/{name}.png)" in page
    assert (FOLDER / "results" / f"{name}.png").stat().st_size < 300_000
    # Records with data of other owners hold no values but those of the largest difference.
    assert ("rows" in record) is not any(word in name for word in ("rami", "leaf", "recorded"))
    for row in record["summary"]:
        assert row["difference"] == pytest.approx(row["here"] - row["there"])
        error = row["standard error"] if "standard error" in row else row["bound"]
        assert row["over error"] == pytest.approx(row["difference"] / error)


def test_elementary_functions(run, capsys):
    assert holds(run("mpmath_plate", "--points", "8"))
    assert capsys.readouterr() == ("", "")

    def plant(module):
        exact = module.LAYER["2 E3(k)"]
        module.LAYER["2 E3(k)"] = lambda k: exact(k) * (1 + 1e-5)

    wrong = run("mpmath_plate", "--points", "8", planted=plant)
    assert not holds(wrong, "2 E3(k)")
    assert holds(wrong, "leaf")


@pytest.mark.slow
def test_leaves_by_prosail(run):
    assert holds(run("prosail_leaves", "--leaves", "10"))


@pytest.mark.slow
def test_canopies_by_prosail(run):
    few = ("--indices", "1", "--sizes", "1")
    assert holds(run("prosail_canopy", *few, "--realisations", "3"))

    def plant(module):
        sail, exact = module.foursail, module.random_leaves
        # The sixth is the leaf area index.
        module.foursail = lambda *inputs: sail(*inputs[:5], 1.05 * inputs[5], *inputs[6:])
        module.random_leaves = lambda sun, view, area: exact(sun, view, 2 * area)

    wrong = run("prosail_canopy", *few, "--realisations", "2", "--photons", "8192", planted=plant)
    assert not holds(wrong, "leaves without size")
    assert not holds(wrong, "leaves with a size")


@pytest.mark.slow
def test_slabs(run):
    assert holds(run("discrete_ordinates", "--slabs", "5", "--rtol", "0.003"))

    def plant(module):
        tau, _, ground, orders = module.SLABS["1, isotropic 0.9, 0.2"]
        del module.SLABS["1, isotropic 0.9, 0.2"]
        module.SLABS = {"wrong": (tau, module.jl.Isotropic(albedo=0.9), ground, orders)}
        solve = module.solve
        module.solve = lambda tau, *arguments: solve(1.05 * tau, *arguments)

    wrong = run("discrete_ordinates", "--slabs", "1", "--rtol", "0.003", planted=plant)
    assert not holds(wrong, "reflectance factor")


@pytest.mark.slow
def test_open_forests(run, shared):
    """Within 0.01; where light comes in flat, also two standard deviations of one arrangement of crowns."""
    record = run("rami4pilps", shared / "reference" / "rami4pilps.csv", "--arrangements", "3")
    assert len(record["rows"]) == 162
    for row in record["rows"]:
        most = 0.01 + (2 * row["arrangements_apart"] if row["zenith"] == 83 else 0.0)
        assert abs(row["difference"]) < most, row


@pytest.fixture
def rami(monkeypatch):
    """Return the module of the canopies of RAMI."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "_rami", raising=False)
    yield importlib.import_module("_rami")
    sys.modules.pop("_rami", None)


def few_discs(rami, radius, ground=0.159):
    """Return a canopy of 400 discs in a sphere, repeated every 20 m."""
    normal = rami.sphere(1.0, 3).draw(400)
    discs = np.column_stack([np.full(400, radius), rami.sphere(5.0).draw(400), normal])
    cloud = rami.Cloud(discs, np.array([[0.0, 0.0, 8.0]]), 0.5, 0.4, rami.sphere(5.0))
    return rami.Forest((cloud,), ground, 20.0, 20.0, 15.0, True, 15.0)


def test_triangles_and_voxels_have_the_area_of_their_discs(rami):
    forest = few_discs(rami, 0.3)
    (cloud,), leaf_area = forest.clouds, 400 * np.pi * 0.3**2
    vertices, faces = rami.polygons(cloud.discs)
    first, *others = np.moveaxis(vertices[faces], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(others[0] - first, others[1] - first), axis=1)
    np.testing.assert_allclose(area.sum(), leaf_area, rtol=1e-12)
    for even in (False, True):
        lad = rami.density(cloud, forest, 0.5, even)
        np.testing.assert_allclose(lad.sum() * 0.5**3, leaf_area, rtol=1e-5)


def test_scattering_by_leaves_is_normalised_and_sampled_from_its_density(rami):
    scattering = rami.LeafScattering(0.45, 0.30)
    cosine = np.linspace(-1.0, 1.0, 20_001)
    density = 2 * scattering._factor(cosine, 0.4, np)
    integral = np.trapezoid(density, cosine)
    assert integral == pytest.approx(1.0, abs=1e-6)
    u, v = jax.random.uniform(jax.random.key(0), (2, 40_000))
    down = tuple(jnp.full(u.shape, x) for x in (0.0, 0.0, -1.0))
    drawn = -np.asarray(scattering.sample(down, u, v)[2])
    for power in (1, 2):
        expected = np.trapezoid(density * cosine**power, cosine)
        z = (np.mean(drawn**power) - expected) / (np.std(drawn**power) / np.sqrt(len(u)))
        assert abs(z) < 4


@pytest.mark.slow
def test_waveforms_over_discs(run):
    """In all: of so few discs, heights are blurred by the bins of the tracer."""

    def plant(module, factor=1.0):
        forest = few_discs(sys.modules["_rami"], 0.5)
        module.read_forest, module.SIZES, exact = lambda *_: forest, (), module.exact_first_order
        brighter = forest.clouds[0]._replace(reflectance=0.5 * factor)
        module.exact_first_order = lambda _, *rest: exact(forest._replace(clouds=(brighter,)), *rest)
        module.DIAMETER = 10.0

    few = ("folder", "--photons", "4096", "--canopies", "1")
    assert holds(run("rami_waveforms", *few, planted=plant), "in all")
    wrong = run("rami_waveforms", *few, planted=lambda module: plant(module, 1.1))
    assert not holds(wrong, "in all")


@pytest.mark.slow
def test_times_of_flight(run):
    """They hold by their errors; not with 1 % more extinction, nor by a field of view that is 5 % wider."""
    assert holds(run("flight_times"))

    def plant(module):
        exact = module.exact
        module.exact = lambda edges: exact(1.01 * edges)

    wrong = run("flight_times", "--photons", "65536", planted=plant)
    assert not holds(wrong, "order 1")
    assert not holds(wrong, "order 2")
    assert not holds(wrong, "all orders")

    def plant_radius(module):
        share = module.seen_share
        module.seen_share = lambda edges, radius: share(edges, 1.05 * radius)

    wrong = run("flight_times", "--photons", "65536", planted=plant_radius)
    assert holds(wrong, "order 2albedo")
    assert not holds(wrong, "point pulse")


@pytest.mark.slow
def test_pulses_in_an_infinite_medium(run):
    """Shares of photons hold by their errors; not those of a time that is 5 % longer."""
    assert holds(run("infinite_medium", "--photons", "100000"))

    def plant(module):
        exact = dict(module.SHARES)
        module.SHARES = {k: lambda x, t, f=f: f(x, 1.05 * t) for k, f in exact.items()}

    wrong = run("infinite_medium", "--photons", "100000", planted=plant)
    for name in ("plane", "line", "point"):
        assert not holds(wrong, f"{name} pulse")


def skip_without(package):
    """Skip the test if a package is missing."""
    # Not imported: mitransient refuses to be, before its script has chosen a variant of Mitsuba.
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "package"), [("mitransient_crown", "mitransient"), ("mcx_crown", "pmcxcl")])
def test_other_codes(run, name, package):
    skip_without(package)
    record = run(name, "--repeats", "8")
    assert np.sqrt(np.mean(over_error(record) ** 2)) < 2.5


@pytest.mark.slow
def test_meshes_by_mitransient(run):
    skip_without("mitransient")
    record = run("mitransient_meshes", "--repeats", "8")
    assert holds(record)
    assert {cost["code"] for cost in record["costs"]} == {"jaxlidar", "mitransient"}

    def plant(module):
        # The renderer's scene keeps its reflectances.
        surface = module.jl.MeshSurface
        module.jl = SimpleNamespace(**vars(module.jl))
        module.jl.MeshSurface = lambda mesh, reflectance: surface(mesh, 1.03 * reflectance)

    wrong = run("mitransient_meshes", "--repeats", "4", planted=plant)
    assert not holds(wrong, "returned in all")


@pytest.mark.slow
def test_fields_of_view_by_multiscatter(run):
    """Within 20 % where light diffuses, as photons in NumPy everywhere; not with half the field of view."""
    program = shutil.which("multiscatter")
    if program is None:
        pytest.skip("multiscatter is not on the path")
    record = run("multiscatter_slabs", program, "--photons", "65536")
    assert holds(record, "samples of the tail")
    for slab in ("isotropic, optical depth 12", "forward, optical depth 80"):
        assert holds(record, f"late tail: {slab}")

    def plant(module):
        exact = module.simulate_slab
        module.SLABS = dict(list(module.SLABS.items())[:1])
        module.simulate_slab = lambda tau, g, radius, *rest: exact(tau, g, 0.5 * radius, *rest)

    wrong = run("multiscatter_slabs", program, "--photons", "65536", planted=plant)
    assert not holds(wrong, "late tail")
    assert not holds(wrong, "samples of the tail")


@pytest.mark.slow
def test_measured_leaves(run, shared):
    names = ("angers_half.npz", "lopex_half.npz", "nasa_fft_quarter.npz")
    record = run("leaf_databases", *(shared / "leaves" / name for name in names))
    for trait in ("Cw", "Cm"):
        assert np.mean(np.abs(over_error(record, trait)) < 2) > 0.95
    assert all(summary_row["within"] > 0.85 for summary_row in record["summary"])
    assert any("needles" in summary_row["what"] for summary_row in record["summary"])


@pytest.mark.slow
def test_recorded_shots_of_gedi(run, shared):
    (path,) = (shared / "gedi").glob("GEDI01_B_*.h5")
    assert holds(run("recorded_gedi", path, shared / "gedi" / "level2_answers_60_shots.npz", "--shots", "10"))


@pytest.mark.slow
def test_learned_posterior_of_recorded_shots(run, shared):
    """Intervals of 90 % hold what they claim on simulated records."""
    skip_without("flowjax")
    (path,) = (shared / "gedi").glob("GEDI01_B_*.h5")
    record = run("recorded_posterior", path, shared / "gedi" / "level2_answers_60_shots.npz")
    coverage = [row["here"] for row in record["rows"] if "interval" in row["what"]]
    assert len(coverage) == 4
    assert all(0.86 <= share <= 0.94 for share in coverage)


@pytest.mark.slow
def test_recorded_returns_of_neon(run, shared):
    assert holds(run("recorded_neon", shared / "neon" / "neon_harvard_250.npz", "--shots", "20"))


@pytest.mark.slow
def test_recorded_shots_of_riegl(run, shared):
    record = run("recorded_riegl", *(shared / "airborne" / f"riegl.{kind}" for kind in ("las", "pls")))
    assert holds(record, "anchor")
    assert holds(record, "as many")
    # Where two echoes overlap, the software of the scanner places points differently.
    assert np.mean(np.abs(over_error(record, "echo,")) <= 1) > 0.95


@pytest.mark.slow
def test_recorded_flat_ground(run, shared):
    """Within a tenth of the best sum of pulses; not where noise is taken as independent."""
    path = shared / "airborne" / "riegl.pls"
    assert holds(run("recorded_flat", path))

    def plant(module):
        module.CORRELATED = 0.0

    assert not holds(run("recorded_flat", path, planted=plant))


@pytest.mark.slow
def test_recorded_shots_of_lvis(run, shared):
    record = run("recorded_lvis", shared / "airborne" / "lvis_example2.pls", "--shots", "8")
    assert holds(record, "apart")
    assert np.median(np.abs(over_error(record, "rms"))) < 1


@pytest.mark.slow
def test_airborne_clouds(run, shared):
    """Medians over the footprints of two clouds are within the bounds; not with a longer pulse."""
    als = shared / "als"
    record = run(
        "recorded_clouds", als / "gedi_simulator.npz", als / "megaplot.laz", als / "mixedconifer.laz"
    )
    assert holds(record, "simulated")
    assert holds(record, "sum of points")

    def plant(module):
        module.PULSE = 1.5

    assert not holds(run("recorded_clouds", als / "gedi_simulator.npz", als / "megaplot.laz", planted=plant))


@pytest.mark.slow
# The clouds are on NAD83.
@pytest.mark.filterwarnings("ignore:crs. the accuracy of the transformation")
@pytest.mark.parametrize("name", ["megaplot", "mixedconifer", "topography"])
def test_footprints_over_airborne_clouds(run, shared, name):
    """Metrics of the GEDI simulator over its clouds; with a pulse three times as long, other waveforms."""
    files = shared / "als" / "gedi_simulator.npz", shared / "als" / f"{name}.laz"
    rows = run("recorded_footprints", *files)["rows"]

    def value(what, metric):
        (row,) = (r for r in rows if r["what"].startswith(what) and r["case"].startswith(f"{metric}, "))
        return row["here"]

    assert holds({"rows": rows}, "correlation of waveforms")
    # Below the gap between crowns and ground, where little energy is, percentiles are ill-defined.
    for percent in (50, 75, 90, 95, 98):
        assert abs(value("median", f"rhReal {percent}")) < 0.2
        assert value("correlation", f"rhReal {percent}") > (0.99 if percent > 50 else 0.975)
        for metric, bound in (("rhMax", 0.4), ("rhInfl", 0.4), ("rhGauss", 0.5)):
            assert abs(value("median", f"{metric} {percent}")) < bound
    for metric, bound in (("FHD", 0.05), ("maxHalfCov", 0.05), ("signal top", 0.3)):
        assert abs(value("median", metric)) < bound
        assert value("correlation", metric) > 0.85
    assert abs(value("median", "ALS cover")) < 0.05

    def plant(module):
        longer = dataclasses.replace(module.lidar(), pulse=jl.GaussianPulse(fwhm=45.0))
        module.lidar = lambda: longer

    planted = run("recorded_footprints", *files, planted=plant)
    assert not holds(planted, "correlation of waveforms")


@pytest.mark.slow
def test_recorded_photons_of_icesat2(run, shared):
    """The ground holds by its errors; not that of a track that is 2 m too high."""
    paths = [shared / "icesat2" / name for name in ("atl03_half.h5", "atl08_half.h5")]
    record = run("recorded_photons", *paths)
    assert holds(record, "ground")
    assert holds(record, "where the product has one")
    assert record["agreement"]["ground"]["median absolute difference"] < 0.5
    assert record["agreement"]["ground"]["largest"] < 2.0

    def plant(module):
        read = module.read_atl03
        module.read_atl03 = lambda path: dataclasses.replace(read(path), height=read(path).height + 2.0)

    assert not holds(run("recorded_photons", *paths, planted=plant), "ground")


@pytest.mark.slow
def test_standard_errors_are_those_of_scatter(run):
    """Energy budgets, of which eight keys tell little; planted: errors of half the size."""

    def one_case(factor: float):
        def plant(module):
            make = module.CASES["energy budget of a waveform"]

            def planted():
                estimate = make()
                return lambda key: tuple(a * f for a, f in zip(estimate(key), (1.0, factor)))

            module.CASES = {"energy budget of a waveform": planted}
            module.fitted_profiles = lambda keys: np.ones((keys, 1))

        return plant

    right, wrong = (run("standard_errors", "--keys", "24", planted=one_case(f)) for f in (1.0, 0.5))
    assert 0.8 < right["rows"][0]["here"] < 1.25
    assert wrong["rows"][0]["here"] > 1.6


@pytest.mark.slow
def test_photons_on_slopes(run, monkeypatch):
    """190 simulated segments hold by their errors; not by the narrow echo of level ground."""
    assert holds(run("photons_on_slopes", "--every", "23"))
    monkeypatch.setattr("inversion.metrics.photons._ECHO_WIDTHS", (0.3,))
    wrong = run("photons_on_slopes", "--every", "23")
    assert not holds(wrong, "ground, all: biascanopies from 4 m, 15 degrees")
    assert not holds(wrong, "ground, all: biascanopies from 4 m, 20 degrees")
    assert not holds(wrong, "ground, all: share within two standard errors, up to 0.95all")
