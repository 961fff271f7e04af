"""Frozen dataclasses that JAX can flatten.

A field is a traced leaf unless it is declared with `static()`: static fields decide
shapes or Python control flow and become part of the compilation key.
"""

import dataclasses
from typing import Any, Self, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """Declare a field that belongs to the tree's structure, not to its leaves."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


class Node:
    """Base of every pytree dataclass: adds `replace` and nothing else."""

    def replace(self, **changes: Any) -> Self:
        """Return a copy with the named fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def dataclass(cls: type[T]) -> type[T]:
    """Make a frozen dataclass and register it as a pytree."""
    frozen = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(frozen)  # type: ignore[arg-type]
    meta = [f.name for f in fields if f.metadata.get("static")]
    data = [f.name for f in fields if not f.metadata.get("static")]
    return jax.tree_util.register_dataclass(frozen, data, meta)
