"""Pictures of destructibles at rest: exploded, their support graph, their levels.

Drawn by a depth buffer of our own and matplotlib, so that no OpenGL is needed.
"""

import colorsys
import importlib
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author.descriptions import depths
from blastjax.author.mesh import Destructible, Mesh
from blastjax.core import WORLD

EXTRA = "pip install 'blastjax[cli]'"
SMOOTHING = 2
"""Pixels drawn along each side of a pixel of the picture."""
BATCH = 1_000_000
"""Pixels of triangles' boxes that are looked at together."""
_LIGHT = np.array([-0.35, 0.55, 0.76])


def exploded(
    what: Destructible,
    path: str | os.PathLike[str],
    *,
    spread: float = 0.35,
    chunks: Any = None,
    width: int = 640,
    height: int = 480,
    azimuth: float = 55.0,
    elevation: float = -22.0,
) -> pathlib.Path:
    """Draw chunks moved apart, faces that cuts made in a darker tone.

    Args:
      what: an asset and its meshes.
      path: of a .png.
      spread: how far chunks move away from the middle, in parts of their distance.
      chunks: which to draw; None draws the support chunks.
      width: of the picture, pixels.
      height: of the picture, pixels.
      azimuth: where the camera looks, degrees from x towards y.
      elevation: how far above the horizon it looks, degrees; negative is down.

    Raises:
      ValueError: the path is no .png.
      ImportError: matplotlib is missing.
    """
    target = _target(path)
    chosen = _support(what) if chunks is None else np.atleast_1d(chunks)
    paint = _hues(len(what.meshes))
    view = _axes(azimuth, elevation)
    picture = _drawn(what, chosen, paint, spread, view, (width, height))
    figure = _figure(width, height)
    _panel(figure, (0, 0, 1, 1), picture)
    figure.savefig(target)
    return target


def levels(
    what: Destructible,
    path: str | os.PathLike[str],
    *,
    spread: float = 0.35,
    width: int = 960,
    height: int = 360,
    azimuth: float = 55.0,
    elevation: float = -22.0,
) -> pathlib.Path:
    """Draw each level of the hierarchy beside the last, children in a parent's hue.

    A chunk without children appears on all levels below its own. Options as `exploded`.
    """
    target = _target(path)
    parent = np.asarray(what.asset.chunk_parent)
    depth = depths(parent)
    count = int(depth.max(initial=0)) + 1
    support = np.isin(np.arange(len(parent)), _support(what))
    leaf = np.asarray(what.asset.chunk_children) == 0
    view, paint = _axes(azimuth, elevation), _family_hues(parent, depth)
    figure = _figure(width, height)
    for level in range(count):
        chosen = np.flatnonzero((depth == level) | leaf & (depth < level))
        size = (width // count, height - 40)
        picture = _drawn(what, chosen, paint, spread, view, size)
        box = (level / count, 0, 1 / count, 1 - 40 / height)
        plot = _panel(figure, box, picture)
        held = " (support)" if support[chosen].all() else ""
        plot.set_title(f"level {level}: {_count(len(chosen))}{held}", fontsize=10)
    figure.savefig(target)
    return target


def graph(
    what: Destructible,
    path: str | os.PathLike[str],
    *,
    width: int = 720,
    height: int = 480,
    azimuth: float = 55.0,
    elevation: float = -22.0,
) -> pathlib.Path:
    """Draw the support graph: chunks as dots, bonds as lines coloured by their area.

    Bonds to the world end in a square. Options as `exploded`.
    """
    target = _target(path)
    asset = what.asset
    node = np.asarray(asset.element_chunk)[: len(asset.span_node)]
    place = np.asarray(asset.chunk_centroid, float)[node]
    ends = np.asarray(asset.bond_nodes)
    area = np.asarray(asset.bond_area, float)
    middle = np.asarray(asset.bond_centroid, float)
    view = _axes(azimuth, elevation)
    if asset.has_world:
        place = np.where((node == WORLD)[:, None], np.nan, place)
    first, second = place[ends[:, 0]], place[ends[:, 1]]
    grounded = node[ends] == WORLD
    # Through the middle of the shared face, or down to it where the world holds on.
    first = np.where(grounded[:, :1], middle, first)
    second = np.where(grounded[:, 1:], middle, second)
    lines = np.stack([first, middle, second], axis=1) @ view[:, :2]
    order = np.argsort(middle @ view[:, 2])

    figure = _figure(width, height)
    plot = figure.add_axes((0.01, 0.01, 0.82, 0.98))
    plot.set_axis_off()
    plot.set_aspect("equal")
    shown = _need("matplotlib.collections").LineCollection(
        lines[order], cmap="viridis", linewidths=1.2, alpha=0.9
    )
    shown.set_array(area[order])
    plot.add_collection(shown)
    flat = place[node >= 0] @ view
    volume = np.asarray(asset.chunk_volume, float)[node[node >= 0]]
    size = 60 * np.cbrt(volume / max(volume.max(initial=0), 1e-300)) ** 2
    plot.scatter(flat[:, 0], flat[:, 1], s=size, c="#333333", zorder=3, linewidths=0)
    held = middle[grounded.any(axis=1)] @ view
    plot.scatter(
        held[:, 0], held[:, 1], s=22, marker="s", c="#c0392b", zorder=4, linewidths=0
    )
    plot.autoscale_view()
    if len(area):
        figure.colorbar(
            shown,
            cax=figure.add_axes((0.86, 0.15, 0.03, 0.7)),
            label="bond area, m$^2$",
        )
    figure.savefig(target)
    return target


def _target(path: str | os.PathLike[str]) -> pathlib.Path:
    target = pathlib.Path(path)
    if target.suffix.lower() != ".png":
        raise ValueError(f"{os.fspath(path)!r} is one picture; use .png")
    return target


def _need(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"matplotlib is missing; it comes with {EXTRA}") from error


def _figure(width: int, height: int) -> Any:
    figure = _need("matplotlib.figure").Figure(
        figsize=(width / 100, height / 100), dpi=100
    )
    figure.set_facecolor("white")
    return figure


def _panel(figure: Any, box: tuple[float, ...], picture: np.ndarray) -> Any:
    plot = figure.add_axes(box)
    plot.set_axis_off()
    plot.imshow(picture, interpolation="antialiased", aspect="equal")
    return plot


def _count(number: int) -> str:
    return f"{number} chunk" + "s" * (number != 1)


def _support(what: Destructible) -> np.ndarray:
    chunk = np.asarray(what.asset.element_chunk)[: len(what.asset.span_node)]
    return chunk[chunk >= 0]


def _hues(count: int) -> np.ndarray:
    """Return colours that differ from those before them, (count, 3)."""
    turn = np.arange(count) * 0.618033988749895 % 1.0
    return np.array([colorsys.hsv_to_rgb(h, 0.42, 0.92) for h in turn]).reshape(-1, 3)


def _family_hues(parent: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return a colour for each chunk: that of its ancestor, a little different."""
    paint = _hues(len(parent))
    rng = np.random.default_rng(0)
    for i in np.argsort(depth, kind="stable"):
        if depth[i] >= 2:
            paint[i] = np.clip(paint[parent[i]] * rng.uniform(0.8, 1.1), 0, 1)
    return paint


def _axes(azimuth: float, elevation: float) -> np.ndarray:
    """Return right, up and towards the viewer as columns, (3, 3)."""
    turn, lift = np.radians(azimuth), np.radians(elevation)
    ahead = [np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)]
    right = [np.sin(turn), -np.cos(turn), 0.0]
    return np.stack([right, np.cross(right, ahead), -np.array(ahead)], axis=1)


def _drawn(
    what: Destructible,
    chosen: Sequence[int] | np.ndarray,
    paint: np.ndarray,
    spread: float,
    view: np.ndarray,
    size: tuple[int, int],
) -> np.ndarray:
    """Return the picture of chunks moved apart, (height, width, 3) in [0, 1]."""
    center = np.asarray(what.asset.chunk_centroid, float)[chosen]
    volume = np.asarray(what.asset.chunk_volume, float)[chosen]
    middle = volume @ center / max(volume.sum(), 1e-300)
    corners, colors = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    for i, place in zip(chosen, center, strict=True):
        mesh: Mesh = what.meshes[i]
        shift = spread * (place - middle) if len(chosen) > 1 else 0.0
        corners.append((mesh.vertices + shift)[mesh.faces] @ view)
        inside = np.zeros(len(mesh.faces), bool)
        inside = inside if mesh.interior is None else np.asarray(mesh.interior)
        colors.append(np.where(inside[:, None], 0.72 * paint[i], paint[i]))
    return _raster(np.concatenate(corners), np.concatenate(colors), size)


def _raster(
    corners: np.ndarray, colors: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Return triangles (T, 3, 3), seen along -z, as a picture (height, width, 3)."""
    width, height = size[0] * SMOOTHING, size[1] * SMOOTHING
    picture = np.ones((height * width, 3))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    front = normal[:, 2] > 1e-9 * length
    corners, normal, colors = corners[front], normal[front], colors[front]
    if not len(corners):
        return picture.reshape(height, width, 3)[::SMOOTHING, ::SMOOTHING]
    light = normal @ _LIGHT / (length[front] * np.linalg.norm(_LIGHT))
    colors = colors * (0.62 + 0.38 * np.clip(light, 0, 1))[:, None]
    points = corners.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    scale = 0.94 * min(
        width / max(high[0] - low[0], 1e-300), height / max(high[1] - low[1], 1e-300)
    )
    center = np.array([width, height]) / 2
    flat = (corners[..., :2] - (low + high)[:2] / 2) * scale * [1, -1] + center
    first = np.clip(np.floor(flat.min(axis=1)), 0, None).astype(int)
    last = np.ceil(flat.max(axis=1)).astype(int)
    span = np.clip(np.minimum(last, [width, height]) - first, 0, None)
    pixels = span.prod(axis=1)
    depth = np.full(height * width, -np.inf)
    batch = np.cumsum(pixels) // BATCH
    for number in np.unique(batch):
        rows = np.flatnonzero(batch == number)
        triangle = np.repeat(rows, pixels[rows])
        begin = np.repeat(np.cumsum(pixels[rows]) - pixels[rows], pixels[rows])
        inner = np.arange(len(triangle)) - begin
        x = first[triangle, 0] + inner % span[triangle, 0]
        y = first[triangle, 1] + inner // span[triangle, 0]
        weight = _weights(flat[triangle], np.stack([x, y], axis=1) + 0.5)
        hit = (weight >= -1e-9).all(axis=1)
        triangle, place = triangle[hit], (y * width + x)[hit]
        z = np.einsum("pk,pk->p", weight[hit], corners[triangle, :, 2])
        order = np.argsort(z, kind="stable")
        place, z, triangle = place[order], z[order], triangle[order]
        # Of several on one pixel the last written is the nearest.
        nearest = np.full(height * width, -1)
        nearest[place] = np.arange(len(place))
        spot = np.flatnonzero(nearest >= 0)
        best = nearest[spot]
        closer = z[best] > depth[spot]
        spot, best = spot[closer], best[closer]
        depth[spot] = z[best]
        picture[spot] = colors[triangle[best]]
    shape = (size[1], SMOOTHING, size[0], SMOOTHING, 3)
    return np.clip(picture.reshape(shape).mean(axis=(1, 3)), 0, 1)


def _weights(flat: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return barycentric coordinates of points (P, 2) in triangles (P, 3, 2)."""
    a, b, c = np.moveaxis(flat - point[:, None], 1, 0)

    def turn(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]

    weight = np.stack([turn(b, c), turn(c, a), turn(a, b)], axis=1)
    total = weight.sum(axis=1, keepdims=True)
    return weight / np.where(total == 0, 1.0, total)
