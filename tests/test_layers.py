"""Which module may import which, and what importing the package costs."""

import ast
import os
import pathlib
import subprocess
import sys

import pytest

from tests.conftest import CORES

PACKAGE = pathlib.Path(__file__).parent.parent / "blastjax"

# A module imports only from a lower floor, or from a sister in its own folder.
FLOOR = {
    "pytree": 0,
    "core": 1,
    "spatial": 1,
    "lanes": 0,
    "tiles": 0,
    "bottlenecks": 1,
    "graph": 2,
    "author": 3,
    "sums": 3,
    "chunks": 4,
    "consistency": 5,
    "damage": 5,
    "export": 7,
    "fracture": 6,
    "serialize": 6,
    "stress": 7,
    "soft": 7,
    "rigid": 10,
    "world": 11,
    "envs": 13,
    "render": 12,
    "pictures": 12,
    "wrappers": 14,
    "commands": 15,
    "__main__": 16,
    "__init__": 20,
}
PHYSICS = {"mujoco", "brax", "gymnasium"}
PHYSICS_FLOOR = 10


def imports(path):
    """Yield the modules that a file imports, in full."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


def room(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE))
)
def test_imports_lead_down(path):
    here = room(path)
    for name in imports(path):
        parts = name.split(".")
        if parts[0] in PHYSICS:
            assert FLOOR[here] >= PHYSICS_FLOOR, f"{path} imports {name}"
        if parts[0] == "blastjax" and len(parts) > 1 and parts[1] in FLOOR:
            there = parts[1]
            assert there == here or FLOOR[there] < FLOOR[here], f"{path}: {name}"


def test_every_room_has_a_floor():
    rooms = {room(path) for path in PACKAGE.rglob("*.py")}
    assert rooms <= set(FLOOR), rooms - set(FLOOR)


def test_import_is_lean():
    code = """
import sys, jax
before = set(sys.modules)
import blastjax
new = {name.split('.')[0] for name in set(sys.modules) - before}
print(*sorted(new - set(sys.stdlib_module_names)))
"""
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["blastjax"]


def test_import_leaves_settings_alone():
    code = """
import os, jax, numpy
import brax.envs, gymnasium, mujoco.mjx
options = numpy.get_printoptions(), dict(jax.config.values), dict(os.environ)
import blastjax, blastjax.world, blastjax.wrappers
now = jax.config.values
changed = {k for k, v in options[1].items() if now[k] != v}
assert not changed, f'{changed} changed in jax.config'
assert numpy.get_printoptions() == options[0], 'print options changed'
assert dict(os.environ) == options[2], 'environment changed'
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.skipif(CORES is None, reason="this system has no such call")
def test_tests_leave_every_core_to_the_others():
    """A benchmark that keeps to one core must not do so when it is only imported."""
    assert os.sched_getaffinity(0) == CORES
