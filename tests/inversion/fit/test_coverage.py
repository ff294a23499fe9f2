"""Retrievals of a few noisy targets are as good as they can be, and as good as they say."""

import importlib
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[3] / "examples" / "benchmarks"


@pytest.mark.slow
def test_retrievals_reach_the_bound_and_their_intervals_cover(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "_common", raising=False)
    try:
        sizes = {"targets": 16, "photons": 8192, "starts": 2, "exact": 2}
        summary = importlib.import_module("run").run("retrieval_coverage", tmp_path, **sizes)
    finally:
        for name in ("_common", "run", "retrieval_coverage"):
            sys.modules.pop(name, None)
    assert summary["converged"] >= 0.9
    # 112 intervals, of which neighbours share a fit: 0.95 with a standard error of about 0.03.
    assert 0.86 <= summary["covered"] <= 1.0
    for unknown in summary["unknowns"].values():
        # The root mean square of 16 normal numbers is below 1.5 in 99.9 % of cases.
        assert unknown["rms_over_bound"] < 1.5
        assert unknown["noise_free_median"] < 5e-3
    assert (tmp_path / "retrieval_coverage.png").exists()
