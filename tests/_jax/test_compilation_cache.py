"""The cache of compiled programs: programs are stored and read again, and JAX's settings come back."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._jax import compilation_cache


def cached_files(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.endswith("-cache"))


def compile_product(factor):
    """Compile a program that no other test compiles."""
    # An array of NumPy: making one of JAX would compile a program of its own.
    jax.block_until_ready(jax.jit(lambda x: jnp.sin(factor * x))(np.ones(3, np.float32)))


def test_programs_are_stored_and_settings_come_back(tmp_path, monkeypatch):
    monkeypatch.setattr(compilation_cache, "MIN_COMPILE_TIME", 0.0)
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


EDITED_LAW = """
import sys, jax, numpy as np, jaxlidar as jl
import first
with jl.compilation_cache(sys.argv[1]):
    print(float(jax.jit(lambda x: first.scale(x))(np.float32(1.0))))
"""


@pytest.mark.slow
def test_a_function_that_was_edited_two_imports_away_is_compiled_anew(tmp_path):
    """Programs are asked for by what they compute, not by the files of one module."""
    (tmp_path / "first.py").write_text("import second\ndef scale(x): return second.factor() * x\n")
    (tmp_path / "session.py").write_text(EDITED_LAW)
    printed = []
    for factor in (2.0, 2.0, 3.0):
        (tmp_path / "second.py").write_text(f"def factor(): return {factor}\n")
        command = [sys.executable, "-B", "session.py", str(tmp_path / "programs")]
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        printed.append(float(run.stdout))
    assert printed == [2.0, 2.0, 3.0]


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
