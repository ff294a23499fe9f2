"""Set-up of all tests: rank promotion is refused; shapes and types of the packages are checked."""

import importlib.util
import itertools
import pkgutil
from pathlib import Path

import equinox as eqx
import jax
import pytest
from jaxtyping import install_import_hook

from tests import quick_compilation, type_checks
from tests.long_examples import LONG_EXAMPLES

# With XLA_FLAGS set, if only to an empty text, tests run the code that users run.
quick_compilation.set_flags()

jax.config.update("jax_numpy_rank_promotion", "raise")

# Called a million times by the tests of trees alone, and they raise errors of their own.
UNHOOKED = {"jaxlidar._fields"}


def hooked_modules():
    """Return the names of the modules and subpackages whose shapes and types are checked."""
    names = []
    for package in ("jaxlidar", "inversion"):
        folders = importlib.util.find_spec(package).submodule_search_locations
        names += [module.name for module in pkgutil.iter_modules(folders, f"{package}.")]
    return [name for name in names if name not in UNHOOKED]


def pytest_configure(config):
    """Import the packages with their checks, except in a process that only hands out tests to workers."""
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        return
    with install_import_hook(hooked_modules(), f"{type_checks.__name__}.check_types"):
        import jaxlidar  # noqa: F401

        # Before `inversion` is imported, as in processes that tests start: options are read there by then.
        quick_compilation.optimise_programs()
        import inversion  # noqa: F401


SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"

# Every compiled program keeps some ten memory mappings; Linux grants a process 65530, and XLA dies beyond.
MAPPINGS = 40_000


# Tests between two looks at the mappings: to list tens of thousands of them takes some 30 ms.
TESTS_BETWEEN_COUNTS = 10
_tests_run = itertools.count(1)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark long examples in docstrings as slow, where decorators cannot."""
    for item in items:
        if item.name in LONG_EXAMPLES and isinstance(item, pytest.DoctestItem):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True)
def limit_compiled_programs():
    """Drop compiled programs before their memory mappings are too many for one process."""
    yield
    maps = Path("/proc/self/maps")
    if next(_tests_run) % TESTS_BETWEEN_COUNTS or not maps.exists():
        return
    if maps.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()
        eqx.clear_caches()


@pytest.fixture
def shared():
    """Folder of records and reference results beside the checkout; tests that need it are skipped without."""
    if not SHARED.is_dir():
        pytest.skip("the folder of reference data is not beside this checkout")
    return SHARED


@pytest.fixture(params=["float32", "float64"])
def precision(request):
    """Run the test in single and in double precision; the name of the floating-point type."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param
