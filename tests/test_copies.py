"""Every public object can be copied and pickled, and shows itself in notebooks."""

import base64
import copy
import dataclasses
import inspect
import pickle
import re

import equinox as eqx
import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.fit.fit_summary import Step
from jaxlidar.cli.reference import classes_of_results
from jaxlidar.plants.lsystem import Symbol

NAMESPACES = (jl, jl.io, inversion)
CLASSES = {
    f"{namespace.__name__}.{name}": value
    for namespace in NAMESPACES
    for name, value in {
        **{name: vars(namespace).get(name) for name in namespace.__all__},
        **classes_of_results(namespace),
    }.items()
    if inspect.isclass(value) and not inspect.isabstract(value)
}
# Handles of this process: what one switches on, and the file that the other writes, are no content.
del CLASSES["jaxlidar.CompilationCache"], CLASSES["jaxlidar.io.LasWriter"]
LIDAR, SCENE = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=jl.spectrum("soil-medium")))
VOXELS = jl.VoxelMap.from_lad(np.ones((1, 1, 2)), voxel_size=1.0, leaf_angles="planophile")


def grown(length):
    return ["A"]


# Instances of classes that hold more than arrays; the other classes are filled by `filled_with_arrays`.
INSTANCES = {
    "jaxlidar.Atmosphere": jl.Atmosphere(),
    "jaxlidar.Branching": jl.Branching(),
    "jaxlidar.Canopy": jl.Canopy(VOXELS, leaf=jl.Prospect(), bark=0.3, hotspot=False),
    "jaxlidar.EqualAngle": jl.EqualAngle(),
    "jaxlidar.ExponentiallyModifiedGaussianPulse": jl.ExponentiallyModifiedGaussianPulse(3.0, 2.0),
    "jaxlidar.GaussianPulse": jl.GaussianPulse(),
    "jaxlidar.Ground": SCENE.ground,
    "jaxlidar.Habit": jl.broadleaf(),
    "jaxlidar.HenyeyGreenstein": jl.HenyeyGreenstein(0.9, 0.5),
    "jaxlidar.Isotropic": jl.Isotropic(0.9),
    "jaxlidar.LSystem": jl.LSystem([("A", 0.1)], [jl.Rule("A", grown)]),
    "jaxlidar.Lambertian": jl.Lambertian(),
    "jaxlidar.LateLightWarning": jl.LateLightWarning("late"),
    "jaxlidar.OutlineWarning": jl.OutlineWarning("outline"),
    "jaxlidar.SolidMeshWarning": jl.SolidMeshWarning("solid"),
    "jaxlidar.MisplacedCanopyWarning": jl.MisplacedCanopyWarning("below"),
    "jaxlidar.UnfollowedLightWarning": jl.UnfollowedLightWarning("beyond"),
    "jaxlidar.LostWorkersWarning": jl.LostWorkersWarning("lost"),
    "jaxlidar.OffMapWarning": jl.OffMapWarning("off"),
    "jaxlidar.LeafAngles": VOXELS.leaf_angles,
    "jaxlidar.LeafOptics": jl.LeafOptics(0.4, 0.3),
    "jaxlidar.LeafSurface": jl.leaf_surface(1.4),
    "jaxlidar.Lidar": LIDAR,
    "jaxlidar.Symbol": Symbol("A", (1.0,)),
    "jaxlidar.Plan": jl.plan(LIDAR, SCENE),
    "jaxlidar.Effect": jl.plan(LIDAR, SCENE).effects[0],
    "jaxlidar.Plane": SCENE.ground.shape,
    "jaxlidar.Plate": jl.Plate(1.0, 0.3),
    "jaxlidar.Prospect": jl.Prospect(),
    "jaxlidar.Receiver": jl.Receiver(saturation=1.0, bits=8),
    "jaxlidar.RectangularPulse": jl.RectangularPulse(),
    "jaxlidar.Rule": jl.Rule("A", grown),
    "jaxlidar.SampledPulse": jl.SampledPulse([0.0, 1.0, 2.0], [0.0, 1.0, 0.0]),
    "jaxlidar.Scene": SCENE,
    "jaxlidar.Setup": jl.make_setup(LIDAR, SCENE, jl.plan(LIDAR, SCENE)),
    "jaxlidar.Specular": jl.Specular(0.1),
    "jaxlidar.Spectrum": jl.spectrum("bark-oak"),
    "jaxlidar.Progress": jl.Progress(1, 2, 3.0, "fits", 0, 1),
    "jaxlidar.Tree": jl.grow(jl.shrub()),
    "jaxlidar.UnitWarning": jl.UnitWarning("divergence"),
    "jaxlidar.VoxelMap": VOXELS,
    "jaxlidar.Word": jl.LSystem([("A", 0.1)], [jl.Rule("A", grown)]).rewrite(1),
    "inversion.GapLightWarning": inversion.GapLightWarning("gaps"),
    "jaxlidar.io.FileWarning": jl.io.FileWarning("skipped"),
    "jaxlidar.io.ShotTable": jl.io.ShotTable({"ground": jl.io.Column(np.ones(2), "m", "elevation")}),
    "jaxlidar.io.Case": jl.io.Case(LIDAR, SCENE, jax.random.key(0), {"rtol": 0.1}),
    "inversion.LogNormal": inversion.LogNormal(0.3, 0.5),
    "inversion.Smooth": inversion.Smooth(4.0, spacing=1.5, mean=[0.1, 0.2]),
    "inversion.Step": Step(1, 2.0, True, {"a": np.ones(2)}),
    "inversion.Unknown": inversion.Unknown("ground.height", bounds=(0.0, 1.0)),
}


def filled_with_arrays(kind):
    """Return an instance whose fields are arrays, without its checks: pickling needs no valid values."""
    if issubclass(kind, tuple):
        return kind._make(np.full(2, i + 0.5) for i in range(len(kind._fields)))
    record = object.__new__(kind)
    for i, field in enumerate(dataclasses.fields(kind)):
        object.__setattr__(record, field.name, jax.numpy.full(2, i + 0.5))
    return record


def content(x):
    """Return nested plain values that are equal if and only if two objects have equal content."""
    if isinstance(x, jax.Array) and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key):
        return "key", np.asarray(jax.random.key_data(x)).tobytes()
    if isinstance(x, jax.Array | np.ndarray):
        return type(x).__name__, np.asarray(x).dtype.str, np.shape(x), np.asarray(x).tobytes()
    if isinstance(x, dict):
        return {name: content(value) for name, value in x.items()}
    if isinstance(x, tuple | list):
        return type(x), [content(value) for value in x]
    if isinstance(x, type) or inspect.isroutine(x) or not hasattr(x, "__dict__"):
        return x
    if isinstance(x, Exception):
        return type(x), x.args
    return type(x), {name: content(value) for name, value in vars(x).items() if not name.startswith("__")}


@pytest.mark.parametrize("name", CLASSES)
def test_it_can_be_pickled_and_copied(name):
    instance = INSTANCES.get(name)
    sent = filled_with_arrays(CLASSES[name]) if instance is None else instance
    assert type(sent) is CLASSES[name]
    for back in (pickle.loads(pickle.dumps(sent)), copy.copy(sent), copy.deepcopy(sent)):
        assert content(back) == content(sent)


def test_different_content_is_noticed():
    assert content(jl.Plate(1.0, 0.3)) != content(jl.Plate(1.0, 0.3000001))
    assert content(jl.io.Case(LIDAR)) != content(jl.io.Case(jl.Lidar(zenith=1.0)))


@pytest.fixture(scope="module")
def fit():
    wave = jl.simulate(LIDAR, jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    values = {"<height>": jax.numpy.asarray(0.5)}
    matrix, details = jax.numpy.ones((1, 1)), {"steps": 3, "history": (1.0,), "labels": ("<height>",)}
    by_name = ("values", "stderr", "robust_stderr", "prior_share", "simulation_error")
    scalars = ("reduced_chi2", "second_minimum", "independent_samples")
    return inversion.Retrieval(
        **dict.fromkeys(by_name, values),
        **dict.fromkeys(scalars, matrix[0, 0]),
        at_bound={"<height>": values["<height>"] > 1.0},
        covariance=matrix,
        averaging=matrix,
        strength={},
        bounds={"<height>": np.array([0.0, 1.0])},
        residuals=0.5 + 0 * wave.reflectance,
        fitted=wave.reflectance,
        scene=SCENE,
        waveform=wave,
        converged=True,
        status="done",
        **details,
    )


def pictures(page):
    encoded = re.findall(r'<img [^>]*src="data:image/png;base64,([^"]+)"', page)
    return [base64.b64decode(data) for data in encoded]


def test_notebooks_show_a_waveform_with_its_figure(fit):
    page = fit.waveform._repr_html_()
    assert "Waveform of" in page
    (picture,) = pictures(page)
    assert picture.startswith(b"\x89PNG")
    assert len(picture) < 50_000


def test_notebooks_show_a_fit_with_its_residuals(fit):
    page = fit._repr_html_()
    assert "&lt;height&gt;" in page
    assert "<height>" not in page
    assert len(pictures(page)) == 1
    assert "reduced chi2" in str(fit)


def test_a_traced_waveform_shows_no_figure(fit):
    pages = []
    dynamic, static = eqx.partition(fit.waveform, eqx.is_array)
    jax.make_jaxpr(lambda d: pages.append(eqx.combine(d, static)._repr_html_()))(dynamic)
    assert pages == [None]


COPIES = [lambda x: pickle.loads(pickle.dumps(x)), copy.copy, copy.deepcopy]


@pytest.mark.parametrize("copied", COPIES)
@pytest.mark.parametrize("make", [jax.random.key, jax.random.PRNGKey])
def test_keys_of_copied_cases_draw_the_same(copied, make):
    """JAX compares generators by identity where it draws Poisson numbers: a copy must keep the generator."""
    key = make(3)
    back = copied(jl.io.Case(key=key)).key
    for copied_key, original_key in ((back, key), (jax.random.split(back)[1], jax.random.split(key)[1])):
        np.testing.assert_array_equal(
            jax.random.poisson(copied_key, 2.0, (9,)), jax.random.poisson(original_key, 2.0, (9,))
        )


@pytest.mark.parametrize("copied", COPIES)
def test_copied_cases_without_a_key_have_none(copied):
    assert copied(jl.io.Case(key=None)).key is None
