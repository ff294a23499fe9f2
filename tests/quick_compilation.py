"""Options with which the tests compile, where most of their time goes; also for processes that tests start.

Machine code is not optimised, except a little that of the package's own programs: long traces would take
three times as long. Most programs are small: they compile on one thread. In the XLA of JAX 0.10, its newer
and slower generator of kernels is left out.
"""

import os

import jax

FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
if jax.__version__.startswith("0.10."):
    FLAGS += " --xla_cpu_use_fusion_emitters=false"


def set_flags() -> None:
    """Set XLA_FLAGS unless it is set, if only to an empty text. XLA reads it when JAX is first used."""
    os.environ.setdefault("XLA_FLAGS", FLAGS)


def optimise_programs() -> None:
    """Have the package's own programs optimised a little, if XLA_FLAGS has the options of the tests."""
    from jaxlidar._jax.threads import ONE_CORE

    if os.environ.get("XLA_FLAGS") == FLAGS:
        ONE_CORE["compiler_options"]["xla_backend_optimization_level"] = 1
