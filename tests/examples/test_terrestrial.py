"""The example that scans a tree from a tripod, with few beams."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).resolve().parents[2] / "examples" / "terrestrial.py"


@pytest.mark.slow
def test_a_scan_sees_the_tree_and_the_ground(tmp_path):
    spec = importlib.util.spec_from_file_location("terrestrial", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    returns = module.main(["--step", "3", "--out", str(tmp_path)])
    # Ranges count from the scanner.
    distance = np.linalg.norm(returns.position - module.SENSOR, axis=1)
    assert np.allclose(distance, returns.range, atol=0.01)
    assert np.abs(returns.position[returns.material == "ground", 2]).max() < 0.3
    leaves = returns.position[returns.material == "mesh:leaf"]
    assert len(leaves) > 30
    assert np.all(np.hypot(*leaves[:, :2].T) < 11.0)
    assert leaves[:, 2].max() < 17.0
    assert (tmp_path / "terrestrial.png").read_bytes().startswith(b"\x89PNG")
