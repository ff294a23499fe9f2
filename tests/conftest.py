"""Every test runs with rank promotion refused; shapes and types of the packages are checked at run time."""

from pathlib import Path

import equinox as eqx
import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_numpy_rank_promotion", "raise")

# An int serves where a float is asked for, as PEP 484 says.
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"

with install_import_hook(["jaxlidar", "inversion"], CHECKER):
    import inversion  # noqa: F401
    import jaxlidar  # noqa: F401

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"

# Every compiled program keeps some ten memory mappings; Linux grants a process 65530, and XLA dies beyond.
MAPPINGS = 40_000


@pytest.fixture(autouse=True)
def room_to_compile():
    """Forget compiled programs before there are too many for one process."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()
        eqx.clear_caches()


@pytest.fixture
def shared():
    """The folder of records and reference results that lies beside the checkout, where there is one."""
    if not SHARED.is_dir():
        pytest.skip("the folder of reference data is not beside this checkout")
    return SHARED


@pytest.fixture(params=["float32", "float64"])
def precision(request):
    """Runs the test in single and in double precision; gives the name of the floating-point type."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param
