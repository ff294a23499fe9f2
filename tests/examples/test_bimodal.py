"""The example of a posterior with two modes: which methods find both, with their probabilities."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

PATH = Path(__file__).resolve().parents[2] / "examples" / "bimodal.py"


@pytest.mark.slow
def test_tempering_finds_both_modes_and_a_chain_one(tmp_path):
    pytest.importorskip("blackjax")
    spec = importlib.util.spec_from_file_location("bimodal", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    results = module.main(["--out", str(tmp_path)])
    assert (tmp_path / "bimodal.png").read_bytes().startswith(b"\x89PNG")

    is_low, grid = results.grid < module.VALLEY, results.grid
    probability = results.probability
    low = probability[is_low].sum()
    assert 0.2 < low < 0.8

    def mode(side):
        weight = probability[side] / probability[side].sum()
        mean = weight @ grid[side]
        return mean, np.sqrt(weight @ (grid[side] - mean) ** 2)

    # Each fit describes its own mode, and neither knows of the other.
    for fit, side in zip(results.fits, (is_low, ~is_low)):
        mean, std = mode(side)
        assert abs(float(fit.values["ground"]) - mean) < 0.3 * std
        assert float(fit.stderr["ground"]) == pytest.approx(std, rel=0.2)
    assert np.all(results.nuts < module.VALLEY)
    assert np.std(results.nuts) == pytest.approx(mode(is_low)[1], rel=0.25)

    # Islands are independent: a z-test of their mean, which rejects equal weights and a single mode.
    by_island = np.mean(results.tempered < module.VALLEY, axis=1)
    stderr = np.std(by_island, ddof=1) / np.sqrt(by_island.size)
    assert abs(by_island.mean() - low) < 3 * stderr
    assert abs(by_island.mean() - 0.5) > 4 * stderr
    assert abs(by_island.mean() - 1.0) > 4 * stderr
    in_low = results.tempered[results.tempered < module.VALLEY]
    assert np.std(in_low) == pytest.approx(mode(is_low)[1], rel=0.25)
