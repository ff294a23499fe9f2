"""Arrays that are not kept: absent from memory and files, and refused by name where they are used."""

import pickle

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._not_kept import NotKept
from jaxlidar.survey.results import OPTIONAL_ARRAYS
from tests.survey.test_simulate_many import KEY, nadir, same, scan, stand, stored_shots

NAMES = ("recorded", "energy", "components")
SURVEY = jl.Survey.track(jl.Lidar(), start=(0, 0), end=(90, 0), spacing=10.0)
SCENE = jl.Scene(ground=jl.Ground(height=5.0, reflectance=0.4, slope=5.0, aspect=90.0))
NEEDS_STDERR = "stderr was not kept: add 'stderr' to keep= of simulate_many"


def simulate(names, **options):
    return jl.simulate_many(SURVEY, SCENE, key=KEY, keep=names, **options)


@pytest.fixture(scope="module")
def complete():
    return simulate(None)


@pytest.fixture(scope="module")
def reduced():
    return simulate(NAMES)


def arrays_of(waveforms):
    return [leaf for leaf in jax.tree.leaves(waveforms) if isinstance(leaf, np.ndarray)]


def test_kept_arrays_are_the_same_and_memory_falls(complete, reduced):
    assert all(same(getattr(reduced, name), getattr(complete, name)) for name in NAMES)
    bytes_of_samples = complete.reflectance.nbytes
    # Of each of the three: the waveform and its standard error, and two energy budgets of 4 bytes a number.
    budgets = 2 * len(complete) * 4 * len(complete.energy_budget)
    fewer = sum(a.nbytes for a in arrays_of(complete)) - sum(a.nbytes for a in arrays_of(reduced))
    assert fewer == 2 * bytes_of_samples + budgets


def test_the_text_says_what_was_not_kept(complete, reduced):
    expected = "  not kept (keep=): reflectance, stderr, energy_budget, energy_budget_stderr"
    assert str(reduced).splitlines()[1] == expected
    assert "not kept" not in str(complete)
    assert str(reduced.stderr) == "stderr was not kept"
    assert "NotKept" in repr(reduced)


@pytest.mark.parametrize(
    "use",
    [
        lambda waves: waves.stderr.sum(),
        lambda waves: waves.stderr[0],
        lambda waves: np.asarray(waves.stderr),
        lambda waves: 2.0 * waves.stderr,
        lambda waves: waves.stderr / 2.0,
        lambda waves: np.ones(3) * waves.stderr,
        lambda waves: len(waves.stderr),
        lambda waves: list(waves.stderr),
        lambda waves: waves.returns(),
        lambda waves: waves.to_las("never.las"),
        lambda waves: pickle.loads(pickle.dumps(waves)).returns(),
    ],
)
def test_an_array_that_was_not_kept_is_refused_by_name(reduced, use):
    with pytest.raises(ValueError, match=f"^{NEEDS_STDERR.replace('(', '.')}$"):
        use(reduced)


def test_functions_that_need_other_arrays_work_and_those_that_need_it_refuse(complete, reduced):
    returns, of_complete = (waves.returns(noise=1e-18) for waves in (reduced, complete))
    assert same(returns.position, of_complete.position)
    assert set(returns.material) == {"ground"}
    with pytest.raises(ValueError, match="reflectance was not kept"):
        reduced[0]
    with pytest.raises(ValueError, match="reflectance was not kept"):
        print(reduced.first_order_share)
    without_energy = eqx.tree_at(lambda waves: waves.energy, reduced, NotKept("energy"))
    for record in (jl.record, jl.PhotonCounter().count):
        with pytest.raises(ValueError, match="energy was not kept"):
            record(without_energy, key=KEY)
    assert "stderr" not in reduced.to_xarray()
    assert same(reduced.to_xarray()["recorded"].values, complete.recorded)


def test_files_have_the_kept_arrays_alone(tmp_path, reduced):
    path = tmp_path / "strip.zarr"
    written = simulate(NAMES[::-1], path=path)
    assert same(written, reduced)
    assert same(jl.open(path), reduced)
    assert same(jl.rerun(path), reduced)
    for name in ("copy.nc", "copy.zarr"):
        written.save(tmp_path / name)
        assert same(jl.open(tmp_path / name), reduced)
    # The order of names, and one that is named twice, make no other problem.
    assert same(simulate([*NAMES, "energy"], path=path), reduced)
    for names in (None, NAMES[1:]):
        with pytest.raises(ValueError, match="another problem, which differs in keep; nothing is overw"):
            simulate(names, path=path)


def test_an_interrupted_run_continues_with_the_same_arrays_alone(tmp_path, reduced):
    def interrupt(progress):
        raise KeyboardInterrupt

    path = tmp_path / "strip.zarr"
    with pytest.raises(KeyboardInterrupt):
        simulate(NAMES, path=path, progress=interrupt)
    assert stored_shots(path)
    with pytest.raises(ValueError, match="another problem, which differs in keep"):
        simulate(("recorded",), path=path)
    assert same(simulate(NAMES, path=path), reduced)


@pytest.mark.slow
def test_all_names_are_the_default(tmp_path, complete):
    path = tmp_path / "strip.zarr"
    simulate(None, path=path)
    assert same(simulate(set(OPTIONAL_ARRAYS), path=path), complete)


def test_a_case_file_names_the_arrays(tmp_path):
    case = jl.io.Case(survey=SURVEY, scene=SCENE, key=KEY, arguments={"keep": NAMES})
    jl.io.write_case(tmp_path / "strip.toml", case)
    assert 'keep = ["recorded", "energy", "components"]' in (tmp_path / "strip.toml").read_text()
    assert jl.io.read_case(tmp_path / "strip.toml").arguments["keep"] == NAMES


@pytest.mark.parametrize(
    ("names", "error", "message"),
    [
        ("recorded", TypeError, r"keep is a str; admissible is a tuple of names, as in keep=\('refl"),
        (3, TypeError, "keep"),
        (("record",), ValueError, "keep = 'record' is none of 'reflectance', 'stderr', 'energy', 'recorded'"),
        ((3,), TypeError, "keep"),
    ],
)
def test_other_names_are_refused(names, error, message):
    with pytest.raises(error, match=message):
        simulate(names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("survey", "options"),
    [
        (scan(9), {"max_orders": 1}),
        (nadir(9, divergence=0.01), {"max_orders": 1, "shared": False}),
        (nadir(9), {"max_orders": 2, "shared": True}),
        (nadir(9), {"max_orders": 2, "shared": False, "truth": True}),
    ],
)
def test_every_strategy_keeps_the_same_arrays(survey, options):
    complete, reduced = (
        jl.simulate_many(survey, stand(), key=KEY, rtol=0.3, keep=names, **options) for names in (None, NAMES)
    )
    # Another program may round otherwise.
    for name in (*NAMES, "error", "neglected", "truth"):
        pairs = zip(
            jax.tree.leaves(getattr(reduced, name)), jax.tree.leaves(getattr(complete, name)), strict=True
        )
        assert all(np.allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(b).max()) for a, b in pairs)
    with pytest.raises(ValueError, match="reflectance was not kept"):
        reduced.reflectance.sum()
