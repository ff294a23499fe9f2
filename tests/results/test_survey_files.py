"""Files of surveys hold their case, from which the same waveforms can be simulated again bit for bit."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxlidar as jl

pytest.importorskip("h5netcdf")

KEY = jax.random.key(11)
SCENE = jl.Scene(ground=jl.Ground(slope=8.0), plates=(jl.Plate(height=3.0, reflectance=0.4, coverage=0.5),))
SURVEY = jl.Survey(jl.Lidar(), position=[(0.0, 0.0), (3.0, 1.0), (9.0, 5.0)], zenith=[0.0, 10.0, 20.0])
ARGUMENTS = {"rtol": 0.1, "max_orders": 2, "shared": False, "truth": False}


@pytest.fixture(scope="module")
def waveforms():
    return jl.simulate_many(SURVEY, SCENE, key=KEY, **ARGUMENTS)


def same(a, b):
    """True if two results are equal, missing numbers included."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=np.asarray(x).dtype.kind == "f") for x, y in leaves)


def test_a_store_that_is_written_shot_by_shot_is_repeated_bit_for_bit(waveforms, tmp_path):
    path = tmp_path / "survey.zarr"
    jl.simulate_many(SURVEY, SCENE, key=KEY, **ARGUMENTS, path=path)
    repeated = jl.rerun(path)
    assert same(repeated, waveforms)
    assert same(repeated, jl.open(path))
    case = jl.io.read_case(path)
    assert case.arguments == ARGUMENTS
    assert same((case.survey, case.scene), (SURVEY, SCENE))
    other_key = dataclasses.replace(case, key=jax.random.key(12)).simulate()
    assert not np.array_equal(other_key.reflectance, waveforms.reflectance)


def test_waveforms_are_saved_with_their_case_and_with_no_other(waveforms, tmp_path):
    path = tmp_path / "survey.nc"
    case = jl.io.Case(survey=SURVEY, scene=SCENE, key=KEY, arguments=ARGUMENTS)
    waveforms.save(path, case)
    assert same(jl.rerun(path), waveforms)
    waveforms.save(path)
    with pytest.raises(
        ValueError, match=r"survey\.nc: /case: no such attribute: it was saved without its case"
    ):
        jl.rerun(path)
    elsewhere = dataclasses.replace(case, survey=SURVEY.relative_to(np.ones(2)))
    for wrong_case, message in (
        (elsewhere, "the shots of the case have another position"),
        (jl.io.Case(jl.Lidar(), SCENE, KEY), "a case with a survey belongs to Waveforms"),
        (dataclasses.replace(case, survey=jl.Survey(jl.Lidar(wavelength=532.0), [(0, 0)])), "of 532.0|532"),
    ):
        with pytest.raises(ValueError, match=message):
            waveforms.save(path, wrong_case)
    with pytest.raises(ValueError, match="a case with a survey belongs to Waveforms"):
        waveforms[0].save(tmp_path / "shot.nc", case)


def test_waveforms_of_a_disturbed_survey_are_saved_with_its_case(tmp_path):
    """Their positions are those that it states; planted: the survey as it was before."""
    flight = jl.Trajectory([0.0, 1.0], [(0, 0, 100), (0, 10, 100)])
    lidar, scene = jl.Lidar(sensor=(0, 0, 0)), jl.Scene(ground=jl.Ground())
    strip = jl.Survey.fly(flight, jl.Conical(5.0, 3.0), lidar=lidar, pulse_rate=2.0)
    case = jl.io.Case(survey=strip.disturbed(position=0.05, key=KEY), scene=scene, key=KEY)
    waveforms, path = case.simulate(), tmp_path / "strip.nc"
    waveforms.save(path, case)
    assert same(jl.io.read_case(path).survey, case.survey)
    assert same(jl.rerun(path), waveforms)
    with pytest.raises(ValueError, match="the shots of the case have another position"):
        waveforms.save(path, dataclasses.replace(case, survey=strip.relative_to(np.ones(2))))


class UserPulse(jl.AbstractPulse):
    """A pulse of a user's program, whose code a file cannot hold."""

    def cumulative(self, t, jitter=0.0):
        return jl.GaussianPulse().cumulative(t, jitter)

    def support(self, jitter=0.0):
        return jl.GaussianPulse().support(jitter)

    mean = property(lambda self: jl.GaussianPulse().mean)
    std = property(lambda self: jl.GaussianPulse().std)
    finest = property(lambda self: jl.GaussianPulse().finest)


def test_results_of_a_case_that_no_file_can_hold_are_saved_without_it(tmp_path):
    survey, path = jl.Survey(jl.Lidar(pulse=UserPulse()), SURVEY.position), tmp_path / "survey.zarr"
    waveforms = jl.simulate_many(survey, jl.Scene(ground=jl.Ground()), key=KEY, path=path)
    assert same(jl.open(path), waveforms)
    with pytest.raises(ValueError, match="it was saved without its case"):
        jl.rerun(path)


def test_arguments_of_surveys_are_refused_for_a_single_lidar():
    with pytest.raises(ValueError, match="shared"):
        jl.io.Case(jl.Lidar(), SCENE, KEY, {"shared": True})
