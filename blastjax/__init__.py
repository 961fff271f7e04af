"""Differentiable, vmappable fracture for JAX.

Importing this loads jax and numpy only. The rooms that need MuJoCo, Brax or gymnasium
(`rigid`, `world`, `envs`, `render`, `wrappers`) load when they are first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from blastjax import (
    author,
    chunks,
    core,
    damage,
    export,
    fracture,
    graph,
    serialize,
    soft,
    spatial,
    stress,
    tiles,
)
from blastjax.core import Asset, Damage, State

if TYPE_CHECKING:
    from blastjax import envs, render, rigid, world, wrappers

__version__ = "0.1.0"

__all__ = [
    "Asset",
    "Damage",
    "State",
    "author",
    "chunks",
    "core",
    "damage",
    "envs",
    "export",
    "fracture",
    "graph",
    "render",
    "rigid",
    "serialize",
    "soft",
    "spatial",
    "stress",
    "tiles",
    "world",
    "wrappers",
]

_LAZY = {"envs", "render", "rigid", "world", "wrappers"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return importlib.import_module(f"blastjax.{name}")
    raise AttributeError(f"module 'blastjax' has no attribute {name!r}")
