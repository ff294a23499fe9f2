"""The cache of compiled programs: programs are stored and read again, and JAX's settings come back."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar import _compilation_cache
from jaxlidar._programs import Program


def cached_files(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.endswith("-cache"))


def compile_product(factor):
    """Compile a program that no other test compiles."""
    # An array of NumPy: making one of JAX would compile a program of its own.
    jax.block_until_ready(jax.jit(lambda x: jnp.sin(factor * x))(np.ones(3, np.float32)))


def test_programs_are_stored_and_settings_come_back(tmp_path, monkeypatch):
    monkeypatch.setattr(_compilation_cache, "MIN_COMPILE_TIME", 0.0)
    before = dict(jax.config.values)
    with jl.compilation_cache(tmp_path / "programs") as cache:
        compile_product(1.2345)
        stored = cached_files(cache.folder)
        assert stored
        # The same program, which JAX has forgotten, is read; another one is stored beside it.
        jax.clear_caches()
        compile_product(1.2345)
        assert cached_files(cache.folder) == stored
        compile_product(2.3456)
        assert len(cached_files(cache.folder)) > len(stored)
    assert dict(jax.config.values) == before
    after = cached_files(cache.folder)
    compile_product(3.4567)
    assert cached_files(cache.folder) == after


class Scaled(eqx.Module):
    """A result with a static field."""

    values: jax.Array
    name: str = eqx.field(static=True)


TRACES = []


def cosine(scale, name):
    TRACES.append(name)
    return Scaled(jnp.cos(scale), name)


def cosine_or_sine(scale, name):
    TRACES.append(name)
    return Scaled(jnp.sin(scale), name)


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [False, True])
def test_executables_are_loaded_without_being_traced(tmp_path, ahead, monkeypatch):
    # JAX's own cache takes no part, however long a busy machine compiles.
    monkeypatch.setattr(_compilation_cache, "MIN_COMPILE_TIME", np.inf)

    def run(function, scale, name):
        """Run a program that this process has not compiled yet; return its result, and if it was traced."""
        TRACES.clear()
        program = Program(function)
        if ahead:
            shapes = program.compile_ahead(scale, name)
            assert shapes.values.shape == scale.shape
        result = program(scale, name)
        was_traced = bool(TRACES)
        if ahead and was_traced:
            # A thread stores the executable, after the program can be called.
            time.sleep(0.5)
        # The list is a global that the functions name: its content is part of their digest.
        TRACES.clear()
        return result, was_traced

    scale = np.linspace(0.0, 1.0, 4, dtype=np.float32)
    with jl.compilation_cache(tmp_path):
        first, was_traced = run(cosine, scale, "a")
        assert was_traced
        repeated, was_traced = run(cosine, scale, "a")
        assert not was_traced
        assert repeated.name == "a"
        np.testing.assert_array_equal(first.values, repeated.values)
        # Whatever a program depends on makes another one.
        assert run(cosine, scale, "b")[1]
        assert run(cosine, scale[:3], "a")[1]
        assert run(cosine, scale.astype(np.int32), "a")[1]
        assert run(cosine_or_sine, scale, "a")[1]
        # A damaged file is replaced.
        for path in tmp_path.glob("*.executable"):
            path.write_bytes(b"damaged")
        assert run(cosine, scale, "a")[1]
        assert not run(cosine, scale, "a")[1]
    assert run(cosine, scale, "a")[1]


def test_programs_from_the_cache_of_jax_are_not_stored_as_executables(tmp_path, monkeypatch):
    """XLA writes what it has read without machine code, and such an executable cannot be called."""
    monkeypatch.setattr(_compilation_cache, "MIN_COMPILE_TIME", -1.0)
    scale = np.linspace(0.0, 1.0, 4, dtype=np.float32)
    expected = np.cos(scale)
    with jl.compilation_cache(tmp_path):
        for stored in (True, False, False):
            TRACES.clear()
            np.testing.assert_allclose(Program(cosine)(scale, "a").values, expected, rtol=1e-6)
            assert any(tmp_path.glob("*.executable")) is stored
            # JAX's cache has the program, its executable is lost.
            for path in tmp_path.glob("*.executable"):
                path.unlink()


def test_a_call_switches_the_cache_on_until_it_is_closed(tmp_path):
    cache = jl.compilation_cache(tmp_path)
    assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path)
    # Without a folder, one that is configured already is kept.
    inner = jl.compilation_cache()
    assert inner.folder == tmp_path
    inner.close()
    assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path)
    cache.close()
    cache.close()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_a_folder_of_its_own_is_that_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with jl.compilation_cache() as cache:
        assert "jaxlidar" in cache.folder.parts
        assert cache.folder.is_dir()
