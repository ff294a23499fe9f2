"""Progress: reports to a function, a bar of tqdm on the standard error, or silence."""

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from jaxlidar.progress import shows_progress
from tests.helpers import slow_unless

KEY = jax.random.key(0)
SCENE = jl.Scene(plates=[jl.Plate(2.0, 0.3, 0.3)], ground=jl.Ground(reflectance=0.4))
SURVEY = jl.Survey(jl.Lidar(), position=np.zeros((3, 2)))


def retrieve(progress):
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4)), key=KEY)
    unknown = inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness")
    problem = inversion.Problem(wave, jl.Lidar(), jl.Scene(ground=jl.Ground()), [unknown], noise=0.001)
    return inversion.retrieve(problem, key=KEY, progress=progress)


CALLS = {
    "simulate": (lambda p: jl.simulate(jl.Lidar(), SCENE, key=KEY, rtol=0.5, progress=p), "error"),
    "simulate_many": (lambda p: jl.simulate_many(SURVEY, SCENE, key=KEY, rtol=0.5, progress=p), "3/3"),
    "energy_budget": (
        lambda p: jl.energy_budget(jl.Lidar(), SCENE, key=KEY, max_photons=9000, progress=p),
        "error",
    ),
    "retrieve": (retrieve, "chi2"),
}


@pytest.mark.parametrize("name", slow_unless(["simulate", "retrieve"], CALLS))
def test_true_shows_a_bar_and_none_is_silent(name, capfd):
    call, text = CALLS[name]
    call(None)
    call(False)
    assert capfd.readouterr().err == ""
    call(True)
    assert text in capfd.readouterr().err
    reports = []
    call(reports.append)
    assert reports
    assert capfd.readouterr().err == ""
    with pytest.raises(TypeError, match="progress = 3 is no function"):
        call(3)


def test_the_bar_of_an_unknown_total_is_in_percent_of_the_tolerance(capfd):
    @shows_progress
    def work(*, progress=None):
        for error in (0.04, 0.02, 0.01):
            progress(jl.Progress(int(1 / error**2), None, 1.0, "photons", error=error, rtol=0.01))

    work(progress=True)
    shown = capfd.readouterr().err
    assert all(percent in shown for percent in ("6%", "25%", "100%"))


def test_the_bar_is_left_where_work_fails(capfd):
    @shows_progress
    def work(*, progress=None):
        progress(1, 4)
        raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        work(progress=True)
    assert "1/4" in capfd.readouterr().err


def test_work_of_another_kind_has_a_bar_of_its_own(capfd):
    @shows_progress
    def work(*, progress=None):
        progress(jl.Progress(60, 60, 1.0))
        for done in (1, 120):
            progress(jl.Progress(done, 120, 1.0, "fits"))

    work(progress=True)
    shown = capfd.readouterr().err
    assert "60/60" in shown
    assert "120/120" in shown
    assert "fits" in shown
    assert "120/60" not in shown


def test_numbers_of_steps_that_end_in_another_order_are_counted(capfd):
    @shows_progress
    def work(*, progress=None):
        for number in (2, 3, 1, 0):
            progress(number)

    work(progress=True)
    assert "4 steps" in capfd.readouterr().err
