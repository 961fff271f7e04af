"""Settings and fixtures of all tests."""

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


@pytest.fixture
def strict():
    """Refuse implicit promotion of dtypes and ranks, as a careful user's setup does.

    For tests that do not enter MJX or Brax, which rely on promotion themselves.
    """
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield
