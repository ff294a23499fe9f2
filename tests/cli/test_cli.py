"""The command: its output, its files and its exit statuses."""

import contextlib
import os
import re
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

import inversion.demo
import jaxlidar as jl
from jaxlidar import cli
from jaxlidar.cli.constants import COMMANDS
from tests.helpers import slow_unless

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "examples" / "scenes"


@pytest.fixture(autouse=True)
def as_installed(monkeypatch):
    """Add the commands of `inversion` as an installed package does, without a cache of compiled programs."""
    points = [metadata.EntryPoint(n, f"inversion.commands:{n}", COMMANDS) for n in ("demo", "retrieve")]
    monkeypatch.setattr(metadata, "entry_points", lambda group: points if group == COMMANDS else [])
    monkeypatch.setattr("jaxlidar.cli.group.compilation_cache", contextlib.nullcontext)


def test_help_names_every_command_and_shows_examples(capsys):
    assert cli.main(["--help"]) == 0
    names = re.findall(r"^  (\w+)  ", capsys.readouterr().out.partition("Commands:")[2], re.MULTILINE)
    built_in = ["convert", "info", "plan", "prospect", "reference", "simulate", "spectra", "tree"]
    assert names == sorted([*built_in, "demo", "retrieve"])
    for name in set(names) - {"demo"}:
        assert cli.main([name, "--help"]) == 0
        out = capsys.readouterr().out
        assert re.search(rf"Examples?:\n    +jaxlidar {name}\b", out), name


@pytest.mark.parametrize("suffix", slow_unless([".nc"], [".nc", ".zarr"]))
def test_simulate_writes_the_waveform_and_its_case(tmp_path, capsys, suffix):
    out, plot = tmp_path / f"a{suffix}", tmp_path / "a.png"
    case = SCENES / "flat_ground.toml"
    assert cli.main(["simulate", str(case), "-o", str(out), "--plot", str(plot)]) == 0
    output, errors = capsys.readouterr()
    assert errors == ""
    assert "Waveform of" in output
    assert float(jl.open(out).reflectance.sum()) == pytest.approx(0.5, rel=1e-4)
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert np.array_equal(jl.rerun(out).reflectance, jl.open(out).reflectance)
    # The other commands read the file.
    assert cli.main(["info", str(out)]) == 0
    assert capsys.readouterr().out == f"{jl.open(out)}\n"
    assert cli.main(["convert", str(out), str(tmp_path / "a.csv")]) == 0
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert np.array_equal(table["reflectance_1064nm"].astype(np.float32), jl.open(out).reflectance[0])
    assert cli.main(["convert", str(out), str(tmp_path / "b.toml")]) == 0
    assert float(jl.io.read_case(tmp_path / "b.toml").scene.ground.reflectance) == 0.5


SURVEY = """
[survey]
kind = "Survey.grid"
lidar = {kind = "Lidar"}
low = [0, 0]
high = [20, 0]
spacing = 10.0
[scene.ground]
slope = 5.0
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", slow_unless([".nc"], [".nc", ".zarr"]))
def test_a_survey_is_simulated_shot_by_shot(tmp_path, capsys, suffix):
    case, out, plot = tmp_path / "a.toml", tmp_path / f"a{suffix}", tmp_path / "a.png"
    case.write_text(SURVEY)
    assert cli.main(["simulate", str(case), "-o", str(out), "--plot", str(plot)]) == 0
    assert capsys.readouterr().out.startswith("3 waveforms of ")
    assert len(jl.open(out)) == 3
    # The same call finds the survey completed.
    assert cli.main(["simulate", str(case), "-o", str(out)]) == 0
    assert capsys.readouterr().out.startswith("3 waveforms of ")
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert cli.main(["info", str(out)]) == 0
    assert capsys.readouterr().out == f"{jl.open(out)}\n"
    assert cli.main(["info", str(case)]) == 0
    output = capsys.readouterr().out
    assert "survey: Survey of 3 shots" in output
    assert "f32[" not in output
    assert cli.main(["plan", str(case)]) == 0
    assert "slope spread" in capsys.readouterr().out
    # The file includes its case.
    assert cli.main(["convert", str(out), str(tmp_path / "b.toml")]) == 0
    assert len(jl.io.read_case(tmp_path / "b.toml").survey) == 3
    assert np.array_equal(jl.rerun(out).reflectance, jl.open(out).reflectance)


def test_an_interrupted_simulation_is_saved(tmp_path, capsys, monkeypatch):
    simulate = jl.simulate

    def interrupted(*args, **kwargs):
        wave = simulate(*args, **{**kwargs, "max_orders": 1})
        wave.info["stopped"] = "interrupted"
        return wave

    monkeypatch.setattr("jaxlidar.results.case.simulate", interrupted)
    out = tmp_path / "a.nc"
    assert cli.main(["simulate", str(SCENES / "flat_ground.toml"), "-o", str(out)]) == 130
    assert jl.open(out).info["stopped"] == "interrupted"

    def early(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxlidar.results.case.simulate", early)
    capsys.readouterr()
    assert cli.main(["simulate", str(SCENES / "flat_ground.toml"), "-o", str(tmp_path / "b.nc")]) == 130
    assert capsys.readouterr().err.strip() == "jaxlidar: interrupted"
    assert not (tmp_path / "b.nc").exists()


def test_an_interrupted_survey_says_where_finished_shots_are(tmp_path, capsys, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    case, out = tmp_path / "a.toml", tmp_path / "a.nc"
    case.write_text(SURVEY)
    monkeypatch.setattr("jaxlidar.results.case.simulate_survey", interrupted)
    assert cli.main(["simulate", str(case), "-o", str(out)]) == 130
    assert f"kept in {out}.zarr: the same command continues" in capsys.readouterr().err
    assert cli.main(["simulate", str(case)]) == 130
    assert "give -o to keep them" in capsys.readouterr().err


def test_plan_is_the_table_of_the_plan(capsys):
    assert cli.main(["plan", str(SCENES / "leaf_plate_low.toml")]) == 0
    assert re.search(r"multiple scattering +yes", capsys.readouterr().out)


def test_tree_writes_a_scene_that_can_be_simulated(tmp_path, capsys):
    out = tmp_path / "a.toml"
    assert cli.main(["tree", "shrub", "--leaf-area", "5", "--voxel-size", "0.5", "-o", str(out)]) == 0
    assert capsys.readouterr().out.startswith("shrub: 2.5")
    voxels = jl.io.read_case(out).scene.canopy.voxels
    assert 2 * float(voxels.leaf.sum()) * 0.5**3 == pytest.approx(5.0, rel=0.05)
    assert cli.main(["tree", "-o", str(tmp_path / "a.nc")]) == 2


def test_prospect_prints_and_writes_spectra(tmp_path, capsys):
    argv = ["prospect", "--N", "1.7", "--Cab", "30", "--at", "532", "-o", str(tmp_path / "a.csv")]
    assert cli.main([*argv, "--plot", str(tmp_path / "a.png")]) == 0
    row = capsys.readouterr().out.splitlines()[1].split()
    R, T = jl.Prospect(N=1.7, Cab=30.0)(532.0)
    assert row[:3] == ["532", f"{float(R):.4f}", f"{float(T):.4f}"]
    assert np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1).shape == (2101, 3)


def test_retrieve_finds_the_ground(tmp_path, capsys):
    scene = jl.Scene(ground=jl.Ground(height=0.5))
    jl.simulate(jl.Lidar(), scene, key=jax.random.key(0)).save(tmp_path / "wave.nc")
    (tmp_path / "start.toml").write_text("[scene.ground]")
    argv = ["retrieve", str(tmp_path / "wave.nc"), str(tmp_path / "start.toml"), "--noise", "0.001"]
    files = ["-o", str(tmp_path / "fit.nc"), "--plot", str(tmp_path / "fit.png")]
    assert cli.main([*argv, "--unknown", "ground.height:-2:2", *files]) == 0
    assert "ground.height  0.5 +-" in capsys.readouterr().out
    assert float(jl.open(tmp_path / "fit.nc").values["ground.height"]) == pytest.approx(0.5, abs=1e-3)
    assert (tmp_path / "fit.png").exists()
    assert cli.main([*argv, "--unknown", "ground.height:2"]) == 2
    assert "not of the form PATH:LOW:HIGH" in capsys.readouterr().err
    assert cli.main([*argv[:3], "--unknown", "ground.height:-2:2"]) == 2
    assert "has no standard errors: give --noise" in capsys.readouterr().err


@pytest.mark.slow
def test_compiled_programs_are_stored_unless_refused(tmp_path):
    """In the user's cache folder; when the command has ended, JAX has its previous configuration."""
    code = (
        "import sys, jax; from jaxlidar._jax import compilation_cache as cache;"
        "from jaxlidar.cli import main;"
        "before = dict(jax.config.values);"
        # A fast machine compiles all programs of the command in less than the minimum time.
        "cache.MIN_COMPILE_TIME = 0.0;"
        "print(main(sys.argv[1:]), jax.config.values == before)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)

    def stored_programs(*argv):
        command = [sys.executable, "-c", code, *argv, "prospect", "--N", "1.5"]
        process = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert process.returncode == 0, process.stderr
        # JAX before 0.11 logs an error for each program that it reads on a CPU.
        assert jax.__version_info__ < (0, 11) or process.stderr == ""
        assert process.stdout.splitlines()[-1] == "0 True"
        return {path.name for path in tmp_path.rglob("*-cache")}

    assert not stored_programs("--no-cache")
    programs = stored_programs()
    assert programs or sys.platform != "linux"
    assert stored_programs() == programs


def test_a_command_that_cannot_be_loaded_reports_the_reason(monkeypatch, capsys):
    points = [
        metadata.EntryPoint("gone", "inversion.nowhere:gone", COMMANDS),
        metadata.EntryPoint("number", "math:pi", COMMANDS),
    ]
    monkeypatch.setattr(metadata, "entry_points", lambda group: points)
    assert cli.main(["--help"]) == 0
    capsys.readouterr()
    assert cli.main(["gone"]) == 1
    assert "the command gone cannot be loaded: No module named" in capsys.readouterr().err
    assert cli.main(["number"]) == 1
    assert "math:pi is no click.Command" in capsys.readouterr().err


def test_without_its_libraries_the_command_names_the_extra_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "click", None)
    assert cli.main(["spectra"]) == 1
    assert capsys.readouterr().err == "jaxlidar: the command needs click: pip install 'jaxlidar[cli]'\n"


@pytest.mark.parametrize(
    ("argv", "status", "message"),
    [
        (["simulate", "nowhere.toml"], 1, "nowhere.toml: no such file"),
        (["plan", "BAD"], 1, "BAD: scen is not known; the nearest is scene"),
        (["plan", "EMPTY"], 2, "EMPTY has no scene"),
        (["info", "OTHER"], 2, "files end in .toml, .nc"),
        (["convert", "BAD", "a.nc"], 2, ".toml to .nc is none of .nc to .csv"),
        (["prospect", "--N", "0.5"], 1, "N = 0.5 is outside the admissible range [1, inf)"),
    ],
)
def test_inadmissible_arguments_are_refused_in_a_sentence(argv, status, message, tmp_path, capsys):
    for name, text in (("BAD", "[scen]"), ("EMPTY", ""), ("OTHER", "")):
        path = tmp_path / f"{name}{'.xyz' if name == 'OTHER' else '.toml'}"
        path.write_text(text)
        argv = [str(path) if a == name else a for a in argv]
        message = message.replace(f"{name}", str(path))
    assert cli.main(argv) == status
    assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("option", "name", "message"),
    [
        ("--plot", "a.xyz", "a.xyz' ends in none of .eps, "),
        ("-o", "a.txt", "a.txt' ends in none of .nc, .zarr"),
        ("-o", "a", "a' ends in none of .nc, .zarr"),
    ],
)
def test_names_of_no_known_ending_are_refused_before_the_work(option, name, message, tmp_path, capsys):
    # The case, which does not exist, would be read next.
    assert cli.main(["simulate", "nowhere.toml", option, str(tmp_path / name)]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_figures_are_written_by_their_ending(tmp_path):
    assert cli.main(["spectra", "soil", "--plot", str(tmp_path / "a.pdf")]) == 0
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")


def test_spectra_are_listed_with_reflectances(capsys):
    assert cli.main(["spectra", "soil"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["name", "kind", "532", "nm", "1064", "nm", "1550", "nm"]
    assert [row.split()[0] for row in rows] == list(jl.spectrum_names("soil"))
    assert rows[2].split()[-2] == f"{float(jl.spectrum('soil-medium')(1064.0)):.2f}"


def test_all_spectra_are_listed_without_a_kind(capsys):
    assert cli.main(["spectra"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(jl.spectrum_names())


def test_version_is_the_installed_one(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxlidar {metadata.version('jaxlidar')}\n"


@pytest.mark.parametrize("argv", [["nonsense"], ["spectra", "--nonsense"]])
def test_wrong_usage_ends_with_status_2(argv, capsys):
    assert cli.main(argv) == 2
    assert "Usage: jaxlidar" in capsys.readouterr().err


def test_an_unknown_kind_is_refused_in_a_sentence(capsys):
    assert cli.main(["spectra", "soi"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("jaxlidar: kind = 'soi' is none of 'bark'")


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--rtol", "0", "0 is not in the range 0<x<1."),
        ("--rtol", "nan", "nan is not in the range 0<x<1."),
        ("--seed", "-1", "-1 is not in the range 0<=x<=2147483647."),
        ("--voxel-size", "2", "2.0 is not in the range 0<x<=1."),
    ],
)
def test_demo_refuses_inadmissible_options(tmp_path, capsys, option, value, message):
    assert cli.main(["demo", "--out", str(tmp_path / "new"), option, value]) == 2
    assert message.replace("0 is", "0.0 is" if option == "--rtol" else "0 is") in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_demo_refuses_a_folder_that_is_a_file(tmp_path, capsys):
    path = tmp_path / "taken"
    path.touch()
    assert cli.main(["demo", "--out", str(path)]) == 2
    assert "taken" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status"), [(KeyboardInterrupt(), 130), (OSError(28, "No space left on device"), 1)]
)
def test_interrupts_and_failures_to_write_leave_no_traceback(monkeypatch, capsys, error, status):
    def fails(*args, **kwargs):
        raise error

    monkeypatch.setattr(inversion.demo, "run", fails)
    monkeypatch.setattr(Path, "mkdir", lambda *args, **kwargs: None)
    assert cli.main(["demo", "--quiet"]) == status
    assert capsys.readouterr().err.strip().count("\n") == 0


@pytest.mark.slow
def test_demo_retrieves_the_truth_and_writes_figures(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(inversion.demo, "FIT_PHOTONS", 4096)
    monkeypatch.setattr(inversion.demo, "FIT_RAYS", 128)
    out = tmp_path / "new" / "folder"
    assert cli.main(["demo", "--out", str(out), "--voxel-size", "1", "--rtol", "0.03", "--quiet"]) == 0
    output, errors = capsys.readouterr()
    assert errors == ""
    assert sorted(p.name for p in out.iterdir()) == ["retrieval.png", "waveform.png"]
    for path in out.iterdir():
        assert str(path) in output
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size < 150_000
    rows = output.split("std. error  unit\n")[1].split("reduced")[0].splitlines()
    assert len(rows) == 7
    for row in rows:
        true, start, estimate, error = map(float, re.findall(r"(?<= )-?[\d.]+(?:e-?\d+)?(?= |$)", row)[:4])
        assert abs(estimate - true) < 0.3 * abs(start - true), row
        assert abs(estimate - true) < 4.5 * error, row
    assert "; converged" in output


def test_a_figure_that_cannot_be_written_leaves_no_file(tmp_path):
    class FailingFigure(Figure):
        def savefig(self, path, **kwargs):
            path.write_bytes(b"half")
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        inversion.demo.save(FailingFigure(), tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_a_closed_pipe_is_no_failure(tmp_path):
    code = "import sys; from jaxlidar.cli import main; sys.exit(main(['spectra']))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    environment["XDG_CACHE_HOME"] = str(tmp_path)
    command = f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} | head -n 1"
    process = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True)
    assert process.stderr == ""
    assert process.stdout.startswith("name")


def test_the_demo_tree_has_its_stated_size():
    from jaxlidar.plants.demo import HEIGHT, LEAF_AREA, demo_scene

    voxels = demo_scene(0.25).canopy.voxels
    leaf, bark = np.asarray(voxels.leaf), np.asarray(voxels.bark)
    # Twice the extinction is the leaf area density.
    assert np.isclose(2 * leaf.sum() * 0.25**3, LEAF_AREA, rtol=1e-3)
    (levels,) = np.nonzero(bark.any(axis=(0, 1)))
    assert np.isclose((levels[-1] + 1) * 0.25 + float(voxels.origin[2]), HEIGHT, atol=0.25)
    assert float(voxels.origin[2]) >= -0.25
