"""The paper's figures, each at small size: the scripts assert what the paper concludes."""

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "paper"
SCRIPTS = sorted(p.stem for p in FOLDER.glob("*.py") if not p.stem.startswith("_"))


@pytest.fixture
def script(monkeypatch):
    """Imports a script as `python examples/paper/name.py` would."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "_common", raising=False)

    def load(name):
        spec = importlib.util.spec_from_file_location(f"paper_{name}", FOLDER / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    yield load
    sys.modules.pop("_common", None)


LONG = ("introduction", "figure_07", "figure_08", "figure_09", "figure_12", "figures_13_14")


def test_every_figure_of_the_paper_that_shows_numbers_has_a_script():
    figures = {int(part) for name in SCRIPTS for part in name.split("_")[1:] if name.startswith("figure")}
    assert figures == {1, 2, 5, 6, 7, 8, 9, 10, 12, 13, 14}
    assert "introduction" in SCRIPTS


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in SCRIPTS]
)
def test_a_script_runs_and_asserts_what_the_paper_concludes(script, name, tmp_path, capsys):
    found = script(name).main(["--small", "--out", str(tmp_path)])
    assert found
    assert all(value == value for value in found.values())
    pictures = list(tmp_path.iterdir())
    assert [p.suffix for p in pictures] == [".png"]
    assert pictures[0].read_bytes().startswith(b"\x89PNG")
    # The numbers behind the picture, and where it is.
    assert len(capsys.readouterr().out.splitlines()) >= 2
