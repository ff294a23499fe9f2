"""Old names of public objects: each warns, names the new one, and is the same object."""

import jax
import pytest

import jaxlidar as jl

NAMES = {"reduce": "make_setup", "repeat": "rerun", "total_of": "total_reflectance"}


@pytest.mark.parametrize("old", NAMES)
def test_an_old_name_warns_and_is_the_new_object(old):
    with pytest.warns(DeprecationWarning, match=rf"jaxlidar\.{old} is now jaxlidar\.{NAMES[old]}") as caught:
        obj = getattr(jl, old)
    assert obj is getattr(jl, NAMES[old])
    # At the user's line.
    assert caught[0].filename == __file__
    assert old not in jl.__all__


@pytest.mark.parametrize("old", ["ledger", "ledger_stderr"])
def test_an_old_attribute_warns(old):
    new = old.replace("ledger", "energy_budget")
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    with pytest.warns(DeprecationWarning, match=rf"Waveform\.{old} is now Waveform\.{new}"):
        assert getattr(wave, old) is getattr(wave, new)


def test_a_name_that_never_was_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'ledgers'"):
        _ = jl.ledgers
