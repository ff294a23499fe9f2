"""Fingerprints of stores: a run goes on with its own problem only, and what differs is named."""

import dataclasses
import importlib
import shutil
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.special

import inversion
import jaxlidar as jl
from inversion import LogNormal, Unknown
from jaxlidar._fingerprint import digest_of
from jaxlidar.optics.coefficients import Coefficients, shipped
from tests.helpers import ask

TIME = np.arange(-60.0, 21.0)
VOXELS = jl.VoxelMap.from_lad(np.full((1, 1, 3), 0.3), voxel_size=(9.0, 9.0, 1.0), origin=(-4.5, -4.5, 2.0))
SCENE = jl.Scene(
    canopy=jl.Canopy(VOXELS, leaf=jl.Prospect(), sides="periodic", hotspot=False),
    ground=jl.Ground(reflectance=0.3),
)
LIDAR = jl.Lidar(wavelength=(532.0, 1064.0))
# A global that `scale_brightness` uses.
GAIN = 1.0


def scale_brightness(scene, value):
    return eqx.tree_at(lambda s: s.ground.reflectance, scene, GAIN * value)


def square_brightness(scene, value):
    return eqx.tree_at(lambda s: s.ground.reflectance, scene, GAIN * value**2)


def brightness_setter(gain):
    return lambda scene, value: eqx.tree_at(lambda s: s.ground.reflectance, scene, gain * value)


def unknowns(height=None, apply=scale_brightness):
    """Return the unknowns of the problem. `height`: changed fields of the first. `apply`: of the second."""
    return [
        Unknown(**({"where": "ground.height", "bounds": (-2.0, 2.0), "name": "height"} | (height or {}))),
        Unknown(apply=apply, bounds=(0.0, 1.0), name="brightness", start=0.3),
        Unknown("canopy.leaf.Cab", bounds=(5.0, 100.0), prior=(40.0, 10.0), name="Cab"),
    ]


PROBLEM = {
    "observed": np.ones((2, 2, TIME.size)),
    "lidar": LIDAR,
    "scene": SCENE,
    "unknowns": unknowns(),
    "noise": 0.1,
    "time": TIME,
    "key": jax.random.key(0),
    "n_photons": 512,
    "n_rays": 8,
    "max_orders": 2,
}


class SimulationStartedError(Exception):
    """The file was accepted, and the work began."""


def starts_work(**problem):
    """Run a problem up to its first simulation. Return True if it comes that far."""

    def start(*_):
        raise SimulationStartedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("inversion.fit.retrieval_many.LockstepModel", start)
        try:
            ask(inversion.retrieve_many, **problem)
        except SimulationStartedError:
            return True


@pytest.fixture(scope="module")
def empty_store(tmp_path_factory):
    """A store of the problem, without fits."""
    path = tmp_path_factory.mktemp("store") / "fits.zarr"
    assert starts_work(**PROBLEM, path=path)
    return path


@pytest.fixture
def resumes(empty_store, tmp_path):
    """A function that runs the problem, with some arguments changed, with a copy of the store."""
    path = shutil.copytree(empty_store, tmp_path / "fits.zarr")
    return lambda **changes: starts_work(**PROBLEM | {"path": path} | changes)


# Arguments of a problem with a changed lidar, canopy, ground, or unknown height.


def lidar(**changes):
    return {"lidar": dataclasses.replace(LIDAR, **changes)}


def canopy(**changes):
    return {"scene": dataclasses.replace(SCENE, canopy=dataclasses.replace(SCENE.canopy, **changes))}


def ground(**changes):
    return {"scene": dataclasses.replace(SCENE, ground=dataclasses.replace(SCENE.ground, **changes))}


def height(**changes):
    return {"unknowns": unknowns(height=changes)}


def other_plan():
    return jl.plan(LIDAR, SCENE, max_orders=2, n_photons=512, n_rays=8, window=(-60.0, 20.0), bin_width=0.25)


CHANGES = [
    ("observed", {"observed": np.where(np.arange(TIME.size) == 7, 1.001, PROBLEM["observed"])}),
    ("observed", {"observed": np.ones((3, 2, TIME.size))}),
    ("noise", {"noise": 0.101}),
    ("time", {"time": TIME + 0.25}),
    ("noise_floor", {"noise_floor": 0.01}),
    ("lidar", lidar(pulse=jl.GaussianPulse(fwhm=6.001))),
    ("lidar", lidar(pulse=jl.SampledPulse(time=np.arange(-9.0, 10.0), power=np.hanning(19)))),
    ("lidar", lidar(altitude=1001.0)),
    ("lidar", lidar(wavelength=np.array([532.0, 1065.0]))),
    ("lidar", lidar(profile="top-hat")),
    ("lidar", lidar(receiver=jl.Receiver(photon_noise=False))),
    ("lidar", {"lidar": [LIDAR, dataclasses.replace(LIDAR, altitude=900.0)]}),
    ("scene", ground(slope=5.0)),
    ("scene", ground(reflectance=0.31)),
    ("scene", canopy(hotspot=True)),
    ("scene", canopy(leaf=jl.Prospect(version="5"))),
    ("scene", ground(law=jl.EqualAngle())),
    ("unknowns", {"unknowns": unknowns()[::-1]}),
    ("unknowns", {"unknowns": unknowns()[:2]}),
    ("unknowns", height(name="z")),
    ("where or apply of 'height'", height(where="ground.slope", bounds=(-2.0, 2.0))),
    ("bounds of 'height'", height(bounds=(-2.0, 2.1))),
    ("prior of 'height'", height(prior=(0.0, 1.0))),
    ("start of 'height'", height(start=0.1)),
    ("start of 'height'", {"start": {"height": np.array([0.0, 0.1])}}),
    ("where or apply of 'brightness'", {"unknowns": unknowns(apply=square_brightness)}),
    ("where or apply of 'brightness'", {"unknowns": unknowns(apply=brightness_setter(1.0))}),
    ("scale", {"scale": (0.5, 2.0)}),
    ("key", {"key": jax.random.key(1)}),
    ("key", {"key": jax.random.key(0, impl="rbg")}),
    ("max_steps", {"max_steps": 49}),
    ("starts", {"starts": 2}),
    ("n_photons", {"n_photons": 1024}),
    ("n_rays", {"n_rays": 16}),
    ("max_orders", {"max_orders": 3}),
    ("plan", {"plan": other_plan(), "n_photons": None, "n_rays": None, "max_orders": None}),
]


@pytest.mark.parametrize(("named_part", "change"), CHANGES)
def test_another_problem_is_refused_and_what_differs_is_named(resumes, tmp_path, named_part, change):
    before = (tmp_path / "fits.zarr" / "zarr.json").read_bytes()
    with pytest.raises(ValueError, match=rf"fits\.zarr holds results of another .* in .*\b{named_part}"):
        resumes(**change)
    assert (tmp_path / "fits.zarr" / "zarr.json").read_bytes() == before


def test_only_what_differs_is_named(resumes):
    with pytest.raises(ValueError, match=r"which differs in bounds of 'height', key; "):
        resumes(key=jax.random.key(1), **height(bounds=(-3.0, 2.0)))


def test_the_kind_of_prior_and_the_scale_count(resumes, tmp_path):
    path = tmp_path / "prior.zarr"
    normal = {"bounds": (0.0, 2.0), "start": 1.0, "prior": (1.0, 0.5)}
    assert resumes(path=path, scale=(0.5, 2.0), **height(**normal))
    with pytest.raises(ValueError, match=r"which differs in prior of 'height'; "):
        resumes(path=path, scale=(0.5, 2.0), **height(**normal | {"prior": LogNormal(1.0, 0.5)}))
    with pytest.raises(ValueError, match=r"which differs in scale; "):
        resumes(path=path, scale=(0.5, 2.1), **height(**normal))


def test_coefficients_of_leaves_count(resumes, tmp_path):
    path, table = tmp_path / "leaf.zarr", shipped("PC")

    def leaf(factor):
        absorption = table.absorption * np.where(np.arange(len(table.wavelength)) == 700, factor, 1.0)
        coefficients = Coefficients(table.wavelength, table.index, absorption, table.traits)
        return canopy(leaf=jl.Prospect(version="PRO", coefficients=coefficients))

    assert resumes(path=path, **leaf(1.001))
    assert resumes(path=path, **leaf(1.001))
    with pytest.raises(ValueError, match=r"which differs in scene; "):
        resumes(path=path, **leaf(1.002))


def test_functions_are_identified_by_code_closures_and_globals(resumes, tmp_path, monkeypatch):
    path = tmp_path / "closure.zarr"
    assert resumes(path=path, unknowns=unknowns(apply=brightness_setter(2.0)))
    assert resumes(path=path, unknowns=unknowns(apply=brightness_setter(2.0)))
    with pytest.raises(ValueError, match=r"which differs in where or apply of 'brightness'; "):
        resumes(path=path, unknowns=unknowns(apply=brightness_setter(3.0)))
    monkeypatch.setitem(globals(), "GAIN", 2.0)
    with pytest.raises(ValueError, match=r"which differs in where or apply of 'brightness'; "):
        resumes()
    with (tmp_path / "open").open("w") as file:
        message = "where or apply of 'brightness' cannot be compared .*: the content of a TextIOWrapper"
        with pytest.raises(TypeError, match=message):
            resumes(unknowns=unknowns(apply=lambda s, value: scale_brightness(s, value * file.writable())))


def test_releases_and_settings_count(resumes, monkeypatch):
    with jax.enable_x64(True), pytest.raises(ValueError, match=r"which differs in .*jax_enable_x64"):
        resumes()
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.0.1" if name == "jax" else "1.0")
    with pytest.raises(ValueError, match=r"which differs in .*\bversion of jax\b"):
        resumes()


def test_changes_that_affect_no_result_are_accepted(resumes):
    assert resumes()
    assert resumes(lanes=1)
    assert resumes(progress=print)
    assert resumes(noise=np.full((2, 2, TIME.size), 0.1), time=TIME.tolist(), starts=1)
    assert resumes(start={"height": np.zeros(2)})
    assert resumes(unknowns=unknowns(height={"where": lambda s: s.ground.height}))
    assert resumes(**lidar(receiver=jl.Receiver(window="first return")))
    assert resumes(scene=jax.tree.map(lambda a: a.copy(), SCENE))
    # The same number in each of eight batches.
    assert resumes(n_photons=511)


class Law(eqx.Module):
    """A class of a user, with a constant, a method that names the class, and a global."""

    strength: jax.Array = eqx.field(converter=jnp.asarray)
    LIMIT = 2.0

    def __call__(self, x):
        return self.inner(x) * self.LIMIT

    def inner(self, x):
        return Law(self.strength) if x is None else GAIN * x


def test_classes_of_a_user_are_identified_by_their_code(monkeypatch):
    original = digest_of(Law(1.0))
    assert digest_of(Law(1.0)) == original
    changed = [digest_of(Law(2.0))]
    monkeypatch.setattr(Law, "LIMIT", 3.0)
    changed.append(digest_of(Law(1.0)))
    monkeypatch.undo()
    monkeypatch.setitem(globals(), "GAIN", 2.0)
    changed.append(digest_of(Law(1.0)))
    monkeypatch.undo()
    monkeypatch.setattr(Law, "inner", lambda self, x: x)
    changed.append(digest_of(Law(1.0)))
    monkeypatch.undo()
    assert digest_of(Law(1.0)) == original
    assert len({original, *changed}) == 5


def squared(derivative):
    """Return a function with a custom rule for its derivative."""

    @eqx.filter_custom_jvp
    def f(x):
        return x**2

    @f.def_jvp
    def rule(primals, tangents):
        return primals[0] ** 2, derivative * primals[0] * tangents[0]

    return f


def test_rules_for_derivatives_count():
    assert digest_of(squared(2.0)) == digest_of(squared(2.0)) != digest_of(squared(2.1))


USERS_OF_B = {
    "a module": ("import my_b\n", "my_a"),
    "by way of another": ("import my_c\n", "my_a"),
    "within a function": ("def scale(x):\n    import my_b\n    return my_b.scale(x)\n", "my_a"),
    "a name": ("from my_b import scale\n", "my_a"),
    "a function that is called": ("import my_b\ndef use(x):\n    return my_b.scale(x)\n", "my_a.use"),
    "a function that imports": ("def use(x):\n    from my_b import scale\n    return scale(x)\n", "my_a.use"),
    "a method": ("import my_c\nclass Law:\n    def use(self, x):\n        return my_c.b(x)\n", "my_a.Law"),
}


@pytest.mark.parametrize("form", USERS_OF_B)
def test_files_that_files_of_a_user_import_count(form, tmp_path, monkeypatch):
    """`my_a` uses `my_b`, directly or by way of `my_c`: another `my_b` is another problem."""
    monkeypatch.syspath_prepend(tmp_path)
    source, name = USERS_OF_B[form]
    (tmp_path / "my_a.py").write_text(source)
    (tmp_path / "my_c.py").write_text("import numpy, my_b, my_a\ndef b(x):\n    return my_b.scale(x)\n")

    def digest(line):
        (tmp_path / "my_b.py").write_text(line)
        for module in ("my_a", "my_b", "my_c"):
            monkeypatch.delitem(sys.modules, module, raising=False)
        importlib.invalidate_caches()
        x = importlib.import_module("my_a")
        for attribute in name.split(".")[1:]:
            x = getattr(x, attribute)
        return digest_of(x)

    double, other, again = map(digest, ("scale = abs\n# 2\n", "scale = abs\n# 33\n", "scale = abs\n# 2\n"))
    assert double == again
    assert double != other


def test_modules_of_a_user_are_identified_by_their_file(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    digests = []
    for line in ("double = lambda x: 2 * x", "double = lambda x: 2 * x", "double = lambda x: 3 * x"):
        (tmp_path / "my_helpers.py").write_text(line)
        importlib.invalidate_caches()
        monkeypatch.delitem(sys.modules, "my_helpers", raising=False)
        digests.append(digest_of(importlib.import_module("my_helpers")))
    assert digests[0] == digests[1] != digests[2]


def test_objects_of_packages_are_identified_by_name():
    for x in (
        np.exp,
        jnp.exp,
        jnp.add,
        np.linalg.norm,
        jax.nn.relu,
        optx.max_norm,
        eqx.nn.MLP,
        scipy.special.expit,
    ):
        assert digest_of(x) == digest_of(x)
    assert digest_of(np.exp) != digest_of(np.sin)
