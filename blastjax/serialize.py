"""Files of assets, of their meshes and of states.

A file is a plain .npz: `numpy.load` opens it without pickle. Each field of an `Asset`
and of a `State` is one array, `asset.<field>` or `state.<field>`, but for the asset's
sweep, which follows from its bonds and is found anew; each field of the chunks' meshes
is one array of all their rows, `mesh.<field>`, and one of how many rows each mesh has,
`mesh.<field>.rows`. A field that is None is left out. `header` is JSON: the format, its
version, and the SHA-256 of everything else.

Members are stored, not compressed: a file cannot ask for more memory than it has bytes.
The checksum finds damage; what a file says is checked besides, for a checksum is no
proof of good sense.
"""

import dataclasses
import hashlib
import io
import json
import os
import pathlib
import typing
import uuid
import zipfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax.author.asset import with_sweep
from blastjax.author.mesh import Destructible, Mesh
from blastjax.consistency import refuse_asset, refuse_meshes, refuse_state
from blastjax.core import NONE, Asset, State

FORMAT = "blastjax"
VERSION = 1
MAX_BYTES = 2**31
"""Files above this size are refused unless told otherwise."""

_HEADER = "header"
_TIME = (1980, 1, 1, 0, 0, 0)
_DERIVED = ("sweep",)
"""Fields of an asset that are no part of a file: they follow from the others."""
_PARTS: dict[str, type] = {"asset": Asset, "state": State, "mesh": Mesh}


@dataclasses.dataclass(frozen=True)
class Saved:
    """What a file holds; None for what it does not."""

    asset: Asset | None
    """The asset."""
    meshes: tuple[Mesh, ...] | None
    """The mesh of each of its chunks."""
    state: State | None
    """A state, of that asset if there is one."""

    @property
    def destructible(self) -> Destructible:
        """Return the asset with its meshes.

        Raises:
          ValueError: the file has no asset, or no meshes.
        """
        if self.asset is None or self.meshes is None:
            missing = "asset" if self.asset is None else "meshes"
            raise ValueError(f"the file has no {missing}; save a Destructible")
        return Destructible(self.asset, self.meshes)


def save(
    path: str | os.PathLike[str],
    what: Asset | Destructible | State,
    state: State | None = None,
) -> pathlib.Path:
    """Write an asset, with or without meshes, a state, or an asset and its state.

    The same content gives the same bytes. The file appears whole or not at all.

    Args:
      path: of the file.
      what: one of them, concrete and not batched.
      state: of the asset given first.

    Returns:
      The path.

    Raises:
      ValueError: what is to be saved is inconsistent, traced or batched.
    """
    saved = _sorted_out(what, state)
    _refuse(saved)
    members: dict[str, bytes] = {}
    for name in ("asset", "state"):
        part = getattr(saved, name)
        if part is not None:
            members |= _fields(name, part)
    if saved.meshes is not None:
        members |= _mesh_fields(saved.meshes)
    header = {"format": FORMAT, "version": VERSION, "sha256": _checksum(members)}
    members[_HEADER] = _npy(np.array(json.dumps(header).encode()))
    target = pathlib.Path(path)
    # Never seen half-written: another name in the same folder, then a rename.
    draft = target.with_name(f".{target.name}.{uuid.uuid4().hex}")
    try:
        with open(draft, "xb") as file:
            file.write(_zip(members))
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, target)
    finally:
        draft.unlink(missing_ok=True)
    return target


def load(path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> Saved:
    """Read what `save` wrote.

    Arrays have the file's types as far as JAX allows them: float64 becomes float32
    where x64 is off. Nothing in a file is executed.

    Args:
      path: of the file.
      max_bytes: largest file to read.

    Returns:
      What the file holds.

    Raises:
      ValueError: the file is none of these, damaged, of a newer format, or describes
        something impossible; the message names what.
      OSError: it cannot be read.
    """
    size = os.stat(path).st_size
    if size > max_bytes:
        raise ValueError(
            f"{os.fspath(path)!r} has {size} bytes; raise max_bytes, now {max_bytes}, "
            "to read it"
        )
    data = pathlib.Path(path).read_bytes()
    try:
        members = _unzip(data)
        _check_header(members)
        saved = _rebuilt({name: _array(name, raw) for name, raw in members.items()})
        _refuse(saved)
        if saved.asset is not None:
            saved = dataclasses.replace(saved, asset=with_sweep(saved.asset))
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)!r}: {error}") from error
    return saved


def _sorted_out(what: Any, state: State | None) -> Saved:
    if isinstance(what, State):
        if state is not None:
            raise ValueError("two states; save one, with its asset first or alone")
        return Saved(None, None, what)
    if isinstance(what, Destructible):
        return Saved(what.asset, tuple(what.meshes), state)
    if isinstance(what, Asset):
        return Saved(what, None, state)
    raise ValueError(f"cannot save {type(what).__name__}; give Asset, State, ...")


def _refuse(saved: Saved) -> None:
    if saved.asset is not None:
        refuse_asset(saved.asset)
    if saved.meshes is not None:
        chunks = None if saved.asset is None else len(saved.asset.chunk_parent)
        refuse_meshes(saved.meshes, chunks)
    if saved.state is not None:
        refuse_state(saved.state, saved.asset)


def _fields(prefix: str, part: Any) -> dict[str, bytes]:
    values = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    return {
        f"{prefix}.{name}": _npy(np.asarray(value))
        for name, value in values.items()
        if value is not None and name not in _DERIVED
    }


def _mesh_fields(meshes: tuple[Mesh, ...]) -> dict[str, bytes]:
    members = {}
    for field in dataclasses.fields(Mesh):
        values = [getattr(mesh, field.name) for mesh in meshes]
        rows = [NONE if value is None else len(value) for value in values]
        there = [np.asarray(value) for value in values if value is not None]
        members[f"mesh.{field.name}.rows"] = _npy(np.array(rows, np.int64))
        if there:
            members[f"mesh.{field.name}"] = _npy(np.concatenate(there))
    return members


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    array = np.asarray(array, array.dtype.newbyteorder("<"))
    np.lib.format.write_array(buffer, array, version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def _checksum(members: dict[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name in sorted(members):
        if name != _HEADER:
            digest.update(f"{name} {len(members[name])}\n".encode())
            digest.update(members[name])
    return digest.hexdigest()


def _zip(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in sorted(members):
            info = zipfile.ZipInfo(f"{name}.npy", _TIME)
            # Whatever system writes it, the bytes are the same.
            info.create_system, info.external_attr = 3, 0o644 << 16
            archive.writestr(info, members[name])
    return buffer.getvalue()


def _unzip(data: bytes) -> dict[str, bytes]:
    members: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if any(e.compress_type != zipfile.ZIP_STORED for e in entries):
                raise ValueError("it has compressed members; files of ours have none")
            if sum(e.file_size for e in entries) > len(data):
                raise ValueError("its members claim more bytes than the file has")
            for entry in entries:
                name = entry.filename.removesuffix(".npy")
                if name in members:
                    raise ValueError(f"it has two members {name!r}")
                members[name] = archive.read(entry)
    # What a damaged archive makes zipfile raise is documented nowhere.
    except Exception as error:
        raise ValueError(f"no readable file of arrays ({error})") from error
    return members


def _check_header(members: dict[str, bytes]) -> None:
    """Refuse other formats, newer versions and damage, before anything is parsed."""
    if _HEADER not in members:
        raise ValueError("no file of this library: it has no header")
    array = _array(_HEADER, members.pop(_HEADER), kinds="S")
    try:
        header = json.loads(array.item()) if array.ndim == 0 else None
    except (ValueError, RecursionError) as error:
        raise ValueError("its header is damaged") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError("no file of this library: its header names another format")
    if header.get("version") != VERSION:
        raise ValueError(
            f"it has version {header.get('version')!r} of the format, this library "
            f"reads {VERSION}: update the library"
        )
    if header.get("sha256") != _checksum(members):
        raise ValueError("damaged: its content does not match its checksum")


def _array(name: str, raw: bytes, kinds: str = "biuf") -> np.ndarray:
    """Return the array of a .npy, whose header alone never decides what is made."""
    buffer = io.BytesIO(raw)
    try:
        version = np.lib.format.read_magic(buffer)
        if version != (1, 0):
            raise ValueError(f"version {version} of .npy")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(buffer)
    # A header is parsed as a Python literal, which can fail in many ways.
    except Exception as error:
        raise ValueError(f"member {name!r} is no array ({error})") from error
    body = raw[buffer.tell() :]
    count = 1
    for length in shape:
        count *= length
    if dtype.kind not in kinds or fortran or min(shape, default=0) < 0:
        raise ValueError(f"member {name!r} has a type {dtype} or layout not of ours")
    if count * dtype.itemsize != len(body):
        raise ValueError(
            f"member {name!r} claims shape {shape}, its {len(body)} bytes are another"
        )
    native = dtype.newbyteorder("=")
    return np.frombuffer(body, dtype).reshape(shape).astype(native)


def _rebuilt(arrays: dict[str, np.ndarray]) -> Saved:
    parts: dict[str, dict[str, np.ndarray]] = {name: {} for name in _PARTS}
    for name, array in arrays.items():
        prefix, _, field = name.partition(".")
        plain = field.removesuffix(".rows") if prefix == "mesh" else field
        known = {f.name for f in dataclasses.fields(_PARTS.get(prefix, Saved))}
        if prefix not in _PARTS or plain not in known or plain in _DERIVED:
            raise ValueError(
                f"it has a field {name!r} that this version of the library does not "
                "know: update the library"
            )
        parts[prefix][field] = array
    if not (parts["asset"] or parts["state"]):
        raise ValueError("it has neither an asset nor a state")
    return Saved(
        asset=_object("asset", Asset, parts["asset"]),
        meshes=_meshes(parts["mesh"]),
        state=_object("state", State, parts["state"]),
    )


def _object(name: str, kind: type, arrays: dict[str, np.ndarray]) -> Any:
    if not arrays:
        return None
    hints, values = typing.get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        if field.name in arrays:
            values[field.name] = _value(name, field, hints, arrays[field.name])
        elif field.default is dataclasses.MISSING:
            raise ValueError(f"it lacks {name}.{field.name}, which this version needs")
    return kind(**values)


def _value(name: str, field: Any, hints: dict[str, Any], array: np.ndarray) -> Any:
    if not field.metadata.get("static"):
        return _on_device(array)
    wanted = hints[field.name]
    # A flag is no number and a number no flag: bool is a subclass of int.
    if array.ndim or type(array.item()) is not wanted:
        raise ValueError(f"{name}.{field.name} must be one {wanted.__name__}")
    return array.item()


def _on_device(array: np.ndarray) -> jax.Array:
    return jnp.asarray(array, jax.dtypes.canonicalize_dtype(array.dtype))


def _meshes(arrays: dict[str, np.ndarray]) -> tuple[Mesh, ...] | None:
    if not arrays:
        return None
    columns = {}
    for field in dataclasses.fields(Mesh):
        rows = arrays.get(f"{field.name}.rows")
        if rows is None:
            if field.default is dataclasses.MISSING:
                raise ValueError(f"it lacks mesh.{field.name}.rows")
            continue
        values = arrays.get(field.name, np.zeros(0))
        columns[field.name] = _cut(f"mesh.{field.name}", values, rows, field)
    if len({len(column) for column in columns.values()}) != 1:
        raise ValueError("its fields mesh.*.rows count different numbers of meshes")
    return tuple(
        Mesh(**dict(zip(columns, row, strict=True)))
        for row in zip(*columns.values(), strict=True)
    )


def _cut(
    name: str, values: np.ndarray, rows: np.ndarray, field: Any
) -> list[np.ndarray | None]:
    """Return the rows of each mesh, None where it has none of this field."""
    optional = field.default is None
    if rows.ndim != 1 or rows.dtype.kind not in "iu" or (rows < NONE).any():
        raise ValueError(f"{name}.rows must count rows")
    if not optional and (rows < 0).any():
        raise ValueError(f"{name} is missing for mesh {int(np.argmax(rows < 0))}")
    count = np.maximum(rows.astype(object), 0)
    if values.ndim == 0 or int(count.sum()) != len(values):
        raise ValueError(f"{name} does not have the rows that {name}.rows counts")
    ends = np.cumsum(count.astype(np.int64))
    starts = ends - count.astype(np.int64)
    return [
        None if row < 0 else values[start:end].copy()
        for row, start, end in zip(rows, starts, ends, strict=True)
    ]
