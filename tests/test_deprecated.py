"""Old names of what was renamed: for one version they give the same and warn."""

import jax
import jax.numpy as jnp
import pytest

import jaxlidar as jl
from jaxlidar._deprecated import RENAMED
from jaxlidar.extend import vec

DOWN, UP = (vec(jnp.array([0.0, 0.0, z])) for z in (-1.0, 1.0))
HALF_ANGLE = jnp.array(1e-4)


@pytest.mark.parametrize("old", RENAMED)
def test_a_renamed_public_name_gives_the_new_one_and_warns(old):
    with pytest.warns(DeprecationWarning, match=rf"jaxlidar\.{old} is renamed: use jaxlidar\.{RENAMED[old]}"):
        assert getattr(jl, old) is getattr(jl, RENAMED[old])
    assert old not in jl.__all__


@pytest.mark.parametrize("old", ["ledger", "ledger_stderr"])
def test_a_renamed_attribute_of_a_waveform_warns(old):
    new = old.replace("ledger", "energy_budget")
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    with pytest.warns(
        DeprecationWarning, match=rf"Waveform\.{old} is renamed: use Waveform\.{new}"
    ) as caught:
        assert getattr(wave, old) is getattr(wave, new)
    assert caught[0].filename == __file__


def test_a_name_that_never_was_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'ledgers'"):
        _ = jl.ledgers


def test_methods_of_laws_and_phase_functions_answer_to_their_old_names():
    law, phase = jl.Lambertian(), jl.Isotropic(albedo=0.5)
    with pytest.warns(DeprecationWarning, match=r"Lambertian\.view_factor .*use Lambertian.intensity_factor"):
        assert law.view_factor(DOWN, UP, UP, HALF_ANGLE) == law.intensity_factor(DOWN, UP, UP, HALF_ANGLE)
    with pytest.warns(DeprecationWarning, match="use Lambertian.largest_intensity_factor"):
        assert law.largest_view_factor(1e-4) == 1.0
    with pytest.warns(DeprecationWarning, match=r"Isotropic\.view_factor"):
        assert phase.view_factor(DOWN, UP) == 0.25


def test_a_law_that_defines_methods_under_their_old_names_works():
    with pytest.warns(DeprecationWarning, match=r"Half\.(largest_)?view_factor is renamed") as warned:

        class Half(jl.AbstractLaw):
            """Half of what a Lambertian surface reflects."""

            def view_factor(self, incident, normal, view, half_angle):
                return 0.5 * jl.Lambertian().intensity_factor(incident, normal, view, half_angle)

            def albedo(self, incident, normal):
                return jnp.full_like(incident[0], 0.5)

            def sample(self, incident, normal, u, v):
                return jl.Lambertian().sample(incident, normal, u, v)

            def density(self, incident, normal, out):
                return jl.Lambertian().density(incident, normal, out)

            def largest_view_factor(self, half_angle):
                return 0.5

    assert len(warned) == 2
    assert all(warning.filename == __file__ for warning in warned)
    law = Half()
    assert law.intensity_factor(DOWN, UP, UP, HALF_ANGLE) == law.view_factor(DOWN, UP, UP, HALF_ANGLE) == 0.5
    assert law.largest_intensity_factor(1e-4) == 0.5
    assert jl.Ground(law=law).law is law


def test_a_phase_function_that_defines_methods_under_their_old_names_works():
    with pytest.warns(DeprecationWarning, match=r"Even\.(largest_)?view_factor is renamed"):

        class Even(jl.AbstractPhase):
            """Isotropic scattering."""

            albedo: jnp.ndarray

            def view_factor(self, incident, view):
                return jnp.full_like(incident[0], 0.25)

            def sample(self, incident, u, v):
                return jl.Isotropic(albedo=self.albedo).sample(incident, u, v)

            def largest_view_factor(self):
                return 0.25

    phase = Even(jnp.array(0.5))
    assert phase.intensity_factor(DOWN, UP) == phase.largest_intensity_factor() == 0.25
    assert phase.density(DOWN, UP) == pytest.approx(0.25 / jnp.pi)


@pytest.mark.parametrize(
    ("kind", "voxels"),
    [
        ("spreading", 'kind = "voxelise"\nvoxel_size = 2.0\ntrees = {kind = "grow", habit = "spreading"}'),
        (
            "crop",
            'kind = "crop"\nvoxels = {kind = "voxelise", voxel_size = 2.0, trees = {kind = "grow", '
            'habit = {kind = "shrub", stems = 1}}}',
        ),
    ],
)
def test_a_case_file_with_the_old_name_of_a_kind_is_read(kind, voxels, tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(f'[scene.canopy]\nleaf = "Prospect"\nbark = 0.3\n[scene.canopy.voxels]\n{voxels}\n')
    with pytest.warns(DeprecationWarning, match=f"kind = '{kind}' is renamed: use kind = '{RENAMED[kind]}'"):
        case = jl.io.read_case(path)
    assert case.scene.canopy.voxels.bark.size >= 1
