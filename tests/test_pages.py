"""Pages of documentation: their examples run, their links have targets, and the API reference builds."""

import json
import pkgutil
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest

import inversion
import jaxlidar
from tests.long_examples import LONG_EXAMPLES

matplotlib.use("agg")
ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("jaxlidar", "inversion", "examples")
PAGES = [*ROOT.glob("*.md"), *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.md"))]


def page_name(path):
    return str(path.relative_to(ROOT))


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL)


# Those that take longer than the front page's first ones; its last one simulates a hectare.
LONG = {
    "README.md": {3},
    "jaxlidar/README.md": {0, 1, 2, 3, 5, 8, 9},
    "inversion/README.md": {2, 3, 4, 5},
}
EXAMPLES = [
    pytest.param(path, number, marks=pytest.mark.slow if number in LONG.get(page_name(path), ()) else ())
    for path in PAGES
    for number in range(len(blocks(path, "python")))
]


@pytest.mark.parametrize(
    ("path", "number"), EXAMPLES, ids=lambda x: page_name(x) if isinstance(x, Path) else str(x)
)
def test_examples_run_as_printed(path, number, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "example"}
    exec(compile(blocks(path, "python")[number], page_name(path), "exec"), names)
    if "wave" in names:
        assert np.all(np.isfinite(np.asarray(names["wave"].reflectance)))


def test_long_examples_are_examples():
    for name in LONG_EXAMPLES:
        assert ">>>" in pkgutil.resolve_name(name).__doc__, name


NUMBER = r"-?\d+(?:\.\d+)?(?:e[-+]\d+)?"


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=pytest.mark.slow if page_name(p) == "jaxlidar/README.md" else ()) for p in PAGES],
    ids=page_name,
)
def test_printed_output_is_that_of_the_example_above_it(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pairs = r"^```python\n((?:(?!^```).)*)^```\n\n```text\n(.*?)^```"
    for code, printed in re.findall(pairs, path.read_text(), re.MULTILINE | re.DOTALL):
        exec(compile(code, page_name(path), "exec"), {})
        output = "\n".join(line.rstrip() for line in capsys.readouterr().out.splitlines())
        assert re.sub(NUMBER, "#", output) == re.sub(NUMBER, "#", printed.rstrip("\n"))
        # Rounding differs with the options of the compiler, and a misfit of noise-free records is rounding.
        numbers = [[float(number) for number in re.findall(NUMBER, text)] for text in (output, printed)]
        np.testing.assert_allclose(*numbers, rtol=0.03)


def anchor(heading):
    """Return the anchor of a heading, as renderers of Markdown make it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("path", PAGES, ids=page_name)
def test_links_have_targets(path):
    for target in re.findall(r"\]\(([^)]+)\)", path.read_text()):
        assert not target.startswith("http"), "pages speak of the project alone"
        name, _, fragment = target.partition("#")
        linked_page = path.parent / name if name else path
        assert linked_page.exists(), target
        if fragment:
            assert fragment in [
                anchor(h) for h in re.findall(r"^#+ (.*)$", linked_page.read_text(), re.MULTILINE)
            ], target


def test_the_front_page_is_short_and_its_commands_are_two():
    page = ROOT / "README.md"
    assert len(page.read_text().splitlines()) <= 150
    commands = [line for block in blocks(page, "sh") for line in block.splitlines()]
    assert len(commands) == 2
    assert {shlex.split(line)[0] for line in commands} == {"python3"}
    lengths = [sum(1 for line in example.splitlines() if line) for example in blocks(page, "python")]
    first_waveform, gradient, fit, survey = lengths
    assert max(first_waveform, gradient, fit) <= 14
    assert survey <= 20
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text()):
        assert (ROOT / picture).stat().st_size < 150_000


def test_the_front_page_has_the_measured_time_of_its_survey():
    folder = ROOT / "examples" / "figures"
    record = json.loads((folder / "hectare.json").read_text())
    duration = runpy.run_path(str(folder / "hectare.py"))["duration"]
    assert (ROOT / "README.md").read_text().count(duration(record)) == 1


def test_the_example_of_a_new_law_is_the_tested_one():
    (block,) = [b for b in blocks(ROOT / "jaxlidar" / "README.md", "python") if "class Minnaert" in b]
    law = block[block.index("@final") :]
    assert law in (ROOT / "examples" / "minnaert.py").read_text()


@pytest.mark.parametrize("package", [jaxlidar, inversion], ids=lambda package: package.__name__)
def test_every_public_name_has_its_place_under_one_topic(package):
    topics = re.split(r"^## .*$", package.__doc__, flags=re.MULTILINE)[1:]
    assert len(topics) >= 4
    assert [name for topic in topics for name in re.findall(r"`(\w+)`", topic)] == package.__all__


@pytest.mark.slow
def test_the_reference_builds_without_a_warning_and_its_links_have_targets(tmp_path):
    command = [sys.executable, "-W", "error::UserWarning", "-m", "jaxlidar.cli", "reference", "-o", tmp_path]
    process = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert process.returncode == 0, process.stderr
    assert "Warn" not in process.stderr, process.stderr
    main_page = (tmp_path / "jaxlidar.html").read_text()
    assert "HenyeyGreenstein" in main_page
    assert "Surveys of many shots" in main_page
    web_pages = list(tmp_path.rglob("*.html"))
    for name in ("inversion", "jaxlidar/io", "jaxlidar/plot", "pages/jaxlidar", "pages/jaxlidar_formats"):
        assert tmp_path / f"{name}.html" in web_pages
    for page in web_pages:
        links = re.findall(r'(?:href|src)="([^"#:]+\.(?:html|png))(?:#([^"]+))?"', page.read_text())
        assert links
        for target, fragment in links:
            linked = (page.parent / target).resolve()
            assert linked.exists(), (page, target)
            assert not fragment or f'id="{fragment}"' in linked.read_text(), (page, target, fragment)


def test_the_benchmarks_page_is_made_from_their_records():
    code = "import run; print(run.page(), end='')"
    folder = ROOT / "examples" / "benchmarks"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=True
    )
    assert process.stdout == (folder / "README.md").read_text()
