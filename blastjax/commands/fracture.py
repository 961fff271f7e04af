"""`python -m blastjax fracture`: cut a mesh into an asset file."""

import argparse
import math
import os
import pathlib
import time
from typing import Any

import numpy as np

from blastjax.author import bonds, cut
from blastjax.author.cut import geometry
from blastjax.author.descriptions import Bonds
from blastjax.commands.options import number, progress, whole
from blastjax.core import WORLD

HELP = (
    "Cut a closed mesh into chunks that break apart along their bonds, and write them "
    "to a file for `python -m blastjax --asset FILE`."
)
FOOT = 0.02
"""Part of the height that the world holds where no face lies flat on the ground."""
_UP = {
    "x": np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "z": np.eye(3, dtype=int),
}
"""Turns each axis upright, for rows of vertices."""


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("mesh", help="file of a closed mesh: .stl, .obj, .ply, .glb, .off, ...")
    add("--out", default="asset.npz", help="asset file to write")
    add("--picture", help="exploded view to write, .png; 'none' for none (default: "
        "beside the asset file)")  # fmt: skip
    add("--scale", type=number(), default=1.0, help="from the file's unit to metres")
    add("--up", choices=tuple(_UP), default="z", help="the file's upward axis")
    add("--no-repair", action="store_true", help="refuse meshes that need repair")
    group = parser.add_argument_group("pattern")
    add = group.add_argument
    add(
        "--pattern",
        choices=("voronoi", "clustered", "radial", "slices", "bricks", "cutout"),
        default="voronoi",
        help="how to cut",
    )
    add("--sites", type=whole(2), default=64, help="Voronoi cells")
    add("--clusters", type=whole(1), default=4, help="groups of clustered sites")
    add("--spread", type=number(), default=0.1, help="of a cluster, in diagonals")
    add("--spokes", type=whole(3), default=8, help="radial sites on a ring; the rings "
        "follow from --sites")  # fmt: skip
    add("--stretch", type=number(), nargs=3, metavar=("X", "Y", "Z"),
        help="lengthens Voronoi cells by these factors")  # fmt: skip
    add("--slices", type=whole(1), nargs=3, metavar=("X", "Y", "Z"), default=(3, 3, 3),
        help="slices along each axis")  # fmt: skip
    add("--offset", type=number(-1e-9, 1.0), default=0.0, help="variation of slices, "
        "0 to 1")  # fmt: skip
    add("--angle", type=number(-1e-9, 80.0), default=0.0, help="largest tilt of slices,"
        " degrees")  # fmt: skip
    add("--brick", type=number(), nargs=3, metavar=("X", "Y", "Z"),
        default=(0.4, 0.2, 0.2), help="extent of a brick, m")  # fmt: skip
    add("--bitmap", help="picture whose dark and light regions `cutout` cuts, seen "
        "along y")  # fmt: skip
    add("--noise", type=number(), nargs=2, metavar=("HEIGHT", "LENGTH"),
        help="roughness of the cuts, and its wavelength, m")  # fmt: skip
    add("--seed", type=whole(0), default=0, help="of all random choices")
    group = parser.add_argument_group("hierarchy and bonds")
    add = group.add_argument
    add("--then", type=whole(2), action="append", default=[], metavar="SITES",
        help="cut every chunk again into so many cells; may be repeated")  # fmt: skip
    add("--support-level", type=whole(0), help="cuts above the support chunks "
        "(default: the deepest)")  # fmt: skip
    add("--hold", choices=("bottom", "none"), default="bottom", help="what the world "
        "holds: faces in the lowest plane, or nothing")  # fmt: skip


def run(args: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Run the command and return the exit code."""
    _check(args, parser)
    picture = _picture(args, parser)
    started = time.perf_counter()
    bar = progress()(total=4 + bool(picture), unit="step", desc="reading")
    with bar:
        try:
            solid = _read(args)
            bar.update()
            bar.set_description("cutting")
            tree = _cut(args, solid)
            bar.update()
            bar.set_description("bonding")
            world, warnings = _world(args, tree)
            result = cut.destructible(
                tree, support_level=args.support_level, world=world
            )
        except ValueError as error:
            bar.close()
            parser.error(str(error))
        bar.update()
        bar.set_description("writing")
        from blastjax import serialize

        serialize.save(args.out, result.destructible)
        bar.update()
        if picture:
            from blastjax import pictures

            bar.set_description("drawing")
            pictures.exploded(result.destructible, picture)
            bar.update()
    print(_table(tree, result))
    for warning in (*result.warnings, *warnings):
        print(f"warning: {warning}")
    size = os.path.getsize(args.out) / 1e6
    took = time.perf_counter() - started
    shown = f" and {picture}" if picture else ""
    print(f"wrote {args.out} ({size:.1f} MB){shown}; {took:.1f} s in all")
    return 0


def _check(args: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    target = pathlib.Path(args.out)
    if target.suffix != ".npz":
        parser.error(f"argument --out: {args.out!r} is an asset file; use .npz")
    if not target.parent.is_dir():
        parser.error(f"argument --out: {os.fspath(target.parent)!r} is not a folder")
    if args.pattern == "cutout" and not args.bitmap:
        parser.error("argument --bitmap: the pattern cutout needs one")
    if not os.path.isfile(args.mesh):
        parser.error(f"argument mesh: there is no file {args.mesh!r}")


def _picture(
    args: argparse.Namespace, parser: argparse.ArgumentParser
) -> pathlib.Path | None:
    if args.picture == "none":
        return None
    path = pathlib.Path(args.picture or args.out)
    path = path if args.picture else path.with_suffix(".png")
    if path.suffix.lower() != ".png" or not path.parent.is_dir():
        parser.error(f"argument --picture: {args.picture!r} is no .png in a folder")
    return path


def _read(args: argparse.Namespace) -> cut.Tree:
    mesh: Any = args.mesh
    if args.up != "z":
        mesh = geometry.need("trimesh").load(args.mesh)
        mesh = mesh.to_mesh() if hasattr(mesh, "to_mesh") else mesh
        mesh.vertices = mesh.vertices @ _UP[args.up].T
    return cut.solid(mesh, scale=args.scale, repair=not args.no_repair)


def _cut(args: argparse.Namespace, solid: cut.Tree) -> cut.Tree:
    noise = (
        cut.Noise(args.noise[0], args.noise[1], seed=args.seed) if args.noise else None
    )
    if args.pattern == "slices":
        angle = math.radians(args.angle)
        tree = cut.slices(
            solid,
            tuple(args.slices),
            offset=args.offset,
            angle=angle,
            noise=noise,
            seed=args.seed,
        )
    elif args.pattern == "bricks":
        tree = cut.bricks(solid, args.brick, noise=noise)
    elif args.pattern == "cutout":
        tree = cut.cutout(solid, _bitmap(args.bitmap), smooth=1.0, noise=noise)
    else:
        sites = _sites(args, solid)
        tree = cut.voronoi(solid, sites, stretch=args.stretch, noise=noise)
    for level, count in enumerate(args.then, 1):
        sites = cut.uniform(tree, count, seed=args.seed + level)
        tree = cut.voronoi(tree, sites, noise=noise)
    return tree


def _sites(args: argparse.Namespace, solid: cut.Tree) -> Any:
    if args.pattern == "clustered":
        each = max(1, round(args.sites / args.clusters))
        return cut.clustered(
            solid, args.clusters, each, spread=args.spread, seed=args.seed
        )
    if args.pattern == "radial":
        low, high = solid.bounds()
        thin = int(np.argmin(high - low))
        wide = np.delete(high - low, thin)
        return cut.radial(
            (low + high) / 2,
            np.eye(3)[thin],
            radius=float(np.linalg.norm(wide)) / 2,
            rings=max(1, round((args.sites - 1) / args.spokes)),
            spokes=args.spokes,
            seed=args.seed,
        )
    return cut.uniform(solid, args.sites, seed=args.seed)


def _bitmap(path: str) -> np.ndarray:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise ImportError(
            "pillow is missing; it comes with pip install 'blastjax[cli]'"
        ) from error
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("L")) > 127
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"bitmap {path!r} cannot be read: {error}") from error


def _world(
    args: argparse.Namespace, tree: cut.Tree
) -> tuple[list[Bonds], tuple[str, ...]]:
    if args.hold == "none":
        return [], ()
    low, high = tree.bounds()
    found = bonds.to_plane(tree.meshes, low, (0, 0, -1))
    if len(found.area):
        return [found], ()
    reach = high - low
    top = np.array([*(high + reach)[:2], low[2] + FOOT * reach[2]])
    found = bonds.to_volume(tree.meshes, low - reach, top)
    said = f"no face lies on the ground: the world holds the lowest {FOOT:.0%}"
    return [found], (said,)


def _table(tree: cut.Tree, result: cut.Result) -> str:
    volume, level = tree.volume, tree.level
    support = result.built.support
    unit = "m^3"
    lines = [f"{'':10}{'chunks':>8}{'support':>9}{'volume':>12}{'smallest':>12} {unit}"]
    for depth in range(level.max() + 1):
        here = level == depth
        lines.append(
            f"level {depth:<4}{here.sum():8d}{support[here].sum():9d}"
            f"{volume[here].sum():12.4g}{volume[here].min():12.4g}"
        )
    asset = result.destructible.asset
    node = np.asarray(asset.element_chunk)[: len(asset.span_node)]
    ends = node[np.asarray(asset.bond_nodes)]
    held = (ends == WORLD).any(axis=1)
    area = np.asarray(asset.bond_area)
    lines.append(
        f"{(~held).sum()} bonds of {area[~held].sum():.4g} m^2, {held.sum()} to the "
        f"world of {area[held].sum():.4g} m^2"
    )
    whole = volume[tree.leaves].sum() / volume[0] - 1
    lines.append(f"chunks without children fill the solid to {abs(whole):.0e}")
    return "\n".join(lines)
