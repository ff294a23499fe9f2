"""The house itself: what imports what, how long files are, and that importing changes nothing.

optics and geometry -> scene -> plan -> trace -> waveform -> simulate; `inversion` stands on `jaxlidar`,
never the other way round. Imports are read from the source, whether at the top of a file or within a function.
"""

import ast
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("jaxlidar", "inversion")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

# The stages in the direction in which data flow. A module may import from its own stage and earlier ones.
STAGES = (
    ("lidar", "materials", "voxels", "atmosphere", "pulse", "receiver", "prospect", "leaf", "spectra"),
    ("scene",),
    ("letters", "extent", "layout", "plan"),
    ("trace",),
    ("waveform",),
    ("simulate",),
)


def imported(path):
    """Full names of all modules of the two packages that a file imports."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            stem = ".".join([*base, *([node.module] if node.module else [])])
            # `from . import x` may import the module x; `from .a import b` imports a.
            names |= {f"{stem}.{alias.name}" for alias in node.names} if not node.module else {stem}
    return {name for name in names if name.split(".")[0] in PACKAGES}


def test_imports_are_found():
    """The reader of imports sees what it should: else all else below would pass for nothing."""
    assert "jaxlidar.plan" in imported(ROOT / "jaxlidar" / "simulate.py")
    assert "jaxlidar.trace.response" in imported(ROOT / "jaxlidar" / "simulate.py")
    assert "jaxlidar.lidar" in imported(ROOT / "jaxlidar" / "trace" / "response.py")


def test_the_simulator_knows_nothing_of_the_inversion():
    """But for the command line, which runs both."""
    culprits = [
        path.name
        for path in FILES
        if "jaxlidar" in path.relative_to(ROOT).parts[0]
        and path.stem != "cli"
        and any(name.split(".")[0] == "inversion" for name in imported(path))
    ]
    assert culprits == []


def stage_of(module):
    """Number of the stage that a module, or one of its packages, belongs to; None for the tools of all."""
    parts = module.split(".")
    for number, stage in enumerate(STAGES):
        if len(parts) > 1 and parts[0] == "jaxlidar" and parts[1] in stage:
            return number
    return None


@pytest.mark.parametrize("number", range(len(STAGES)))
def test_no_stage_imports_a_later_one(number):
    backwards = []
    for path in FILES:
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if stage_of(module) == number:
            backwards += [(module, name) for name in imported(path) if (stage_of(name) or 0) > number]
    assert backwards == []


def test_every_stage_has_its_modules():
    present = {stage_of(".".join(path.relative_to(ROOT).with_suffix("").parts)) for path in FILES}
    assert set(range(len(STAGES))) <= present
    names = {path.stem for path in (ROOT / "jaxlidar").iterdir()}
    assert {name for stage in STAGES for name in stage} <= names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_stay_short(path):
    assert len(path.read_text().splitlines()) <= 400


def test_importing_changes_no_configuration():
    """In an interpreter of its own, as the tests themselves set a configuration."""
    code = (
        "import jax; before = dict(jax.config.values); import jaxlidar, inversion; "
        "after = dict(jax.config.values); changed = {k for k in after if after[k] != before.get(k)}; "
        "assert not changed, changed"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=120)


@pytest.mark.parametrize("count", [1, 7, 64, 1000])
def test_rows_of_a_batched_product_are_right(count):
    """A canary: one release of JAX computes wrong rows of this on the CPU, silently."""
    rng = np.random.default_rng(9)
    matrix, rays = rng.normal(size=(3, 3)), rng.normal(size=(count, 3))
    turn = jnp.asarray(matrix)
    found = jax.jit(jax.vmap(lambda r: jnp.sum((turn @ r) ** 2)))(jnp.asarray(rays))
    np.testing.assert_allclose(found, np.sum((rays @ matrix.T) ** 2, axis=1), rtol=1e-4)
