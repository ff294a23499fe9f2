"""The example that fits a spectrum and a waveform at once: errors against scatter, gain of each record."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

PATH = Path(__file__).resolve().parents[2] / "examples" / "spectrum_and_waveform.py"
DRAWS = 4
RUN = f"""
import numpy as np
import spectrum_and_waveform as example

problem, posteriors = example.main(["--out", "."])
draws = [example.fit(problem, example.noisy_records(problem, seed)) for seed in range(1, {DRAWS + 1})]
np.savez(
    "results.npz",
    estimates=[draw.estimate for draw in draws],
    covariances=[draw.covariance for draw in draws],
    **{{label: posterior.stderr for label, posterior in posteriors.items()}},
)
"""


def load():
    spec = importlib.util.spec_from_file_location("spectrum_and_waveform", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_both_records_tell_more_than_either_and_errors_are_those_of_noise(tmp_path):
    # In a process of its own, whose programs are optimised: it runs them hundreds of times.
    path = os.pathsep.join([str(PATH.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "XLA_FLAGS": "", "PYTHONPATH": path}
    subprocess.run([sys.executable, "-c", RUN], cwd=tmp_path, env=environment, check=True)
    assert (tmp_path / "spectrum_and_waveform.png").read_bytes().startswith(b"\x89PNG")
    results, module = np.load(tmp_path / "results.npz"), load()
    names = list(module.UNKNOWNS)
    spectrum, waveform, joint = (dict(zip(names, results[k])) for k in ("spectrum", "waveform", "both"))
    # The waveform knows no chlorophyll beyond its prior, and leaf area better than the spectrum.
    assert waveform["chlorophyll"] > 0.98 * module.UNKNOWNS["chlorophyll"].prior[1]
    assert waveform["leaf area index"] < 0.7 * spectrum["leaf area index"]
    # Leaf structure and soil, which the waveform tells, are what makes chlorophyll of the spectrum uncertain.
    assert joint["chlorophyll"] < 0.8 * spectrum["chlorophyll"]
    assert joint["leaf area index"] < waveform["leaf area index"]

    # Stated errors are those of repeated noise; another chlorophyll, 10 µg/cm² away, is rejected.
    pair = [names.index("leaf area index"), names.index("chlorophyll")]
    truth = np.array([module.UNKNOWNS[names[i]].truth for i in pair])
    covariances = results["covariances"][:, pair][:, :, pair]

    def chi2(values):
        errors = results["estimates"][:, pair] - values
        return sum(error @ np.linalg.solve(c, error) for error, c in zip(errors, covariances))

    low, high = stats.chi2(2 * DRAWS).ppf([0.001, 0.999])
    assert low < chi2(truth) < high
    assert chi2(truth + np.array([0.0, 10.0])) > high


@pytest.mark.slow
def test_published_gaussians_are_near_the_measured_responses():
    pytest.importorskip("pyrsr")
    module = load()
    for name, (grid, weights) in module.response_functions()[0].items():
        assert weights.sum() == pytest.approx(1.0)
        assert weights @ grid == pytest.approx(module.BANDS[name][0], abs=3.0)
