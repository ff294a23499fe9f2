"""Files of surveys know the case that they are of: what they hold is simulated again to the bit."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxlidar as jl

pytest.importorskip("h5netcdf")

KEY = jax.random.key(11)
SCENE = jl.Scene(ground=jl.Ground(slope=8.0), plates=(jl.Plate(height=3.0, reflectance=0.4, coverage=0.5),))
SURVEY = jl.Survey(jl.Lidar(), position=[(0.0, 0.0), (3.0, 1.0), (9.0, 5.0)], zenith=[0.0, 10.0, 20.0])
HOW = {"rtol": 0.1, "max_orders": 2, "shared": False, "truth": False}


@pytest.fixture(scope="module")
def many():
    return jl.simulate_many(SURVEY, SCENE, key=KEY, **HOW)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_a_file_that_is_written_shot_by_shot_is_repeated_bit_for_bit(many, tmp_path, suffix):
    path = tmp_path / f"many{suffix}"
    jl.simulate_many(SURVEY, SCENE, key=KEY, **HOW, path=path)
    again = jl.rerun(path)
    assert same(again, many)
    assert same(again, jl.open(path))
    kept = jl.io.read_case(path)
    assert kept.arguments == HOW
    assert same((kept.survey, kept.scene), (SURVEY, SCENE))
    other = dataclasses.replace(kept, key=jax.random.key(12)).simulate()
    assert not np.array_equal(other.reflectance, many.reflectance)


def test_waveforms_are_saved_with_their_case(many, tmp_path):
    path = tmp_path / "many.nc"
    case = jl.io.Case(survey=SURVEY, scene=SCENE, key=KEY, arguments=HOW)
    many.save(path, case)
    assert same(jl.rerun(path), many)
    many.save(path)
    with pytest.raises(
        ValueError, match=r"many\.nc: /case: no such attribute: it was saved without its case"
    ):
        jl.rerun(path)
    elsewhere = dataclasses.replace(case, survey=SURVEY.about(np.ones(2)))
    for wrong, says in (
        (elsewhere, "the shots of the case have another position"),
        (jl.io.Case(jl.Lidar(), SCENE, KEY), "a case with a survey belongs to Waveforms"),
        (dataclasses.replace(case, survey=jl.Survey(jl.Lidar(wavelength=532.0), [(0, 0)])), "of 532.0|532"),
    ):
        with pytest.raises(ValueError, match=says):
            many.save(path, wrong)
    with pytest.raises(ValueError, match="a case with a survey belongs to Waveforms"):
        many[0].save(tmp_path / "one.nc", case)


class Own(jl.AbstractPulse):
    """A pulse of one's own, of which a file cannot hold the code."""

    def cumulative(self, t, jitter=0.0):
        return jl.GaussianPulse().cumulative(t, jitter)

    def support(self, jitter=0.0):
        return jl.GaussianPulse().support(jitter)

    mean = property(lambda self: jl.GaussianPulse().mean)
    std = property(lambda self: jl.GaussianPulse().std)
    finest = property(lambda self: jl.GaussianPulse().finest)


def test_a_case_that_no_file_can_hold_is_not_kept(tmp_path):
    survey, path = jl.Survey(jl.Lidar(pulse=Own()), SURVEY.position), tmp_path / "many.nc"
    many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground()), key=KEY, path=path)
    assert same(jl.open(path), many)
    with pytest.raises(ValueError, match="it was saved without its case"):
        jl.rerun(path)


def test_arguments_of_surveys_alone_are_refused_elsewhere():
    with pytest.raises(ValueError, match="shared"):
        jl.io.Case(jl.Lidar(), SCENE, KEY, {"shared": True})
