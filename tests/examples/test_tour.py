"""The tour runs from end to end; `.ci/run` checks its types."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import jaxlidar as jl

PATH = Path(__file__).resolve().parents[2] / "examples" / "tour.py"


@pytest.mark.slow
def test_the_tour_writes_its_results(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("tour", PATH)
    assert spec is not None
    assert spec.loader is not None
    tour = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tour)
    tour.main(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"fit.nc", "many.zarr", "tour.png", "wave.nc"}
    fit = jl.open(tmp_path / "fit.nc")
    assert float(fit.values["Cab"]) == pytest.approx(40.0, abs=3.0 * float(fit.stderr["Cab"]) + 0.5)
    assert np.all(np.isfinite(jl.open(tmp_path / "many.zarr").reflectance))
    assert "leaves return" in capsys.readouterr().out
