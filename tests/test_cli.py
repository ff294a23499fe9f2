"""The command: what it prints, what it writes, and how it ends."""

import os
import re
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import inversion.demo
import jaxlidar as jl
from jaxlidar import cli

ROOT = Path(__file__).resolve().parents[1]


def test_spectra_are_listed_with_reflectances(capsys):
    assert cli.main(["spectra", "soil"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["name", "kind", "532", "nm", "1064", "nm", "1550", "nm"]
    assert [row.split()[0] for row in rows] == list(jl.spectra("soil"))
    assert rows[2].split()[-2] == f"{float(jl.spectrum('soil-medium')(1064.0)):.2f}"


def test_all_spectra_are_listed_without_a_kind(capsys):
    assert cli.main(["spectra"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(jl.spectra())


def test_version_is_the_installed_one(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"jaxlidar {cli.version()}\n"


@pytest.mark.parametrize("argv", [[], ["nonsense"], ["spectra", "--nonsense"]])
def test_wrong_usage_ends_with_status_2(argv, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(argv)
    assert ended.value.code == 2
    assert "usage: jaxlidar" in capsys.readouterr().err


def test_an_unknown_kind_is_refused_in_a_sentence(capsys):
    assert cli.main(["spectra", "soi"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("jaxlidar: kind = 'soi' is none of 'bark'")


@pytest.fixture
def with_demo(monkeypatch):
    """The command `demo` as an installed package would add it."""
    point = metadata.EntryPoint("demo", "inversion.demo:demo", cli.COMMANDS)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point] if group == cli.COMMANDS else [])


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--rtol", "0", "--rtol 0 is outside the admissible range (0, 1)."),
        ("--rtol", "nan", "--rtol nan is outside the admissible range (0, 1)."),
        ("--seed", "-1", "--seed -1 is outside the admissible range [0, 2147483648)."),
        ("--voxel-size", "2", "--voxel-size 2 is outside the admissible range (0, 1]."),
    ],
)
def test_demo_refuses_inadmissible_options(with_demo, tmp_path, capsys, option, value, says):
    assert cli.main(["demo", "--out", str(tmp_path / "new"), option, value]) == 1
    assert capsys.readouterr().err == f"jaxlidar: {says}\n"
    assert not (tmp_path / "new").exists()


def test_demo_refuses_a_folder_that_is_a_file(with_demo, tmp_path, capsys):
    path = tmp_path / "taken"
    path.touch()
    assert cli.main(["demo", "--out", str(path)]) == 1
    assert "taken" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status"), [(KeyboardInterrupt(), 130), (OSError(28, "No space left on device"), 1)]
)
def test_interrupts_and_failures_to_write_leave_no_traceback(with_demo, monkeypatch, capsys, error, status):
    def fails(*args, **kwargs):
        raise error

    monkeypatch.setattr(inversion.demo, "run", fails)
    monkeypatch.setattr(Path, "mkdir", lambda *args, **kwargs: None)
    assert cli.main(["demo", "--quiet"]) == status
    assert capsys.readouterr().err.count("\n") == 1


def test_demo_retrieves_the_truth_and_writes_figures(with_demo, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(inversion.demo, "FIT_PHOTONS", 4096)
    monkeypatch.setattr(inversion.demo, "FIT_RAYS", 1024)
    out = tmp_path / "new" / "folder"
    assert cli.main(["demo", "--out", str(out), "--voxel-size", "1", "--rtol", "0.03", "--quiet"]) == 0
    printed, said = capsys.readouterr()
    assert said == ""
    assert sorted(p.name for p in out.iterdir()) == ["retrieval.png", "waveform.png"]
    for path in out.iterdir():
        assert str(path) in printed
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size < 150_000
    rows = printed.split("std. error  unit\n")[1].split("reduced")[0].splitlines()
    assert len(rows) == 7
    for row in rows:
        true, start, estimate, error = map(float, re.findall(r"(?<= )-?[\d.]+(?:e-?\d+)?(?= |$)", row)[:4])
        assert abs(estimate - true) < 0.3 * abs(start - true), row
        assert abs(estimate - true) < 4.5 * error, row
    assert "; converged" in printed


def test_figures_are_renamed_when_whole(tmp_path):
    class Failing(Figure):
        def savefig(self, path, **kwargs):
            path.write_bytes(b"half")
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        inversion.demo.save(Failing(), tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_reading_only_the_first_lines_is_no_failure():
    code = "import sys; from jaxlidar.cli import main; sys.exit(main(['spectra']))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    command = f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} | head -n 1"
    ended = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True)
    assert ended.stderr == ""
    assert ended.stdout.startswith("name")


def test_the_demo_tree_has_the_size_that_is_said():
    from jaxlidar.plants.demo import HEIGHT, LEAF_AREA, demo_scene

    voxels = demo_scene(0.25).canopy.voxels
    leaf, bark = np.asarray(voxels.leaf), np.asarray(voxels.bark)
    # Twice the extinction is the leaf area density.
    assert np.isclose(2 * leaf.sum() * 0.25**3, LEAF_AREA, rtol=1e-3)
    (levels,) = np.nonzero(bark.any(axis=(0, 1)))
    assert np.isclose((levels[-1] + 1) * 0.25 + float(voxels.origin[2]), HEIGHT, atol=0.25)
    assert float(voxels.origin[2]) >= -0.25
