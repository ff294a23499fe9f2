"""Products of arrays ask for full precision: by default, GPUs round their factors to 11 bits.

The programs of simulations, leaves and their derivatives are searched for products that do not ask for it,
and the sources for JAX's own functions. (Of the operator `@`, sources do not tell whether it is NumPy's.)
"""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr

import jaxlidar as jl
from jaxlidar.sensors.receiver import first_return_window

FULL = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)


def rounded_products(function, *arguments):
    """Return the products in a program, and in the programs within, that a GPU would round."""
    found = []

    def search(jaxpr):
        for equation in jaxpr.eqns:
            is_product = equation.primitive.name in ("dot_general", "conv_general_dilated")
            if is_product and equation.params["precision"] != FULL:
                found.append(str(equation))
            for inner in jax.tree.leaves(
                list(equation.params.values()), is_leaf=lambda x: isinstance(x, ClosedJaxpr | Jaxpr)
            ):
                if isinstance(inner, ClosedJaxpr):
                    search(inner.jaxpr)
                elif isinstance(inner, Jaxpr):
                    search(inner)

    search(jax.make_jaxpr(function)(*arguments).jaxpr)
    return found


LEAF = jl.LeafOptics(reflectance=np.array([0.1, 0.4]), transmittance=np.array([0.1, 0.4]))
VOXELS = jl.VoxelMap.from_lad(
    np.ones((4, 4, 4)), voxel_size=1.0, leaf_angles=jl.LeafAngles.named("planophile")
)
CANOPY = jl.Canopy(VOXELS, leaf=LEAF, sides="periodic", hotspot=False)
PLATE = jl.Plate(height=3.0, reflectance=0.4, transmittance=0.3, coverage=0.5)
GROUND = jl.Ground(reflectance=0.4)
SCENES = {
    "canopy": jl.Scene(canopy=CANOPY, ground=GROUND),
    "plate": jl.Scene(plates=(PLATE,), ground=GROUND, atmosphere=jl.Atmosphere()),
}


@pytest.mark.parametrize(
    ("name", "derivatives", "histories"),
    [
        pytest.param("canopy", False, False, marks=pytest.mark.slow),
        ("canopy", True, True),
        ("plate", False, True),
        pytest.param("plate", False, False, marks=pytest.mark.slow),
        pytest.param("plate", True, True, marks=pytest.mark.slow),
        pytest.param("plate", True, False, marks=pytest.mark.slow),
    ],
)
def test_simulations(name, derivatives, histories):
    lidar = jl.Lidar(wavelength=(532.0, 1064.0), pulse=jl.GaussianPulse(fwhm=4.0))
    scene = SCENES[name]
    plan = jl.plan(lidar, scene, max_orders=2, n_photons=512, n_rays=64, histories=histories)

    def waveform(reflectance, key):
        changed = jl.Scene(scene.canopy, scene.plates, jl.Ground(reflectance=reflectance), scene.atmosphere)
        setup = jl.make_setup(lidar, changed, plan)
        return jl.total_reflectance(jl.trace_scene(setup, key), setup)

    function = jax.jacfwd(waveform) if derivatives else waveform
    assert not rounded_products(function, jnp.asarray(0.4), jax.random.key(0))


def test_leaves():
    leaf, wavelengths = jl.Prospect(), np.arange(400.0, 2501.0, 100.0)
    assert not rounded_products(lambda x: x(wavelengths), leaf)


def test_the_window_of_the_first_return():
    assert not rounded_products(lambda e: first_return_window(np.arange(40.0), e, 4.0), jnp.ones((1, 40)))


PRODUCTS = ("dot", "einsum", "inner", "matmul", "tensordot", "vdot")
SOURCES = [
    path
    for package in ("jaxlidar", "inversion")
    for path in (Path(__file__).resolve().parents[2] / package).rglob("*.py")
    if path.name != "products.py"
]


def default_products(source):
    """Return the products of `jax.numpy` that a source calls or names, which have the default precision."""
    return [
        f"line {node.lineno}: jnp.{node.attr}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute)
        and node.attr in PRODUCTS
        and isinstance(node.value, ast.Name)
        and node.value.id == "jnp"
    ]


def test_sources_have_no_products_of_jax_numpy():
    assert len(SOURCES) > 100
    assert not {str(path): found for path in SOURCES if (found := default_products(path.read_text()))}
    assert default_products("y = jnp.einsum('ij,j->i', a, x)")


def test_a_product_of_default_precision_is_found():
    assert rounded_products(lambda x: jax.lax.map(lambda row: row @ x, x), jnp.eye(3))
