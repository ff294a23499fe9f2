"""The notebooks: their code runs, and they are stored with results and without paths of a machine."""

import importlib.util
import json
import re
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
FOLDER = EXAMPLES / "notebooks"
NAMES = sorted(p.stem for p in FOLDER.glob("*.ipynb"))
# Packages of the extra "bayes", by notebook.
NEEDS = {"neural_posterior": "flowjax", "own_loss": "blackjax"}


def all_cells(name):
    return json.loads((FOLDER / f"{name}.ipynb").read_text())["cells"]


def cells(name):
    return [c for c in all_cells(name) if c["cell_type"] == "code"]


@pytest.mark.parametrize("name", NAMES)
def test_results_are_stored(name):
    code_cells = cells(name)
    outputs = [o for c in code_cells for o in c["outputs"]]
    assert [c["execution_count"] for c in code_cells] == list(range(1, len(code_cells) + 1))
    assert any("image/png" in o.get("data", {}) for o in outputs)
    assert not any(o["output_type"] == "error" or o.get("name") == "stderr" for o in outputs)
    assert not re.search(r"/(home|root|tmp|work|Users)/", (FOLDER / f"{name}.ipynb").read_text())


@pytest.mark.parametrize("name", NAMES)
def test_notebooks_are_short_and_say_what_to_change(name):
    notebook_cells = all_cells(name)
    assert len(notebook_cells) <= 25
    assert (FOLDER / f"{name}.ipynb").stat().st_size < 400_000
    assert "".join(notebook_cells[0]["source"]).startswith("# ")
    assert "## What to change" in "".join(notebook_cells[-1]["source"])


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_code_runs(name, monkeypatch):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"{NEEDS[name]} is not installed: pip install '.[bayes]'")
    for variable in ("GEDI_L1B", "GEDI_L2A", "ATL03", "ATL08"):
        monkeypatch.delenv(variable, raising=False)
    before = matplotlib.get_backend()
    matplotlib.use("agg")
    scope = {"__name__": "__main__"}
    try:
        with matplotlib.rc_context():
            for cell in cells(name):
                exec("".join(cell["source"]), scope)
        assert plt.get_fignums()
    finally:
        plt.close("all")
        matplotlib.use(before)


def test_there_are_notebooks():
    assert NAMES == [
        "first_waveform",
        "gedi_file",
        "ground_under_trees",
        "hectare",
        "leaf_traits",
        "neural_posterior",
        "own_loss",
        "peak_detectors",
        "photon_track",
        "recorded_shots",
        "strip",
    ]


def test_the_gallery_has_the_pictures_of_the_notebooks():
    spec = importlib.util.spec_from_file_location("gallery", EXAMPLES / "figures" / "gallery.py")
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    page = (EXAMPLES / "README.md").read_text()
    for name in NAMES:
        assert (gallery.GALLERY / f"{name}.png").read_bytes() == gallery.picture(name), name
        assert f"(figures/gallery/{name}.png)" in page
        assert f"(notebooks/{name}.ipynb)" in page
    for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page):
        assert (EXAMPLES / path).stat().st_size < 62_000, path
