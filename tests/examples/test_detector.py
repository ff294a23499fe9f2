"""The example that trains a detector on labelled waveforms: few of them, and few steps."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).resolve().parents[2] / "examples" / "detector.py"


@pytest.mark.slow
def test_the_detector_learns_the_height_of_the_ground(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("detector", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    errors = module.main(["--side", "20", "--steps", "150", "--out", str(tmp_path)])
    ground, top = (errors[f"{name}: detector"] for name in ("ground", "top"))
    # Heights of the ground span 20 m, those of the top more.
    assert np.median(np.abs(ground)) < 1.0
    assert np.median(np.abs(top)) < 3.0
    assert "inversion.find_ground" in capsys.readouterr().out
    assert (tmp_path / "detector.png").read_bytes().startswith(b"\x89PNG")
