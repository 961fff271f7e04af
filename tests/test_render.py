"""Pictures: both backends, colours of actors, files, and what to say when stuck."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from blastjax import fracture, render, world
from blastjax.author import shapes
from blastjax.core import Damage
from blastjax.rigid import build

BACKENDS = [
    "matplotlib",
    pytest.param(
        "mujoco",
        marks=pytest.mark.skipif(render.find_gl() is None, reason="no OpenGL"),
    ),
]
SIZE = {"width": 120, "height": 90}


@pytest.fixture(scope="module")
def scene():
    return build(shapes.wall(2, 2), slots=3)


@pytest.fixture(scope="module")
def poses(scene):
    """Whole, and with every bond broken."""
    pose = jax.jit(lambda state: render.pose(scene, world.init(scene, state)))
    state = fracture.init(scene.asset)
    all_ = Damage(bond=jnp.ones(scene.asset.bond_area.shape))
    broken, _ = fracture.step(scene.asset, state, all_)
    return [pose(state), pose(broken)]


@pytest.mark.parametrize("backend", BACKENDS)
def test_wall_fills_the_middle_and_pieces_have_colours(scene, poses, backend):
    pictures, used = render.frames(scene, poses, backend=backend, **SIZE)
    assert used == backend
    for picture in pictures:
        assert picture.shape == (90, 120, 3) and picture.dtype == np.uint8
    red, green, blue = (pictures[0][..., i].astype(int) for i in range(3))
    brick = (red > green + 30) & (red > blue + 30)
    rows, columns = np.nonzero(brick)
    # All of the wall is in the picture and most of what surrounds it too.
    assert 0.05 < brick.mean() < 0.6
    assert rows.min() > 2 and rows.max() < 87
    assert columns.min() > 2 and columns.max() < 117
    middle = brick[35:50, 55:65]
    assert middle.mean() > 0.8
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() > 60


def test_batch_of_poses_is_a_sequence(scene, poses):
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *poses)
    one, _ = render.frames(scene, stacked, backend="matplotlib", **SIZE)
    two, _ = render.frames(scene, poses, backend="matplotlib", **SIZE)
    np.testing.assert_array_equal(one, two)


def test_near_solids_are_painted_last():
    def box(x):
        return [f + np.array([x, 0, 0]) for f in render._box(np.array([0.4, 1, 1]))]

    boxes = [box(x) for x in (2.0, 0.0, 1.0)]
    assert render._back_to_front(boxes, np.array([9.0, 0, 0])) == [1, 2, 0]
    assert render._back_to_front(boxes, np.array([-9.0, 0, 0])) == [0, 2, 1]


def test_files(tmp_path):
    pictures = [np.full((20, 30, 3), value, np.uint8) for value in (10, 200, 90)]
    with Image.open(render.save(tmp_path / "a.gif", pictures, fps=10)) as image:
        assert image.n_frames == 3 and image.size == (30, 20)
    render.save(tmp_path / "a.png", pictures[:1])
    with pytest.raises(ValueError, match="3 pictures"):
        render.save(tmp_path / "a.png", pictures)
    with pytest.raises(ValueError, match="no picture"):
        render.save(tmp_path / "a.gif", [])
    with pytest.raises(ValueError, match="fps"):
        render.save(tmp_path / "a.gif", pictures, fps=0)


def test_paths_are_checked(tmp_path):
    with pytest.raises(ValueError, match="use one of"):
        render.check_path(tmp_path / "a.xyz")
    with pytest.raises(ValueError, match="not a folder"):
        render.check_path(tmp_path / "none" / "a.gif")
    (tmp_path / "b.gif").mkdir()
    with pytest.raises(ValueError, match="cannot be written"):
        render.check_path(tmp_path / "b.gif")


def test_missing_packages_are_named(monkeypatch, tmp_path):
    with pytest.raises(ImportError, match=r"blastjax\[cli\]"):
        render._need("no_such_module", "this")
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match="imageio"):
        render.check_path(tmp_path / "a.mp4")


def test_opengl_that_fails_is_passed_by(monkeypatch, scene):
    monkeypatch.setattr(render, "find_gl", lambda: None)
    with render.Renderer(scene, **SIZE) as renderer:
        assert renderer.backend == "matplotlib"
    with pytest.raises(RuntimeError, match="OpenGL"):
        render.Renderer(scene, backend="mujoco", **SIZE)
    with pytest.raises(ValueError, match="backend"):
        render.Renderer(scene, backend="paint", **SIZE)
    assert not render._works("no_such_backend")
