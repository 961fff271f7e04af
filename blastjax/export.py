"""Pieces for other programs: a mesh per actor, and a scene in MuJoCo's own format.

Every function takes an `Asset` (its chunks are boxes) or a `Destructible`, and a state
of it, or none for the unbroken whole. Host only; mesh files need the extra `geometry`.
"""

import importlib
import os
import pathlib
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from blastjax import chunks as query
from blastjax import fracture
from blastjax.author import affine, levels, meshes_of
from blastjax.author.assembly import Whole, asset_of
from blastjax.author.mesh import Destructible, Mesh
from blastjax.core import Asset, State

FORMATS = (".glb", ".gltf", ".obj", ".stl")

# A right-handed frame whose second axis is up, as glTF wants it.
_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def pieces(whole: Whole, state: State | None = None) -> dict[int, Mesh]:
    """Return the mesh of each actor: its visible chunks, in the rest frame.

    Args:
      whole: an asset, with or without meshes.
      state: of it, not batched; None for the unbroken whole.

    Returns:
      By label, ascending. An actor without a chunk, the world alone, has no mesh.
    """
    asset = asset_of(whole)
    state = _state(whole, state)
    owner = np.asarray(query.owner(asset, state))
    seen = np.asarray(query.visible(asset, state))
    meshes = meshes_of(whole)
    found = {}
    for label in np.unique(owner[seen]).tolist():
        members = np.flatnonzero(seen & (owner == label))
        found[label] = levels.join([meshes[i] for i in members])
    return found


def save_pieces(
    path: str | os.PathLike[str],
    whole: Whole,
    state: State | None = None,
    *,
    poses: Any = None,
) -> list[pathlib.Path]:
    """Write a mesh for each actor, named `actor<label>`.

    Args:
      path: of the file; its ending says which format: ".glb" and ".gltf" hold one node
        an actor, y up as the format wants; ".obj" one object an actor; ".stl" knows no
        objects, so each actor gets a file of its own, `<stem>_actor<label>.stl`.
      whole: an asset, with or without meshes.
      state: of it, not batched; None for the unbroken whole.
      poses: of the elements in a world, what `rigid.bodies.chunk_poses` returns:
        (A, 3) m and (A, 4), w first; None leaves all in the rest frame.

    Returns:
      The files written.

    Raises:
      ValueError: the ending is unknown, or poses have another shape.
      ImportError: trimesh is missing; it is in the extra `geometry`.
    """
    target = pathlib.Path(path)
    kind = target.suffix.lower()
    if kind not in FORMATS:
        raise ValueError(f"{target.name!r} must end in one of {', '.join(FORMATS)}")
    trimesh = _trimesh()
    place = _poses(asset_of(whole), poses)
    scene, written = trimesh.Scene(), []
    for label, mesh in pieces(whole, state).items():
        name = f"actor{label}"
        shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        shape.apply_transform(place[label])
        if kind == ".stl":
            part = target.with_name(f"{target.stem}_{name}.stl")
            part.write_bytes(shape.export(file_type="stl"))
            written.append(part)
        else:
            turn = _Y_UP if kind != ".obj" else np.eye(4)
            scene.add_geometry(shape, name, name, transform=turn)
    if kind == ".stl":
        return written
    if kind == ".gltf":
        # Buffers within: one file, and none of another export's is overwritten.
        data = scene.export(file_type="gltf", embed_buffers=True)["model.gltf"]
    else:
        data = scene.export(file_type=kind[1:])
    target.write_bytes(data if isinstance(data, bytes) else data.encode())
    return [target]


def save_mjcf(
    folder: str | os.PathLike[str],
    whole: Whole,
    state: State | None = None,
    *,
    poses: Any = None,
    density: Any = 1000.0,
    friction: float = 1.0,
    floor: bool = True,
) -> pathlib.Path:
    """Write a scene for MuJoCo: `scene.xml` and the meshes that it names.

    One body an actor, named `actor<label>`, with one geom for each of its chunks and
    the exact mass, centre and inertia of them. An actor that the world holds stands
    still; the others are free. Nothing in the scene breaks any more.

    Args:
      folder: made if it does not exist.
      whole: an asset, whose chunks are boxes; or with meshes, of which MuJoCo takes the
        convex hull in collisions.
      state: of it, not batched; None for the unbroken whole.
      poses: see `save_pieces`.
      density: kg/m^3, one for all or (C,).
      friction: sliding friction of the chunks.
      floor: add a plane at z = 0, and a light.

    Returns:
      The path of `scene.xml`.

    Raises:
      ValueError: poses have another shape.
      ImportError: there are meshes, but not trimesh; it is in the extra `geometry`.
    """
    target = pathlib.Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    asset, state = asset_of(whole), _state(whole, state)
    place = _poses(asset, poses)
    root = ET.Element("mujoco", model="pieces")
    ET.SubElement(root, "compiler", meshdir="meshes", angle="radian")
    assets, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    if floor:
        ET.SubElement(world, "light", pos="0 0 10", dir="0 0 -1", directional="true")
        ET.SubElement(world, "geom", name="floor", type="plane", size="0 0 .05")
    moments = query.moments(asset, state, density)
    held = np.asarray(query.held(asset, state))
    owner, chunk = np.asarray(state.actor), np.asarray(asset.element_chunk)
    for label in np.flatnonzero(np.asarray(query.active(asset, state))).tolist():
        body = ET.SubElement(world, "body", name=f"actor{label}")
        body.set("pos", _text(place[label, :3, 3]))
        # Two of its axes say all of a rotation.
        body.set("xyaxes", _text(place[label, :3, :2].T.reshape(-1)))
        if not held[label]:
            ET.SubElement(body, "freejoint", name=f"actor{label}")
        _inertial(body, moments, label)
        for part in chunk[(owner == label) & (chunk >= 0)].tolist():
            _geom(body, assets, target, whole, part, friction)
    ET.indent(root)
    path = target / "scene.xml"
    path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return path


def _inertial(body: ET.Element, moments: Any, label: int) -> None:
    tensor = np.asarray(moments.inertia[label], float)
    order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    ET.SubElement(
        body,
        "inertial",
        pos=_text(np.asarray(moments.center[label], float)),
        mass=_text(np.asarray([moments.mass[label]], float)),
        fullinertia=_text(np.array([tensor[i] for i in order])),
    )


def _geom(
    body: ET.Element,
    assets: ET.Element,
    folder: pathlib.Path,
    whole: Whole,
    chunk: int,
    friction: float,
) -> None:
    name = f"chunk{chunk}"
    geom = ET.SubElement(body, "geom", name=name, friction=f"{friction:.9g} .005 .0001")
    if not isinstance(whole, Destructible):
        geom.set("type", "box")
        geom.set("pos", _text(np.asarray(whole.chunk_centroid[chunk], float)))
        geom.set("size", _text(np.asarray(whole.chunk_size[chunk], float)))
        return
    mesh = whole.meshes[chunk]
    file = folder / "meshes" / f"{name}.stl"
    file.parent.mkdir(exist_ok=True)
    shape = _trimesh().Trimesh(mesh.vertices, mesh.faces, process=False)
    file.write_bytes(shape.export(file_type="stl"))
    ET.SubElement(assets, "mesh", name=name, file=file.name)
    geom.set("type", "mesh")
    geom.set("mesh", name)


def _text(values: np.ndarray) -> str:
    return " ".join(f"{v:.9g}" for v in values.tolist())


def _state(whole: Whole, state: State | None) -> State:
    return fracture.init(asset_of(whole)) if state is None else state


def _poses(asset: Asset, poses: Any) -> np.ndarray:
    """Return the pose of each actor's rest frame by label, (A, 4, 4)."""
    number = len(asset.element_chunk)
    if poses is None:
        return np.tile(np.eye(4), (number, 1, 1))
    position, turn = (np.asarray(x, float) for x in poses)
    if position.shape != (number, 3) or turn.shape != (number, 4):
        raise ValueError(
            f"poses have shapes {position.shape} and {turn.shape}; give ({number}, 3) "
            f"and ({number}, 4), one for each element"
        )
    # An actor bears the name of one of its elements, and moves as that does.
    rest = np.asarray(query.element_values(asset, asset.chunk_centroid), float)
    frames = np.stack([affine.placed(quaternion=q) for q in turn])
    frames[:, :3, 3] = position - np.einsum("aij,aj->ai", frames[:, :3, :3], rest)
    return frames


def _trimesh() -> Any:
    try:
        return importlib.import_module("trimesh")
    except ImportError as error:
        raise ImportError(
            "mesh files need trimesh: pip install 'blastjax[geometry]'"
        ) from error
