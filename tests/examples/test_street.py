"""The example that scans a street, with few shots."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).resolve().parents[2] / "examples" / "street.py"


@pytest.mark.slow
def test_a_scan_sees_roofs_walls_wires_and_trees(tmp_path):
    spec = importlib.util.spec_from_file_location("street", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    returns = module.main(["--spacing", "1", "--out", str(tmp_path)])

    def height(name):
        return returns.position[returns.material == name, 2]

    assert np.abs(height("ground")).max() < 0.1
    assert np.abs(height("mesh:road") - module.ROAD_HEIGHT).max() < 0.1
    # Eaves and ridge of the largest house.
    assert height("mesh:roof").min() > 3.5
    assert height("mesh:roof").max() == pytest.approx(1.1 * 8.0, abs=0.4)
    assert height("mesh:wall").max() < 1.1 * 8.0
    # A wire sags below the heads of its poles.
    wire = height("mesh:wire")
    assert len(wire) > 20
    assert wire.min() > module.POLE_HEIGHT - module.SAG - 0.2
    assert wire.max() < module.POLE_HEIGHT + 0.4
    assert len(height("mesh:leaf")) > 100
    assert (tmp_path / "street.png").read_bytes().startswith(b"\x89PNG")
