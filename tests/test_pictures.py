"""Pictures of assets: what is in front is seen, and the files are pictures."""

import numpy as np
import pytest
from PIL import Image

from blastjax import pictures
from blastjax.author import bonds, cut
from tests import solids


@pytest.fixture(scope="module")
def broken():
    tree = cut.solid(solids.box())
    for count in (3, 2):
        tree = cut.voronoi(tree, cut.uniform(tree, count, seed=3))
    held = bonds.to_plane(tree.meshes, tree.bounds()[0], (0, 0, -1))
    return cut.destructible(tree, world=[held]).destructible


@pytest.mark.parametrize("draw", [pictures.exploded, pictures.levels, pictures.graph])
def test_a_picture_of_the_asked_size(broken, draw, tmp_path):
    path = draw(broken, tmp_path / "a.png", width=200, height=120)
    with Image.open(path) as image:
        assert image.size == (200, 120)
        seen = np.asarray(image.convert("RGB"))
    assert 0.02 < (seen < 250).any(axis=2).mean() < 0.9
    with pytest.raises(ValueError, match=r"\.png"):
        draw(broken, tmp_path / "a.gif")


def test_the_nearest_triangle_is_seen():
    far = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], float)
    near = far * 0.5 + [0, 0, 1]
    away = (far * 0.9 + [0, 0, 2])[::-1]
    colors = np.eye(3)
    picture = pictures._raster(np.stack([far, near, away]), colors, (64, 64))
    assert picture[32, 32].argmax() == 1 and picture[32, 32, 1] > 0.5
    assert picture[60, 32].argmax() == 0
    np.testing.assert_array_equal(picture[2, 2], 1.0)
    # A triangle that looks away is not drawn, and the order does not matter.
    again = pictures._raster(np.stack([near, away, far]), colors[[1, 2, 0]], (64, 64))
    np.testing.assert_array_equal(picture, again)


def test_a_chunk_apart_covers_its_own_area(broken):
    # An exploded view shows more of the chunks than the whole does.
    pixels = []
    for spread in (0.0, 1.0):
        view = pictures._axes(55, -22)
        chosen = pictures._support(broken)
        paint = pictures._hues(len(broken.meshes))
        drawn = pictures._drawn(broken, chosen, paint, spread, view, (96, 96))
        pixels.append(len(np.unique(drawn.reshape(-1, 3).round(3), axis=0)))
    assert pixels[1] > pixels[0]
