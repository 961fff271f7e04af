"""Settings and fixtures of all tests."""

import gc
import importlib.metadata
import os
import pathlib

import jax
import pytest

CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
"""What this process may run on, before any test module is loaded."""
CACHE = pathlib.Path(__file__).parent.parent / ".pytest_cache" / "compiled"

# Compilations are most of the cost of these tests; another run need not repeat them.
jax.config.update("jax_compilation_cache_dir", os.fspath(CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


# A trace makes many objects and keeps them: to look through all of them for garbage,
# again and again, takes a third of the time of tracing a large program.
gc.set_threshold(100_000, 20, 100)


def pytest_collection_finish():
    """Look no more through what was imported, which stays to the end."""
    gc.collect()
    gc.freeze()


def pytest_configure(config):
    """Compile quickly: most tests ask once what a program computes.

    What is slow runs for longer than it compiles, as users would compile it; so does
    everything where XLA_FLAGS is set, to nothing for example.
    """
    if config.option.markexpr != "not slow" or "XLA_FLAGS" in os.environ:
        return
    # XLA reads them when it is first used, which is later than this.
    flags = ["--xla_backend_optimization_level=0"]
    if importlib.metadata.version("jaxlib").startswith("0.10."):
        # A way of compiling that is three times faster, and was removed since.
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join(flags)


@pytest.fixture
def strict():
    """Refuse implicit promotion of dtypes and ranks, as a careful user's setup does.

    For tests that do not enter MJX or Brax, which rely on promotion themselves.
    """
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield
