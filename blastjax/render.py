"""Pictures of worlds, off screen: by MuJoCo where it finds OpenGL, else by matplotlib.

`pose` takes out of a World what a picture needs; it can be jitted and vmapped.
`Renderer` turns poses into frames, and its `backend` says how; `frames` and `save` do
whole animations. Which OpenGL works is found out in a process of its own, for a bad
driver can end the process that asks. Nothing is set in this one's environment.
"""

import colorsys
import functools
import importlib
import importlib.util
import itertools
import os
import pathlib
import platform
import subprocess
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from blastjax import chunks, pytree
from blastjax.core import NONE, Asset, State
from blastjax.rigid import bodies
from blastjax.rigid.scene import Scene
from blastjax.world import World

MUJOCO, MATPLOTLIB = "mujoco", "matplotlib"
EXTENSIONS = (".gif", ".mp4", ".png")
"""What `save` can write; .png of one frame, .mp4 where imageio-ffmpeg is installed."""

_JOINT = 0.985
"""Chunks are drawn a little smaller, to show where one ends."""
_MARK = np.array([1.0, 0.78, 0.1])
_PROBE = """
import mujoco
from mujoco.{name} import GLContext
context = GLContext(16, 16)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
print("works")
"""


@pytree.dataclass
class Pose(pytree.Node):
    """What a picture of a world needs."""

    qpos: jax.Array
    """(nq,) joint positions."""
    mocap_position: jax.Array
    """(M, 3) m."""
    mocap_quaternion: jax.Array
    """(M, 4), w first."""
    actor: jax.Array
    """(A,) int32 label of the actor of each element."""
    marked: jax.Array
    """(A,) bool, elements to stress."""


def pose(scene: Scene, world: World, marked: jax.Array | None = None) -> Pose:
    """Take out of a world what a picture needs.

    Args:
      scene: the scene.
      world: the world.
      marked: (A,) bool, elements to stress while the world holds them.
    """
    data = bodies.place(scene, world.bodies, world.data)
    actor = world.state.actor
    return Pose(
        qpos=data.qpos,
        mocap_position=data.mocap_pos,
        mocap_quaternion=data.mocap_quat,
        actor=actor,
        marked=jnp.zeros(actor.shape, bool) if marked is None else marked,
    )


@functools.cache
def find_gl() -> str | None:
    """Return the kind of OpenGL that MuJoCo can draw with here, or None.

    It is "egl", "osmesa", "glfw" or "cgl". MUJOCO_GL, if set, leaves one choice.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in ("disable", "disabled", "off", "false", "0"):
        return None
    system = platform.system()
    if wanted in ("egl", "osmesa", "glfw", "cgl"):
        choices: tuple[str, ...] = (wanted,)
    elif system == "Linux":
        choices = ("glfw", "egl") if os.environ.get("DISPLAY") else ("egl",)
    else:
        choices = ("cgl",) if system == "Darwin" else ("glfw",)
    return next((name for name in choices if _works(name)), None)


def _works(name: str) -> bool:
    command = [sys.executable, "-c", _PROBE.format(name=name)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and "works" in done.stdout


class Renderer:
    """Draws poses of one scene; close it, or use it in a `with`."""

    def __init__(
        self,
        scene: Scene,
        *,
        width: int = 640,
        height: int = 480,
        backend: str = "auto",
        azimuth: float = 55.0,
        elevation: float = -22.0,
        zoom: float = 1.0,
    ) -> None:
        """Prepare to draw.

        Args:
          scene: the scene.
          width: of a frame, pixels.
          height: of a frame, pixels.
          backend: "mujoco", "matplotlib", or "auto": the first that works.
          azimuth: where the camera looks, degrees from x towards y.
          elevation: how far above the horizon it looks, degrees; negative is down.
          zoom: how large the whole asset appears.

        Raises:
          ValueError: an option is out of range.
          RuntimeError: MuJoCo was asked for and finds no OpenGL here.
          ImportError: matplotlib is needed and missing.
        """
        if backend not in ("auto", MUJOCO, MATPLOTLIB):
            raise ValueError(
                f"backend is {backend!r}; use 'auto', 'mujoco' or 'matplotlib'"
            )
        if width < 16 or height < 16:
            raise ValueError(f"a frame of {width} x {height} is too small; use 16 up")
        self.scene, self.width, self.height = scene, width, height
        self.camera = _camera(scene, width / height, azimuth, elevation, zoom)
        self._data = mujoco.MjData(scene.host.model)
        gl = None if backend == MATPLOTLIB else find_gl()
        if gl is None and backend == MUJOCO:
            raise RuntimeError(
                "MuJoCo finds no OpenGL here; install EGL (Mesa) or use "
                "backend='matplotlib'"
            )
        self._painter: _OpenGL | _Figure
        if gl is None:
            self._painter = _Figure(scene.host.model, width, height)
        else:
            self._painter = _OpenGL(scene.host.model, width, height, gl)
        self.backend = MATPLOTLIB if gl is None else MUJOCO
        self._pose = jax.jit(functools.partial(pose, scene))

    def draw(self, what: Pose | World) -> np.ndarray:
        """Return the picture of a pose or a world, (height, width, 3) uint8."""
        shown = self._pose(what) if isinstance(what, World) else what
        shown = jax.device_get(shown)
        model, data = self.scene.host.model, self._data
        data.qpos[:] = shown.qpos
        data.mocap_pos[:] = shown.mocap_position
        data.mocap_quat[:] = shown.mocap_quaternion
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        return self._painter.paint(data, self.camera, _colors(self.scene, shown))

    def close(self) -> None:
        """Give back what the drawing took."""
        self._painter.close()

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def frames(
    scene: Scene, what: Iterable[Pose | World] | Pose | World, **options: Any
) -> tuple[list[np.ndarray], str]:
    """Draw several worlds or poses.

    Args:
      scene: the scene.
      what: a sequence, or one World or Pose whose arrays have a leading axis of time.
      **options: of `Renderer`.

    Returns:
      The frames, (height, width, 3) uint8 each, and the backend that drew them.
    """
    if isinstance(what, World):
        what = jax.jit(jax.vmap(functools.partial(pose, scene)))(what)
    if isinstance(what, Pose):
        shown = jax.device_get(what)
        count = shown.qpos.shape[0]
        what = [jax.tree.map(lambda x, i=i: x[i], shown) for i in range(count)]
    assert not isinstance(what, World)
    with Renderer(scene, **options) as renderer:
        return [renderer.draw(each) for each in what], renderer.backend


def check_path(path: str | os.PathLike[str]) -> pathlib.Path:
    """Return the path if `save` can write there.

    Raises:
      ValueError: the extension is unknown, or the folder does not exist or cannot be
        written to.
      ImportError: a package for the extension is missing.
    """
    target = pathlib.Path(path)
    kind = target.suffix.lower()
    if kind not in EXTENSIONS:
        raise ValueError(
            f"{os.fspath(path)!r} ends in {kind or 'nothing'!r}; "
            f"use one of {', '.join(EXTENSIONS)}"
        )
    folder = target.parent
    if not folder.is_dir():
        raise ValueError(f"{os.fspath(folder)!r} is not a folder")
    writable = folder if not target.exists() else target
    if target.is_dir() or not os.access(writable, os.W_OK):
        raise ValueError(f"{os.fspath(target)!r} cannot be written")
    _need("PIL", "pillow")
    if kind == ".mp4":
        _need("imageio", "imageio")
        if importlib.util.find_spec("imageio_ffmpeg") is None:
            raise ImportError(
                "an MP4 needs imageio-ffmpeg: install that, or write a GIF"
            )
    return target


def save(
    path: str | os.PathLike[str], pictures: Sequence[np.ndarray], *, fps: float = 25.0
) -> pathlib.Path:
    """Write an animation, or the one picture of a .png.

    Args:
      path: ends in .gif, .mp4 or .png.
      pictures: (height, width, 3) uint8 each.
      fps: frames a second; a GIF keeps hundredths of a second.

    Raises:
      ValueError: as `check_path`, or there is no picture, or several for a .png.
      ImportError: as `check_path`.
    """
    target = check_path(path)
    if not len(pictures):
        raise ValueError("there is no picture to save")
    if not fps > 0:
        raise ValueError(f"fps is {fps}; it must be above 0")
    kind = target.suffix.lower()
    if kind == ".mp4":
        _need("imageio", "imageio").mimwrite(target, list(pictures), fps=fps)
        return target
    image = _need("PIL.Image", "pillow")
    still = [image.fromarray(np.asarray(picture)) for picture in pictures]
    if kind == ".png":
        if len(still) != 1:
            raise ValueError(f"{len(still)} pictures do not fit a .png; use .gif")
        still[0].save(target)
        return target
    # One palette for all frames keeps colours from flickering.
    chosen = still[:: max(1, len(still) // 4)]
    sheet = np.concatenate([np.asarray(each) for each in chosen])
    palette = image.fromarray(sheet).quantize(256)
    reduced = [
        each.quantize(palette=palette, dither=image.Dither.NONE) for each in still
    ]
    reduced[0].save(
        target,
        save_all=True,
        append_images=reduced[1:],
        duration=round(1000 / fps),
        loop=0,
    )
    return target


def _need(module: str, package: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{package} is missing; it comes with pip install 'blastjax[cli]'"
        ) from error


def _camera(
    scene: Scene, aspect: float, azimuth: float, elevation: float, zoom: float
) -> mujoco.MjvCamera:
    """Return a camera that sees the whole asset at its start, and room around it."""
    asset, model = scene.asset, scene.host.model
    here = np.asarray(chunks.is_chunk(asset))
    chunk = np.asarray(asset.element_chunk)[here]
    center = np.asarray(asset.chunk_centroid, float)[chunk]
    reach = np.linalg.norm(np.asarray(asset.chunk_size, float)[chunk], axis=1)[:, None]
    low, high = (center - reach).min(axis=0), (center + reach).max(axis=0)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(scene.quaternion, float))
    middle = np.asarray(scene.position) + turn.reshape(3, 3) @ ((low + high) / 2)
    half_angle = np.radians(model.vis.global_.fovy) / 2
    half_angle = min(half_angle, np.arctan(np.tan(half_angle) * aspect))
    camera = mujoco.MjvCamera()
    camera.lookat[:] = middle
    camera.distance = np.linalg.norm(high - low) / 2 / np.sin(half_angle) / zoom
    camera.azimuth, camera.elevation = azimuth, elevation
    return camera


def _colors(scene: Scene, shown: Pose) -> dict[int, np.ndarray]:
    """Return the colour (4,) of each chunk's geom, transparent if it is gone."""
    colors = {}
    for geom, element in enumerate(scene.host.geom_element):
        if element < 0:
            continue
        label = int(shown.actor[element])
        if label == NONE:
            colors[geom] = np.zeros(4)
            continue
        # Neighbours in one actor differ a little, actors differ in hue.
        shade = 0.9 + 0.1 * ((element * 0.618) % 1.0)
        if scene.asset.has_world and label == 0:
            color = np.array([0.72, 0.36, 0.27]) * shade
            if shown.marked[element]:
                color = _MARK * shade
        else:
            hue = (0.08 + label * 0.618034) % 1.0
            color = np.array(colorsys.hsv_to_rgb(hue, 0.55, 0.9)) * shade
        colors[geom] = np.append(color, 1.0)
    return colors


def draw_utilisation(
    asset: Asset,
    state: State,
    utilisation: jax.Array,
    path: str | os.PathLike[str],
    *,
    width: int = 800,
    height: int = 600,
    azimuth: float = 55.0,
    elevation: float = -22.0,
    zoom: float = 1.0,
) -> pathlib.Path:
    """Draw the support chunks of an asset at rest, coloured by what their bonds bear.

    A chunk has the colour of its worst bond that still connects, one past its limit a
    colour of its own, and one without bonds is grey.

    Args:
      asset: the asset.
      state: its state.
      utilisation: (B,) part of the limit that each bond uses, of `stress.judge`.
      path: of a .png.
      width: of the picture, pixels.
      height: of the picture, pixels.
      azimuth: where the camera looks, degrees from x towards y.
      elevation: how far above the horizon it looks, degrees; negative is down.
      zoom: how large the whole asset appears.

    Raises:
      ValueError: the path is no .png, cannot be written, or a shape is wrong.
      ImportError: matplotlib is missing.
    """
    target = check_path(path)
    if target.suffix.lower() != ".png":
        raise ValueError(f"{os.fspath(path)!r} is one picture; use .png")
    host: Any = jax.device_get(asset)
    used = np.asarray(utilisation)
    if used.shape != host.bond_area.shape:
        raise ValueError(
            f"utilisation has shape {used.shape}; give {host.bond_area.shape}"
        )
    node = np.flatnonzero(host.element_chunk[: len(host.span_node)] >= 0)
    chunk = host.element_chunk[node]
    worst = _worst_of_nodes(host, jax.device_get(state), used)[node]
    colors = _need("matplotlib", "matplotlib").colormaps["YlOrRd"]
    colors = colors.with_extremes(over=_PAST_LIMIT)
    paints = np.where(worst[:, None] >= 0, colors(worst), _IDLE)

    place, size = host.chunk_centroid[chunk], host.chunk_size[chunk]
    low, high = (place - size).min(axis=0), (place + size).max(axis=0)
    reach = np.linalg.norm(high - low) / zoom
    axes = _axes(azimuth, elevation)
    eye = (low + high) / 2 - 1.4 * reach * axes[2]
    solids = [
        [face * _JOINT + x for face in _outward(_box(s))]
        for x, s in zip(place, size, strict=True)
    ]
    drawn = []
    for i in _back_to_front(solids, eye):
        drawn += _lit(solids[i], paints[i], (eye, axes, 2.4))
    return _with_bar(target, drawn, colors, width, height)


_PAST_LIMIT = (0.25, 0.0, 0.35, 1.0)
_IDLE = np.array([0.72, 0.74, 0.76, 1.0])


def _worst_of_nodes(host: Any, state: Any, utilisation: np.ndarray) -> np.ndarray:
    """Return the largest utilisation of each node's bonds, (N,), -1 without any."""
    worst = np.full(len(host.span_node), -1.0)
    alive = np.asarray(state.bond_intact)
    for side in (0, 1):
        np.maximum.at(worst, host.bond_nodes[alive, side], utilisation[alive])
    return worst


def _with_bar(
    path: pathlib.Path,
    drawn: list[tuple[np.ndarray, np.ndarray]],
    colors: Any,
    width: int,
    height: int,
) -> pathlib.Path:
    """Write polygons and a colour bar from 0 to 1."""
    polygons = _need("matplotlib.collections", "matplotlib").PolyCollection
    mappable = _need("matplotlib.cm", "matplotlib").ScalarMappable
    norm = _need("matplotlib.colors", "matplotlib").Normalize(0, 1)
    figure = _need("matplotlib.figure", "matplotlib").Figure(
        figsize=(width / 100, height / 100), dpi=100
    )
    share = 0.85
    plot = figure.add_axes((0, 0, share, 1))
    plot.set_axis_off()
    wide = share * width / height
    plot.set_xlim(-wide, wide)
    plot.set_ylim(-1, 1)
    shapes, paints = zip(*drawn, strict=True) if drawn else ((), ())
    plot.add_collection(
        polygons(shapes, facecolors=paints, edgecolors="face", linewidths=0.3)
    )
    figure.colorbar(
        mappable(norm, colors),
        cax=figure.add_axes((share + 0.02, 0.15, 0.03, 0.7)),
        extend="max",
        label="utilisation of the elastic limit",
    )
    figure.savefig(path)
    return path


class _OpenGL:
    """Paints with MuJoCo.

    `mujoco.Renderer` takes its OpenGL from an environment variable, read at import.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, gl: str) -> None:
        self._model = model
        self._context = importlib.import_module(f"mujoco.{gl}").GLContext(width, height)
        self._context.make_current()
        self._scene = mujoco.MjvScene(model, maxgeom=max(1000, 2 * model.ngeom))
        self._option = mujoco.MjvOption()
        self._target = mujoco.MjrContext(
            model, mujoco.mjtFontScale.mjFONTSCALE_100.value
        )
        mujoco.mjr_resizeOffscreen(width, height, self._target)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._target)
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def paint(
        self,
        data: mujoco.MjData,
        camera: mujoco.MjvCamera,
        colors: dict[int, np.ndarray],
    ) -> np.ndarray:
        self._context.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, camera, every, self._scene
        )
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in colors:
                geom.rgba[:] = colors[geom.objid]
                geom.size[:] = np.array(geom.size) * _JOINT
        picture = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_render(self._rect, self._scene, self._target)
        mujoco.mjr_readPixels(picture, None, self._rect, self._target)
        return np.ascontiguousarray(picture[::-1])

    def close(self) -> None:
        self._context.make_current()
        self._target.free()
        self._context.free()


class _Figure:
    """Paints filled faces with matplotlib, the far solids first.

    The camera is MuJoCo's, so that both backends show the same view. Planes are drawn
    first, as the ground under everything else.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        figure = _need("matplotlib.figure", "matplotlib").Figure
        canvas = _need("matplotlib.backends.backend_agg", "matplotlib").FigureCanvasAgg
        self._model, self._width, self._height = model, width, height
        self._figure = figure(figsize=(width / 100, height / 100), dpi=100)
        self._canvas = canvas(self._figure)
        self._faces = [_faces(model, geom) for geom in range(model.ngeom)]

    def paint(
        self,
        data: mujoco.MjData,
        camera: mujoco.MjvCamera,
        colors: dict[int, np.ndarray],
    ) -> np.ndarray:
        view = _view(self._model, camera)
        ground, solids, paints = [], [], []
        for geom, faces in enumerate(self._faces):
            color = colors.get(geom, self._model.geom_rgba[geom])
            if color[3] == 0 or not faces:
                continue
            grow = _JOINT if geom in colors else 1.0
            turn = data.geom_xmat[geom].reshape(3, 3).T
            placed = [face * grow @ turn + data.geom_xpos[geom] for face in faces]
            if self._model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                ground += _tiles(placed, view)
            else:
                solids.append(placed)
                paints.append(color)
        drawn = ground
        for i in _back_to_front(solids, view[0]):
            drawn = drawn + _lit(solids[i], paints[i], view)
        return self._fill(drawn)

    def _fill(self, drawn: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        polygons = _need("matplotlib.collections", "matplotlib").PolyCollection
        self._figure.clear()
        self._figure.set_facecolor(_SKY)
        plot = self._figure.add_axes((0, 0, 1, 1))
        plot.set_axis_off()
        plot.set_xlim(-self._width / self._height, self._width / self._height)
        plot.set_ylim(-1, 1)
        shapes, colors = zip(*drawn, strict=True) if drawn else ((), ())
        # An edge of the face's own colour closes the seams of smoothed polygons.
        plot.add_collection(
            polygons(shapes, facecolors=colors, edgecolors="face", linewidths=0.3)
        )
        self._canvas.draw()
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        return np.array(pixels[: self._height, : self._width])

    def close(self) -> None:
        self._figure.clear()


_OVERLAP = 0.003
"""What solids in touch may overlap and still count as parted, m."""
_SKY = (0.86, 0.9, 0.94)
_GROUND = np.array([0.62, 0.63, 0.6, 1.0])
_TILE = np.array([0.67, 0.68, 0.65, 1.0])

View = tuple[np.ndarray, np.ndarray, float]


def _tiles(faces: list[np.ndarray], view: View) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the polygons of a plane that show, the whole first, and their colours."""
    colors = [_GROUND, *[_TILE] * (len(faces) - 1)]
    flat = [(_project(face, view), c) for face, c in zip(faces, colors, strict=True)]
    return [(shape, color) for shape, color in flat if len(shape)]


def _lit(
    faces: list[np.ndarray], color: np.ndarray, view: View
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the polygons of a convex solid that show, and their colours."""
    drawn = []
    for face in faces:
        normal = _normal(face)
        flat = _project(face, view)
        if len(flat) and normal @ (face[0] - view[0]) < 0:
            bright = np.append(color[:3] * _brightness(normal), color[3])
            drawn.append((flat, np.clip(bright, 0, 1)))
    return drawn


def _back_to_front(solids: list[list[np.ndarray]], eye: np.ndarray) -> list[int]:
    """Return an order in which convex solids, lists of faces, cover each other rightly.

    Where a face's plane parts two solids, the one on the far side from the eye cannot
    hide the other.
    """
    count = len(solids)
    corners = [np.concatenate(faces) for faces in solids]
    points = np.concatenate(corners) if corners else np.zeros((0, 3))
    starts = np.cumsum([0, *(len(c) for c in corners[:-1])])
    # hides[i, j]: j may hide part of i, and is painted later.
    hides = ~np.eye(count, dtype=bool)
    for i, faces in enumerate(solids):
        normals = np.stack([_normal(face) for face in faces])
        offset = np.sum(normals * np.stack([face[0] for face in faces]), axis=1)
        beyond = np.minimum.reduceat(normals @ points.T, starts, axis=1)
        parted = beyond - offset[:, None] > -_OVERLAP
        outside = (normals @ eye > offset)[:, None]
        hides[i] &= ~(parted & ~outside).any(axis=0)
        hides[:, i] &= ~(parted & outside).any(axis=0)
    far = [-np.linalg.norm(c.mean(axis=0) - eye) for c in corners]
    left, order = set(range(count)), []
    while left:
        ready = [i for i in left if not any(hides[j, i] for j in left)]
        # Solids may hide each other in a ring; then the farthest begins.
        chosen = min(ready or left, key=far.__getitem__)
        order.append(chosen)
        left.remove(chosen)
    return order


def _normal(face: np.ndarray) -> np.ndarray:
    """Return the unit normal of a polygon (n, 3), by Newell: corners may coincide."""
    normal = np.cross(face, np.roll(face, -1, axis=0)).sum(axis=0)
    return normal / max(np.linalg.norm(normal), 1e-12)


def _brightness(normal: np.ndarray) -> float:
    light = np.array([-0.3, -0.55, 0.8])
    return float(0.65 + 0.4 * max(normal @ light / np.linalg.norm(light), 0.0))


def _view(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> View:
    """Return the eye (3,), right, up and forward (3, 3), and 1 / tan(fovy / 2)."""
    axes = _axes(camera.azimuth, camera.elevation)
    eye = np.array(camera.lookat) - camera.distance * axes[2]
    return eye, axes, 1.0 / np.tan(np.radians(model.vis.global_.fovy) / 2)


def _axes(azimuth: float, elevation: float) -> np.ndarray:
    """Return right, up and forward of a camera, (3, 3)."""
    turn, rise = np.radians(azimuth), np.radians(elevation)
    forward = np.array(
        [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)]
    )
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    return np.stack([right, np.cross(right, forward), forward])


def _project(corners: np.ndarray, view: View) -> np.ndarray:
    """Return a polygon (n, 3) in the picture, (m, 2), without what lies behind."""
    eye, axes, scale = view
    local = (corners - eye) @ axes.T
    near = 0.05
    kept = []
    for a, b in zip(local, np.roll(local, -1, axis=0), strict=True):
        if a[2] >= near:
            kept.append(a)
        if (a[2] >= near) != (b[2] >= near):
            kept.append(a + (near - a[2]) / (b[2] - a[2]) * (b - a))
    if len(kept) < 3:
        return np.zeros((0, 2))
    shown = np.array(kept)
    return scale * shown[:, :2] / shown[:, 2:]


def _faces(model: mujoco.MjModel, geom: int) -> list[np.ndarray]:
    """Return the faces of a geom in its own frame, each (n, 3).

    Boxes, round shapes, meshes and planes; other kinds have none. A mesh is drawn well
    if it is convex.
    """
    kind, size = model.geom_type[geom], model.geom_size[geom]
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_PLANE:
        return _plane(size)
    if kind == types.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
        first = model.mesh_faceadr[mesh]
        rows = model.mesh_face[first : first + model.mesh_facenum[mesh]]
        return list(points[rows].astype(float))
    if kind == types.mjGEOM_BOX:
        faces = _box(size)
    elif kind == types.mjGEOM_SPHERE:
        faces = _lathe(np.full(3, size[0]), 0.0)
    elif kind == types.mjGEOM_ELLIPSOID:
        faces = _lathe(size, 0.0)
    elif kind == types.mjGEOM_CAPSULE:
        faces = _lathe(np.full(3, size[0]), size[1])
    elif kind == types.mjGEOM_CYLINDER:
        faces = _prism(size[0], size[1])
    else:
        faces = []
    return _outward(faces)


def _outward(faces: list[np.ndarray]) -> list[np.ndarray]:
    """Turn the faces of a solid that is convex about its middle away from it."""
    return [f if _normal(f) @ f.mean(axis=0) > 0 else f[::-1] for f in faces]


def _plane(size: np.ndarray) -> list[np.ndarray]:
    """Return the whole plane, then every other tile of 1 m near its middle."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    reach = np.append(np.where(size[:2] > 0, size[:2], 500.0), 0.0)
    tiles = [(i, j) for i in range(-8, 8) for j in range(-8, 8) if (i + j) % 2]
    inside = [t for t in tiles if (np.abs(np.array(t) + 0.5) + 0.5 <= reach[:2]).all()]
    return [
        (2 * square - 1) * reach,
        *(square + np.array([i, j, 0]) for i, j in inside),
    ]


def _box(size: np.ndarray) -> list[np.ndarray]:
    ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return [
        np.array([np.roll([side, u, v], axis) for u, v in ring]) * size
        for axis in range(3)
        for side in (-1.0, 1.0)
    ]


def _circle() -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 21)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _lathe(radii: np.ndarray, stretch: float) -> list[np.ndarray]:
    """Return the faces of an ellipsoid, pulled apart at its equator by the stretch."""
    around = _circle()
    rings = []
    for polar in np.linspace(0, np.pi, 14):
        height = np.full((len(around), 1), np.cos(polar))
        ring = np.append(around * np.sin(polar), height, axis=1) * radii
        lift = stretch if polar < np.pi / 2 else -stretch
        rings.append(ring + np.array([0, 0, lift]))
    return [
        np.array([upper[i], lower[i], lower[i + 1], upper[i + 1]])
        for upper, lower in itertools.pairwise(rings)
        for i in range(len(around) - 1)
    ]


def _prism(radius: float, half: float) -> list[np.ndarray]:
    around = _circle() * radius
    top = np.append(around, np.full((len(around), 1), half), axis=1)
    bottom = top * [1, 1, -1]
    sides = [
        np.array([bottom[i], bottom[i + 1], top[i + 1], top[i]])
        for i in range(len(around) - 1)
    ]
    return [*sides, top[:-1], bottom[:-1]]
