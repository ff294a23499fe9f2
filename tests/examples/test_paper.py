"""The figures of the paper, each at small size: the scripts assert the conclusions of the paper."""

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "paper"
SCRIPTS = sorted(p.stem for p in FOLDER.glob("*.py") if not p.stem.startswith("_"))


@pytest.fixture
def script(monkeypatch):
    """Return a function that imports a script as `python examples/paper/name.py` would."""
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in ("_common", "_analog"):
        monkeypatch.delitem(sys.modules, name, raising=False)

    def load(name):
        spec = importlib.util.spec_from_file_location(f"paper_{name}", FOLDER / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    yield load
    for name in ("_common", "_analog"):
        sys.modules.pop(name, None)


LONG = ("introduction", *(f"figure_{n:02}" for n in (1, 5, 6, 7, 8, 9, 12)), "figures_13_14")


def test_every_figure_of_the_paper_that_shows_numbers_has_a_script():
    figures = {int(number) for name in SCRIPTS for number in name.split("_")[1:] if name.startswith("figure")}
    assert figures == {1, 2, 5, 6, 7, 8, 9, 10, 12, 13, 14}
    assert "introduction" in SCRIPTS


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in SCRIPTS]
)
def test_a_script_confirms_the_conclusions_of_the_paper(script, name, tmp_path, capsys):
    results = script(name).main(["--small", "--out", str(tmp_path)])
    assert results
    assert all(value == value for value in results.values())
    pictures = list(tmp_path.iterdir())
    assert [p.suffix for p in pictures] == [".png"]
    assert pictures[0].read_bytes().startswith(b"\x89PNG")
    # Printed are the numbers of the figure and its path.
    assert len(capsys.readouterr().out.splitlines()) >= 2
