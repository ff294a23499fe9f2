"""Layers, import circles, names and side effects of importing.

Imports are read from the source in each form that Python has: statements wherever they stand (also in
functions and under `TYPE_CHECKING`), and `import_module("...")` or `__import__("...")` with a string. Two
rules hold for them: a package uses itself and the packages below it (`LAYERS`), and no files import one
another in a circle. Within a package only the second rule applies, so that no list of files in their order is
needed.
"""

import ast
import importlib
import pkgutil
import subprocess
import sys
import types
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import inversion
import jaxlidar

ROOT = Path(__file__).resolve().parents[1]
# Packages and top-level modules of jaxlidar, the lowest first: each may import itself and those that stand
# before it in this table. A new package needs one line here.
LAYERS = (
    "progress",
    "optics",
    "sensors",
    "scenes",
    "plants",
    "formats",
    "planning",
    "trace",
    "spectral",
    "sampling",
    "simulation",
    "results",
    "io",
    "survey",
    "plot",
    "cli",
)
# Modules that hand on what others define, or that every layer may use.
FACADES = {"__init__", "__main__", "extend"}
PRIVATE_HELPERS = {
    path.stem for path in (ROOT / "jaxlidar").glob("_*") if path.suffix in ("", ".py")
} - FACADES
SOURCES = sorted((ROOT / "jaxlidar").rglob("*.py"))


# -- reading imports ---------------------------------------------------------------------------------------


def module_name(path: Path, root: Path) -> str:
    """Dotted name of the module in a file below `root`; that of the package for `__init__.py`."""
    names = path.relative_to(root).with_suffix("").parts
    return ".".join(names[:-1] if names[-1] == "__init__" else names)


def import_functions(tree: ast.AST) -> set[str]:
    """Names by which a file calls `import_module` or `__import__`, aliases included."""
    aliases = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "importlib"
        for alias in node.names
        if alias.name in ("import_module", "__import__")
    }
    return aliases | {"import_module", "__import__"}


def imported_strings(tree: ast.AST) -> Iterator[str | None]:
    """Arguments of calls of `import_module` and `__import__`; None for a name that is computed."""
    functions = import_functions(tree)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", None)
        if called in functions:
            arguments = [*node.args, *(k.value for k in node.keywords if k.arg == "name")]
            name = arguments[0] if arguments else None
            yield name.value if isinstance(name, ast.Constant) and isinstance(name.value, str) else None


def imported_names(path: Path, root: Path = ROOT) -> Iterator[str]:
    """Absolute dotted names that a file imports; `from a import b` gives `a.b`, be b a module or not."""
    package = path.relative_to(root).parts[:-1]
    tree = ast.parse(path.read_text())

    def absolute(name: str, level: int) -> str:
        # One dot is the package of the file, each further dot the package around it.
        base = package[: len(package) - level + 1] if level else ()
        return ".".join([*base, *filter(None, [name])])

    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = absolute(node.module or "", node.level)
            yield from (f"{source}.{alias.name}" for alias in node.names)
    for name in filter(None, imported_strings(tree)):
        yield absolute(name.lstrip("."), len(name) - len(name.lstrip(".")))


def import_graph(root: Path, *packages: str) -> dict[str, set[str]]:
    """For each module of some packages below `root`, the modules of these packages that it imports.

    An import of a name that a package's `__init__.py` defines counts as an import of that package, also from
    within the package: `import jaxlidar` in a file of jaxlidar closes a circle.
    """
    paths = {module_name(path, root): path for package in packages for path in (root / package).rglob("*.py")}

    def defining_module(name: str) -> str:
        while name and name not in paths:
            name = name.rpartition(".")[0]
        return name

    return {
        module: {defining_module(name) for name in imported_names(path, root)} - {"", module}
        for module, path in paths.items()
    }


def import_circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Groups of modules of which each imports all others, directly or by way of others.

    They are the strongly connected components of the graph that have more than one module.
    """
    modules = sorted(graph)
    number = {module: n for n, module in enumerate(modules)}
    edges = [(number[a], number[b]) for a in modules for b in graph[a]]
    row, column = zip(*edges) if edges else ((), ())
    matrix = coo_array((np.ones(len(edges)), (row, column)), shape=(len(modules), len(modules)))
    _, component = connected_components(matrix, directed=True, connection="strong")
    groups = [[m for m, c in zip(modules, component) if c == label] for label in np.unique(component)]
    return [group for group in groups if len(group) > 1]


# -- layers ------------------------------------------------------------------------------------------------


def layer_of(module: str) -> str:
    """First name below jaxlidar; `__init__` for the package itself."""
    return [*module.split("."), "__init__"][1]


def upward_imports(module: str, imported: set[str]) -> list[str]:
    """Imported modules of jaxlidar in a higher layer than a module, or that hand on names of all layers."""
    layer = layer_of(module)
    if layer in FACADES:
        return []
    allowed = (
        PRIVATE_HELPERS
        if layer in PRIVATE_HELPERS
        else {*LAYERS[: LAYERS.index(layer) + 1], *PRIVATE_HELPERS}
    )
    return sorted(m for m in imported if m.split(".")[0] == "jaxlidar" and layer_of(m) not in allowed)


GRAPH = import_graph(ROOT, "jaxlidar")


@pytest.mark.parametrize("module", sorted(GRAPH))
def test_a_module_imports_only_lower_layers(module):
    assert upward_imports(module, GRAPH[module]) == []


def test_upward_imports_are_reported():
    assert upward_imports("jaxlidar.optics.laws", {"jaxlidar.plot", "jaxlidar._fields.checks"}) == [
        "jaxlidar.plot"
    ]
    assert upward_imports("jaxlidar.optics.laws", {"jaxlidar"}) == ["jaxlidar"]
    assert upward_imports("jaxlidar._fields.checks", {"jaxlidar.optics.laws"}) == ["jaxlidar.optics.laws"]
    assert upward_imports("jaxlidar.plot.style", {"jaxlidar.optics.laws", "jaxlidar.plot"}) == []


def test_every_package_has_a_layer():
    modules = {path.stem for path in (ROOT / "jaxlidar").glob("[!_]*.py")} - FACADES
    packages = {path.parent.name for path in (ROOT / "jaxlidar").glob("[!_]*/__init__.py")}
    assert modules | packages == set(LAYERS)
    assert len(set(LAYERS)) == len(LAYERS)


def test_jaxlidar_never_imports_inversion():
    for path in SOURCES:
        assert not any(name.split(".")[0] == "inversion" for name in imported_names(path)), path


def test_importing_all_of_jaxlidar_leaves_inversion_out():
    code = (
        "import importlib, pkgutil, sys, jaxlidar\n"
        "for module in pkgutil.walk_packages(jaxlidar.__path__, 'jaxlidar.'):\n"
        "    if not module.name.endswith('__main__'):\n"
        "        importlib.import_module(module.name)\n"
        "assert not any(name.split('.')[0] == 'inversion' for name in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


# -- circles -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["jaxlidar", "inversion"])
def test_no_files_import_one_another(package):
    assert import_circles(import_graph(ROOT, package)) == []


def test_imports_of_computed_names_cannot_be_read_and_are_not_used():
    for path in [*SOURCES, *(ROOT / "inversion").rglob("*.py")]:
        assert None not in list(imported_strings(ast.parse(path.read_text()))), path


# What `pkg/low.py` has, of which each form imports `pkg/high.py`, which imports `pkg/low.py`.
FORMS = {
    "statement": "import pkg.high",
    "from": "from pkg.high import f",
    "from the package": "from pkg import high",
    "relative": "from .high import f",
    "relative, from the package": "from . import high",
    "in a function": "def g():\n    import pkg.high",
    "in a method": "class A:\n    def g(self):\n        from pkg.high import f",
    "in a branch": "try:\n    import pkg.high\nexcept ImportError:\n    pass",
    "for types": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from pkg.high import f",
    "import_module": "from importlib import import_module\nimport_module('pkg.high')",
    "importlib.import_module": "import importlib\ndef g():\n    return importlib.import_module('pkg.high').f",
    "import_module, by keyword": "import importlib\nimportlib.import_module(name='pkg.high')",
    "import_module, relative": "import importlib\nimportlib.import_module('.high', __package__)",
    "import_module, aliased": "from importlib import import_module as load\nload('pkg.high')",
    "__import__": "__import__('pkg.high')",
}


def write_package(folder: Path, **files: str) -> dict[str, set[str]]:
    """Write a package `pkg` and return its graph."""
    (folder / "pkg").mkdir()
    for name, text in {"__init__": "", **files}.items():
        (folder / "pkg" / f"{name}.py").write_text(text)
    return import_graph(folder, "pkg")


@pytest.mark.parametrize("form", FORMS)
def test_a_circle_of_two_files_is_reported(form, tmp_path):
    graph = write_package(tmp_path, low=FORMS[form], high="from pkg import low")
    assert import_circles(graph) == [["pkg.high", "pkg.low"]]


def test_a_circle_of_three_files_is_reported(tmp_path):
    graph = write_package(
        tmp_path, a="import pkg.b", b="from .c import f", c="__import__('pkg.a')", d="import pkg.a"
    )
    assert import_circles(graph) == [["pkg.a", "pkg.b", "pkg.c"]]


def test_a_circle_by_way_of_the_package_is_reported(tmp_path):
    graph = write_package(
        tmp_path, __init__="from pkg.low import f", low="def g():\n    import pkg\n    return pkg.f"
    )
    assert import_circles(graph) == [["pkg", "pkg.low"]]


def test_files_without_a_circle_are_not_reported(tmp_path):
    graph = write_package(
        tmp_path,
        __init__="from pkg import a",
        a="from pkg.b import f\nimport numpy",
        b="from . import c",
        c="",
    )
    assert graph["pkg.a"] == {"pkg.b"}
    assert import_circles(graph) == []


def test_an_import_of_a_computed_name_is_reported():
    assert list(imported_strings(ast.parse("import importlib\nimportlib.import_module('pkg.' + name)"))) == [
        None
    ]


# -- names, output and configuration -----------------------------------------------------------------------


@pytest.mark.parametrize("folder", ["inversion", "examples"])
def test_private_modules_of_jaxlidar_are_used_by_jaxlidar_alone(folder):
    for path in (ROOT / folder).rglob("*.py"):
        for name in imported_names(path):
            package, *names = name.split(".")
            assert package != "jaxlidar" or not any(n.startswith("_") for n in names), (path, name)


def test_no_name_hides_its_module():
    """`import jaxlidar.x.y` gives the module: no function or class is exported under the name of a module."""
    for package in (jaxlidar, inversion):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            parent, _, attribute = module.name.rpartition(".")
            importlib.import_module(module.name)
            assert isinstance(getattr(sys.modules[parent], attribute), types.ModuleType), module.name


def test_the_core_neither_plots_nor_prints():
    for path in SOURCES:
        if path.relative_to(ROOT / "jaxlidar").parts[0] in ("plot", "formats", "results", "cli"):
            continue
        assert not any(name.startswith("matplotlib") for name in imported_names(path)), path
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        assert not any(isinstance(c.func, ast.Name) and c.func.id == "print" for c in calls), path


def test_importing_leaves_the_configuration_alone():
    """No array is made either: it would start a backend, whose options could not be chosen any more."""
    code = (
        "import jax; before = dict(jax.config.values); import jaxlidar, inversion; "
        "assert all(jax.config.values[k] == v for k, v in before.items()); "
        "from jax._src import xla_bridge; assert not xla_bridge.backends_are_initialized()"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_importing_reads_no_part_of_scipy():
    """They are read where they are used first, as `scipy.linalg`: a first waveform needs none of them."""
    code = (
        "import sys, jaxlidar, inversion; "
        "assert not {'scipy.linalg', 'scipy.ndimage', 'scipy.sparse', 'scipy.spatial'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_rows_of_a_vmapped_product_are_right():
    """A canary: some releases of jax computed wrong rows of this on the CPU."""
    random = np.random.default_rng(0)
    matrix, rows = random.normal(size=(3, 3)), random.normal(size=(257, 3))
    R = jnp.asarray(matrix, jnp.float32)
    squares = jax.jit(jax.vmap(lambda r: jnp.sum((R @ r) ** 2)))(jnp.asarray(rows, jnp.float32))
    assert np.allclose(squares, np.sum((rows @ matrix.T) ** 2, axis=1), rtol=1e-4)


def test_shapes_and_types_are_checked_in_tests():
    """Importing the package before conftest's import hook is in place would switch the checks off."""
    with pytest.raises(jaxtyping.TypeCheckError):
        jaxlidar.spectral.apply_optics.height_of(jaxlidar.Lidar(), jnp.zeros((2, 2)))
