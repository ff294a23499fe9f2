"""A change of a number compiles nothing, in every entry point; a voxel layer or a shot more no long program.

Programs are counted as JAX compiles them, whoever asks for it: those of the package and those of single
operations. Scenes and surveys are small, photons few: programs are the same.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl

KEY = jax.random.key(0)
# Programs that take less than half a second to compile, for sizes as they are.
SHORT_PROGRAMS = {
    *("_build_geometry", "_sample_fractions", "_distance_along_axes", "_normal_cdf", "_z_score"),
    *("stage", "multiply", "broadcast_in_dim", "convert_element_type", "stack", "dynamic_slice", "squeeze"),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """The numbers of a small scene, a lidar and a survey."""

    zenith: float = 5.0
    azimuth: float = 10.0
    altitude: float = 500.0
    position: tuple[float, float] = (0.1, 0.2)
    divergence: float = 2.0
    fwhm: float = 5.0
    wavelength: float = 1064.0
    height: float = 0.0
    slope: float = 3.0
    reflectance: float = 0.3
    base: float = 2.0
    leaf_area_density: float = 0.5
    Cab: float = 40.0
    window: tuple[float, float] = (-70.0, 30.0)
    rtol: float = 0.3
    n_layers: int = 12
    n_shots: int = 5
    n_columns: int = 6

    @property
    def lidar(self):
        pulse = jl.GaussianPulse(fwhm=self.fwhm)
        return jl.Lidar(
            wavelength=self.wavelength,
            zenith=self.zenith,
            azimuth=self.azimuth,
            altitude=self.altitude,
            position=self.position,
            divergence=self.divergence,
            pulse=pulse,
        )

    @property
    def scene(self):
        n = self.n_columns
        random = np.random.default_rng(0).uniform(size=(n, n, self.n_layers))
        voxels = jl.VoxelMap.from_lad(
            self.leaf_area_density * random,
            voxel_size=(1.0, 1.0, 0.5),
            origin=(-0.5 * n, -0.5 * n, self.base),
        )
        leaf = jl.Prospect(Cab=self.Cab)
        ground = jl.Ground(height=self.height, slope=self.slope, reflectance=self.reflectance)
        return jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf, hotspot=False), ground=ground)

    @property
    def survey(self):
        random = np.random.default_rng(1)
        shifts = random.uniform(-1.0, 1.0, (self.n_shots, 2))
        zenith = self.zenith + random.uniform(-2.0, 2.0, self.n_shots)
        return jl.Survey(self.lidar, position=np.add(self.position, shifts), zenith=zenith)


CHANGES = {
    "zenith": 5.4,
    "azimuth": 35.0,
    "altitude": 510.0,
    "position": (0.3, -0.1),
    "divergence": 2.1,
    "fwhm": 5.1,
    "wavelength": 1080.0,
    "height": 0.1,
    "slope": 3.2,
    "reflectance": 0.35,
    "base": 2.1,
    "leaf_area_density": 0.55,
    "Cab": 50.0,
    "window": (-71.0, 29.0),
    "rtol": 0.28,
}
SIZES = {"n_layers": 13, "n_shots": 6, "n_columns": 7}


def simulate(case):
    return jl.simulate(
        case.lidar, case.scene, key=KEY, rtol=case.rtol, window=case.window, max_orders=3, n_photons=512
    )


def simulate_many(case):
    return jl.simulate_many(case.survey, case.scene, key=KEY, rtol=case.rtol, max_orders=1)


def simulate_many_with_truth(case):
    return jl.simulate_many(case.survey, case.scene, key=KEY, rtol=case.rtol, max_orders=1, truth=True)


def simulate_many_orders(case):
    return jl.simulate_many(case.survey, case.scene, key=KEY, rtol=case.rtol, max_orders=2)


def energy_budget(case):
    return jl.energy_budget(case.lidar, case.scene, key=KEY, rtol=0.05, max_photons=20_000)


def reflectance_factor(case):
    canopy = dataclasses.replace(case.scene.canopy, sides="periodic")
    return jl.reflectance_factor(
        dataclasses.replace(case.scene, canopy=canopy),
        sun=(30.0, 100.0),
        view=(case.zenith, case.azimuth),
        wavelengths=case.wavelength,
        key=KEY,
        n_photons=512,
        max_orders=3,
    )


def truth_of(case):
    plan = jl.plan(case.lidar, case.scene, window=case.window, max_orders=1, describe=False)
    return jl.truth_of(case.lidar, case.scene, plan=plan)


def simulate_scenes(case):
    scenes = jax.tree.map(lambda a: jnp.stack([a, a]), case.scene)
    return jl.simulate_scenes(case.lidar, scenes, key=KEY, plan=plan_scenes(case, scenes))


def plan_scenes(case, scenes):
    return jl.plan_scenes(case.lidar, scenes, max_orders=2, n_photons=2048, window=case.window)


def unknown_chlorophyll(case):
    return [inversion.Unknown("canopy.leaf.Cab", bounds=(5.0, case.Cab + 40.0), name="Cab")]


def problem_of(case, *, many=False):
    wave = simulate(case)
    observed = np.asarray(wave.reflectance)
    return inversion.Problem(
        np.stack([observed, 1.01 * observed]) if many else observed,
        case.lidar,
        case.scene,
        unknown_chlorophyll(case),
        noise=0.01,
        time=wave.time,
        n_photons=512,
        n_rays=32,
        max_orders=2,
    )


def retrieve(case):
    return inversion.retrieve(problem_of(case), key=KEY, max_steps=2)


def retrieve_many(case):
    return inversion.retrieve_many(problem_of(case, many=True), key=KEY, max_steps=2)


def log_density(case):
    density = inversion.log_density(problem_of(case), key=KEY)
    return density(density.initial)


def cramer_rao(case):
    return inversion.cramer_rao(problem_of(case), key=KEY)


def design(case):
    return inversion.design(
        case.lidar,
        case.scene,
        unknown_chlorophyll(case),
        free=("wavelength",),
        limits={"wavelength": (600.0, 1300.0)},
        key=KEY,
        max_orders=1,
        max_steps=2,
        starts=1,
    )


def off_the_edge(case):
    """Lift the canopy: the record's size lies at the edge of a bucket otherwise."""
    return dataclasses.replace(case, base=case.base + 1.0)


def retrieve_scene(case):
    case = off_the_edge(case)
    waves = simulate_many(case)
    height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height", start=case.height)
    return inversion.retrieve_scene(
        waves, case.survey, case.scene, [height], noise=0.01, key=KEY, max_orders=1, max_steps=2, draws=2
    )


def geolocate(case):
    case = off_the_edge(case)
    survey = jl.Survey.grid(case.lidar, (-1.0, -1.0), (1.0, 1.0), 1.0)
    waves = jl.simulate_many(survey, case.scene, key=KEY, max_orders=1)
    return inversion.geolocate(waves, survey, case.scene, noise=0.01, search_radius=2.0, key=KEY)


ENTRY_POINTS = [
    simulate,
    simulate_many,
    pytest.param(simulate_many_with_truth, marks=pytest.mark.slow),
    pytest.param(simulate_many_orders, marks=pytest.mark.slow),
    energy_budget,
    reflectance_factor,
    pytest.param(truth_of, marks=pytest.mark.slow),
    pytest.param(simulate_scenes, marks=pytest.mark.slow),
    retrieve,
    pytest.param(retrieve_many, marks=pytest.mark.slow),
    pytest.param(log_density, marks=pytest.mark.slow),
    cramer_rao,
    pytest.param(design, marks=pytest.mark.slow),
    pytest.param(retrieve_scene, marks=pytest.mark.slow),
    pytest.param(geolocate, marks=pytest.mark.slow),
]
# Entry points that compile for other numbers of voxels: the record of several orders is longer over a taller
# canopy, and unknowns of `retrieve_scene` stand for its map.
COMPILED_FOR_VOXELS = {simulate_many_orders, retrieve_scene}


@pytest.fixture(scope="module")
def compiled_names():
    """The names of the programs that JAX has compiled, in the order in which they were."""
    names = []

    def note(event, duration, fun_name="", **_):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(fun_name.removeprefix("jit(").removesuffix(")"))

    jax.monitoring.register_event_duration_secs_listener(note)
    yield names
    jax.monitoring.unregister_event_duration_listener(note)


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
def test_a_change_of_a_number_compiles_nothing(entry_point, compiled_names):
    """Each number in turn; then one voxel layer, column or shot more, which compiles short programs alone."""
    compiled_names.clear()
    jax.jit(lambda x: x + 1.0)(1.0)
    assert compiled_names == ["<lambda>"]
    for _ in range(2):
        entry_point(Case())
    compiled = {}
    for name, value in CHANGES.items():
        compiled_names.clear()
        entry_point(dataclasses.replace(Case(), **{name: value}))
        compiled[name] = [*compiled_names]
    assert {name: {*programs} - SHORT_PROGRAMS for name, programs in compiled.items()} == {
        name: set() for name in CHANGES
    }
    for name, value in SIZES.items():
        if entry_point in COMPILED_FOR_VOXELS and name != "n_shots":
            continue
        compiled_names.clear()
        entry_point(dataclasses.replace(Case(), **{name: value}))
        assert {*compiled_names} <= SHORT_PROGRAMS, name


# Each crossed the edge of a size, or was a program of its own, before plans had room (`Plan.with_room`).
FAR_CHANGES = {
    "zenith": (0.0, 10.0, 25.0),
    "fwhm": (4.0, 7.0),
    "window": ((-90.0, 60.0), (-40.0, 10.0)),
    "n_layers": (14, 15),
    "divergence": (1.0,),
    "height": (-2.0,),
    "reflectance": (0.6,),
    "wavelength": ((532.0, 1064.0, 1550.0), (700.0, 1064.0)),
}


def test_far_changes_of_a_simulation_compile_no_trace(compiled_names):
    def simulate_to_tolerance(case):
        jl.simulate(case.lidar, case.scene, key=KEY, rtol=case.rtol, window=case.window)

    simulate_to_tolerance(Case())
    for name, values in FAR_CHANGES.items():
        for value in values:
            compiled_names.clear()
            simulate_to_tolerance(dataclasses.replace(Case(), **{name: value}))
            traces = {program for program in compiled_names if program.startswith("batch_of")}
            assert not traces, (name, value)
