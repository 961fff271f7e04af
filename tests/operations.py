"""What a program consists of: its operations, counted, and the code they come from."""

import functools
import pathlib
from typing import NamedTuple

import jax
import mujoco.mjx

import blastjax

ROOTS = [pathlib.Path(x.__file__).parent for x in (blastjax, mujoco.mjx)]


class Program(NamedTuple):
    """A traced function."""

    operations: int
    """Equations, those of inner programs included, a call itself not."""
    sources: frozenset[str]
    """The functions that wrote them, such as "fracture.split"; "stress" for a whole
    folder. Only what this library or MJX wrote."""


def trace(function, *arguments):
    """Trace a function, and count before the compiler has removed anything."""
    jaxpr = jax.make_jaxpr(function)(*arguments)
    sources = set()
    return Program(_count(jaxpr.jaxpr, sources, True), frozenset(sources))


def _count(jaxpr, sources, named):
    total = 0
    for equation in jaxpr.eqns:
        if named:
            sources.update(_sources(equation))
        inner = [x for value in equation.params.values() for x in _programs(value)]
        # What a cached inner program says of its source is whoever called it first.
        cached = equation.primitive.name in ("jit", "pjit")
        total += sum(_count(x, sources, named and not cached) for x in inner)
        total += not inner
    return total


def _programs(value):
    """Find the programs in a parameter of an equation."""
    if hasattr(value, "eqns"):
        return [value]
    if hasattr(value, "jaxpr"):
        return _programs(value.jaxpr)
    if isinstance(value, tuple | list):
        return [x for item in value for x in _programs(item)]
    return []


def _sources(equation):
    traceback = equation.source_info.traceback
    for frame in traceback.frames if traceback else ():
        yield from _source(frame.file_name, frame.function_name)


@functools.cache
def _source(file, function):
    path = pathlib.Path(file)
    for root in ROOTS:
        if path.is_relative_to(root):
            room = path.relative_to(root).with_suffix("").parts
            return *room[:-1], f"{room[-1]}.{function.split('.<locals>')[0]}"
    return ()
