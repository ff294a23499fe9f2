"""Old public names still work for one version, and warn of the new ones."""

import pytest

import jaxlidar as jl


def test_old_name_gives_the_new_object_and_warns():
    with pytest.warns(DeprecationWarning, match=r"jaxlidar\.repeat is renamed to jaxlidar\.rerun"):
        assert jl.repeat is jl.rerun


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'repetition'"):
        _ = jl.repetition
