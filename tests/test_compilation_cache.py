"""The cache of compiled programs: programs are stored and read again, and JAX's settings come back."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxlidar as jl
from jaxlidar import _compilation_cache


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
