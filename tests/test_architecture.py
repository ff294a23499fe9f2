"""The arrows between modules, the size of files, and the state that importing leaves behind."""

import ast
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
# From data to waveform: a module may import from its own stage and from those before it.
STAGES = [
    {"constants", "_checks", "_threads", "_vector", "_expint", "_coefficients", "_twofold"},
    {
        "layout",
        "pulse",
        "receiver",
        "plates",
        "prospect",
        "leaf",
        "spectra",
        "materials",
        "atmosphere",
        "lidar",
        "tree",
        "lsystem",
        "turtle",
        "habits",
        "forest",
    },
    {"voxels"},
    {"voxelise", "io"},
    {"scene"},
    {"letters", "extent"},
    {"effects", "bounds"},
    {"effect_table"},
    {"plan"},
    {"trace"},
    {"waveform"},
    {"simulate", "analog"},
    {"plot", "plot_trees", "demo", "cli"},
]


def imported(path):
    """Absolute names of the modules that a file imports."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            yield ".".join(part for part in (base, node.module or "") if part)


def test_jaxlidar_never_imports_inversion():
    for path in (ROOT / "jaxlidar").rglob("*.py"):
        assert not any(name.split(".")[0] == "inversion" for name in imported(path)), path


def test_data_flows_one_way():
    stage = {name: i for i, names in enumerate(STAGES) for name in names}
    for path in (ROOT / "jaxlidar").rglob("*.py"):
        own = path.relative_to(ROOT / "jaxlidar").parts[0].removesuffix(".py")
        if own == "__init__":
            continue
        for name in imported(path):
            parts = name.split(".")
            if parts[0] == "jaxlidar" and len(parts) > 1:
                assert stage[parts[1]] <= stage[own], f"{own} imports {parts[1]}"


def test_the_core_neither_plots_nor_prints():
    outside = {"plot", "plot_trees", "io", "cli", "demo"}
    for path in (ROOT / "jaxlidar").rglob("*.py"):
        if path.stem in outside:
            continue
        assert not any(name.startswith("matplotlib") for name in imported(path)), path
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        assert not any(isinstance(c.func, ast.Name) and c.func.id == "print" for c in calls), path


def test_files_are_short():
    for folder in ("jaxlidar", "inversion"):
        for path in (ROOT / folder).rglob("*.py"):
            assert len(path.read_text().splitlines()) <= 420, path


def test_importing_leaves_the_configuration_alone():
    code = (
        "import jax; before = dict(jax.config.values); import jaxlidar, inversion; "
        "assert all(jax.config.values[k] == v for k, v in before.items())"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_rows_of_a_vmapped_product_are_right():
    """A canary: some releases of jax computed wrong rows of this on the CPU."""
    random = np.random.default_rng(0)
    matrix, rows = random.normal(size=(3, 3)), random.normal(size=(257, 3))
    R = jnp.asarray(matrix, jnp.float32)
    got = jax.jit(jax.vmap(lambda r: jnp.sum((R @ r) ** 2)))(jnp.asarray(rows, jnp.float32))
    assert np.allclose(got, np.sum((rows @ matrix.T) ** 2, axis=1), rtol=1e-4)
