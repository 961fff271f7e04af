"""Descriptions in Blast's form: dicts or JSON in, `Chunks` and `Bonds` out, and back.

A description is an object with two lists:

    {"chunks": [{"parent": null, "centroid": [0, 0, 0], "volume": 1, "flags": 1}, ...],
     "bonds": [{"chunkIndices": [0, 1], "normal": [1, 0, 0], "area": 1,
                "centroid": [0.5, 0, 0]}, ...]}

`parent` is an index, or null, -1 or 4294967295 for a root; so is the world's place in
`chunkIndices`. `flags` is a number whose lowest bit marks a support chunk. Instead of a
list of rows each may be an object of columns, `{"parent": [...], ...}`. Blast's own
spelling is read too: `parentChunkDescIndex`, and the bond's data in an inner `bond`;
`userData` is passed by.
"""

import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from blastjax.author.descriptions import (
    Bonds,
    Chunks,
    checked_bonds,
    checked_chunks,
    integers,
)
from blastjax.core import NO_PARENT

INVALID = 2**32 - 1
"""Blast's mark for no chunk."""
SUPPORT = 1
"""The flag of a support chunk."""

_SPELLINGS = {"parentChunkDescIndex": "parent"}
_CHUNK = ("parent", "centroid", "volume", "flags")
_BOND = ("chunkIndices", "normal", "area", "centroid")


def read(source: Mapping[str, Any] | str | os.PathLike[str]) -> tuple[Chunks, Bonds]:
    """Return the descriptions; `author.build` takes them.

    To get what Blast makes of them, build with `drop_invalid_bonds=True` and
    `orient_normals=False`.

    Args:
      source: the object itself, or the path of a JSON file that holds it.

    Raises:
      ValueError: it is no such object; the message names the row and the field.
      OSError: the file cannot be read.
    """
    if not isinstance(source, Mapping):
        source = _parsed(source)
    if not isinstance(source, Mapping) or "chunks" not in source:
        raise ValueError("no description: it must be an object with a list 'chunks'")
    chunk = _columns("chunk", source["chunks"], _CHUNK, {"flags"})
    bond = _columns("bond", source.get("bonds", []), _BOND, set())
    flags = chunk["flags"]
    support = None if flags is None else (_indices("flags", flags) & SUPPORT) > 0
    chunks = Chunks(
        _indices("parent", chunk["parent"]),
        chunk["centroid"],
        chunk["volume"],
        support,
    )
    if not bond["chunkIndices"]:
        return checked_chunks(chunks), Bonds.none()
    bonds = Bonds(
        _indices("chunkIndices", bond["chunkIndices"]),
        bond["normal"],
        bond["area"],
        bond["centroid"],
    )
    return checked_chunks(chunks), checked_bonds(bonds)


def write(
    path: str | os.PathLike[str], chunks: Chunks, bonds: Bonds | None = None
) -> pathlib.Path:
    """Write descriptions as a JSON file and return its path.

    Half extents and inertia are not in Blast's form, and are lost.

    Raises:
      ValueError: a description is invalid.
    """
    chunks = checked_chunks(chunks)
    bonds = checked_bonds(Bonds.none() if bonds is None else bonds)
    columns = (chunks.parent, chunks.centroid, chunks.volume, chunks.support)
    data = {
        "chunks": [
            {
                "parent": None if parent == NO_PARENT else int(parent),
                "centroid": centroid.tolist(),
                "volume": float(volume),
                "flags": SUPPORT if support else 0,
            }
            for parent, centroid, volume, support in zip(*columns, strict=True)
        ],
        "bonds": [
            {
                "chunkIndices": [None if c < 0 else int(c) for c in pair],
                "normal": normal.tolist(),
                "area": float(area),
                "centroid": centroid.tolist(),
            }
            for pair, normal, area, centroid in zip(
                bonds.chunks, bonds.normal, bonds.area, bonds.centroid, strict=True
            )
        ],
    }
    target = pathlib.Path(path)
    target.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    return target


def _parsed(path: str | os.PathLike[str]) -> Any:
    try:
        return json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{os.fspath(path)!r} is no JSON: {error}") from error


def _columns(
    kind: str, rows: Any, fields: tuple[str, ...], optional: set[str]
) -> dict[str, Any]:
    """Return each field's values, None for an optional one that no row has."""
    if isinstance(rows, Mapping):
        names = _named(rows)
        _refuse_fields(f"the {kind}s", set(names), fields, optional)
        return {f: _listed(names[f]) if f in names else None for f in fields}
    if not isinstance(rows, (list, tuple)):
        raise ValueError(f"{kind}s must be a list of objects, or an object of lists")
    table: dict[str, Any] = {f: [] for f in fields}
    for i, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise ValueError(f"{kind} {i} is {row!r}; it must be an object")
        inner = row.get("bond", {})
        row = {**{k: v for k, v in row.items() if k != "bond"}, **inner}
        names = _named(row)
        _refuse_fields(f"{kind} {i}", set(names), fields, optional)
        for f in fields:
            if f in names:
                table[f].append(names[f])
    for f in optional:
        if not table[f]:
            table[f] = None
        elif len(table[f]) != len(rows):
            raise ValueError(f"some {kind}s have {f!r} and some not; give all or none")
    return table


def _named(row: Mapping[str, Any]) -> dict[str, Any]:
    return {str(_SPELLINGS.get(name, name)): value for name, value in row.items()}


def _listed(column: Any) -> list[Any]:
    return column.tolist() if isinstance(column, np.ndarray) else list(column)


def _refuse_fields(
    where: str, names: set[str], fields: tuple[str, ...], optional: set[str]
) -> None:
    missing = [f for f in fields if f not in names and f not in optional]
    if missing:
        raise ValueError(f"{where} lacks {missing[0]!r}")
    unknown = sorted(names - set(fields) - {"userData"})
    if unknown:
        raise ValueError(f"{where} has {unknown[0]!r}; known are {', '.join(fields)}")


def _indices(name: str, values: Any) -> np.ndarray:
    """Return integers, with Blast's mark for none as -1."""

    def plain(i: int, value: Any) -> int:
        if value is None or (value == INVALID and name != "flags"):
            return NO_PARENT
        if isinstance(value, bool) and name == "flags":
            return int(value)
        if isinstance(value, bool):
            raise ValueError(f"{name} {i} is {value!r}; it must be an integer")
        return value

    rows = [
        [plain(i, v) for v in row] if isinstance(row, (list, tuple)) else plain(i, row)
        for i, row in enumerate(values)
    ]
    return integers(
        name, np.array(rows, int) if set(map(type, rows)) <= {bool} else rows
    )
