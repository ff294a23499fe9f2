"""The arrows between rooms and modules, the size of files, names, and what importing leaves behind."""

import ast
import importlib
import pkgutil
import subprocess
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import inversion
import jaxlidar

ROOT = Path(__file__).resolve().parents[1]
# Rooms of jaxlidar, from the ground up: a module imports from its own room and from those before it.
ROOMS = [
    "optics",
    "instrument",
    "scenes",
    "plants",
    "planning",
    "trace",
    "truth",
    "waveform",
    "simulate",
    "energy",
    "analog",
    "io",
    "survey",
    "plot",
    "cli",
]
# What every room may use.
HELPERS = {path.stem for path in (ROOT / "jaxlidar").glob("_*.py")} - {"__init__"}
# Within rooms, files in the order in which they use one another; those not named use none of the others.
ORDER = {
    "optics": ["coefficients", "leaf_surface", "plate_model", "spectra", "prospect"],
    "instrument": ["pulse_integrals", "pulse", "photon_counter", "receiver", "lidar", "scan", "survey"],
    "scenes": [
        "raster",
        "shapes",
        "height_field",
        "surfaces",
        "terrain",
        "voxels",
        "atmosphere",
        "canopy",
        "scene",
    ],
    "plants": ["lsystem", "tree", "turtle", "habits", "grid", "voxelise", "meshes", "forest", "demo"],
    "planning": [
        "trace_plan",
        "ladder",
        "local_origin",
        "memory",
        "rims",
        "parallel_light",
        "path_lengths",
        "record_times",
        "scatterers",
        "effects",
        "orders",
        "backscatter",
        "bounds",
        "effect_table",
        "plan",
        "alternatives",
        "plan_check",
        "sampling",
        "setup",
    ],
    "trace": [
        "histories",
        "deposit",
        "footprint",
        "surfaces",
        "random_numbers",
        "scores",
        "march",
        "photons",
        "viewing",
        "setting",
        "ordering",
        "labels",
        "nodes",
        "collisions",
        "flight",
        "fates",
        "reparametrise",
        "mirror",
        "stretches",
        "scored_light",
        "first_order",
        "higher_orders",
        "response",
        "few_wavelengths",
        "colouring",
        "batches",
        "node_response",
        "viewed_response",
    ],
    "survey": [
        "progress",
        "records",
        "coverage",
        "irradiance",
        "tiles",
        "views",
        "shots",
        "shared",
        "sharing",
        "ways",
        "prepare",
        "truths",
        "with_truth",
        "squares",
        "waveforms",
        "gathering",
        "run",
    ],
}
MODULES = sorted(path for folder in ("jaxlidar", "inversion") for path in (ROOT / folder).rglob("*.py"))


def imported(path):
    """Absolute names of the modules that a file imports, and of what it imports from them."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            base = ".".join(part for part in (base, node.module or "") if part)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def named(path):
    return str(path.relative_to(ROOT))


def test_jaxlidar_never_imports_inversion():
    for path in (ROOT / "jaxlidar").rglob("*.py"):
        assert not any(name.split(".")[0] == "inversion" for name in imported(path)), path


def test_the_top_level_has_few_modules():
    found = {path.stem for path in (ROOT / "jaxlidar").glob("[!_]*.py")}
    assert found == {"simulate", "waveform", "truth", "energy", "analog", "extend"}
    folders = {path.name for path in (ROOT / "jaxlidar").iterdir() if (path / "__init__.py").exists()}
    files = {"waveform", "truth", "simulate", "energy", "analog"}
    assert folders == set(ROOMS) - files


@pytest.mark.parametrize("path", sorted((ROOT / "jaxlidar").rglob("*.py")), ids=named)
def test_rooms_use_only_rooms_below(path):
    parts = path.relative_to(ROOT / "jaxlidar").with_suffix("").parts
    own = parts[0]
    if own in ("__init__", "extend"):
        return
    for name in imported(path):
        target = name.split(".")[1:]
        if name.split(".")[0] != "jaxlidar" or not target or target[0] in HELPERS:
            continue
        assert own not in HELPERS, f"the helper {own} imports {name}"
        assert ROOMS.index(target[0]) <= ROOMS.index(own), f"{own} imports {name}"
        order = ORDER.get(own, [])
        if target[0] == own and len(target) > 1 and parts[1] in order:
            assert target[1] in order, f"{parts[1]} imports {name}"
            assert order.index(target[1]) <= order.index(parts[1]), f"{parts[1]} imports {name}"


@pytest.mark.parametrize("folder", ["inversion", "examples"])
def test_nobody_else_uses_private_modules(folder):
    for path in (ROOT / folder).rglob("*.py"):
        for name in imported(path):
            parts = name.split(".")
            assert parts[0] != "jaxlidar" or not any(part.startswith("_") for part in parts), (path, name)


def test_no_name_hides_its_module():
    """`import jaxlidar.x.y` gives the module: no function or class is handed on under the name of a module.

    But for `simulate`, whose module hands all of its public names on to the top.
    """
    for package in (jaxlidar, inversion):
        names = [package.__name__]
        names += [m.name for m in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
        for name in names:
            room, _, own = name.rpartition(".")
            if not room or name == "jaxlidar.simulate":
                continue
            importlib.import_module(name)
            assert isinstance(getattr(sys.modules[room], own), types.ModuleType), name
    module = sys.modules["jaxlidar.simulate"]
    public = {n for n, v in vars(module).items() if getattr(v, "__module__", "") == module.__name__}
    assert {n for n in public if not n.startswith("_")} <= set(jaxlidar.__all__)


def test_the_core_neither_plots_nor_prints():
    outside = {"plot", "io", "cli"}
    for path in (ROOT / "jaxlidar").rglob("*.py"):
        if path.relative_to(ROOT / "jaxlidar").parts[0] in outside:
            continue
        assert not any(name.startswith("matplotlib") for name in imported(path)), path
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        assert not any(isinstance(c.func, ast.Name) and c.func.id == "print" for c in calls), path


def test_files_are_short():
    for path in MODULES:
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


def test_shapes_and_types_are_checked_in_tests():
    """Whoever imports the package before conftest's hook is in place switches the checks off."""
    with pytest.raises(jaxtyping.TypeCheckError):
        jaxlidar.spectral.apply_optics.height_of(jaxlidar.Lidar(), jnp.zeros((2, 2)))
