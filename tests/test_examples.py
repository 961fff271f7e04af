"""The examples run and print what they promise."""

import importlib.util
import pathlib

import numpy as np
import pytest

from tests.test_envs import SMALL

FOLDER = pathlib.Path(__file__).parent.parent / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_break_a_wall(capsys):
    load("break_a_wall").main()
    said = capsys.readouterr().out
    assert "held by the world" in said and "loose" in said


def test_sweep_of_shots(capsys):
    load("sweep_of_shots").main(columns=3, rows=2)
    assert len(capsys.readouterr().out.splitlines()) == 1 + 2 * 6


def test_gymnasium_loop(capsys):
    total = load("gymnasium_loop").main(num_envs=3, steps=12, **SMALL)
    assert total.shape == (3,) and np.isfinite(total).all()
    assert "episodes ended" in capsys.readouterr().out


@pytest.mark.slow
def test_which_brick(capsys, tmp_path):
    load("which_brick").main(tmp_path / "table.png")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 26 + 1
    assert lines[0] == "whole: safety factor 1.55" and lines[-1].endswith("can go")
    assert (tmp_path / "table.png").stat().st_size > 5000


@pytest.mark.slow
def test_break_a_vase(capsys, tmp_path):
    actors = load("break_a_vase").main(tmp_path)
    assert actors > 3
    assert "48 shards" in capsys.readouterr().out
    assert len(list(tmp_path.glob("vase*.png"))) == 3


def test_aim_a_shot(capsys, tmp_path):
    aimed, _ = load("aim_a_shot").main(tmp_path / "aim.png", rounds=3)
    assert aimed == 0
    assert "free exactly 18 of 256" in capsys.readouterr().out
    assert (tmp_path / "aim.png").stat().st_size > 5000


@pytest.mark.slow
def test_how_strong(capsys, tmp_path):
    picture = tmp_path / "strength.png"
    seen, new, guess = load("how_strong").main(picture, count=8, steps=200)
    assert seen > 0.9 and new > guess
    assert "all bricks alike" in capsys.readouterr().out
    assert picture.stat().st_size > 5000


@pytest.mark.slow
def test_soft_landing(capsys, tmp_path):
    found = load("soft_landing").main(tmp_path / "landing.png")
    assert found["pieces"][0] > 1 and found["pieces"][1] == 1
    assert found["lost"][0] > 1 > found["lost"][1]
    assert abs(found["rest"][0] - 1.5) < 0.1 and found["rest"][1] < 0.1
    assert found["speed"] < 0.1 and found["random"] > 0.2
    assert "first throw" in capsys.readouterr().out


def test_size_a_beam(capsys):
    after = load("size_a_beam").main(length=4, steps=40)
    np.testing.assert_allclose(after, 2.0, rtol=0.01)
    assert "safety before" in capsys.readouterr().out


def test_build_a_gate(capsys, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    count = load("build_a_gate").main(tmp_path / "gate.glb")
    assert "1000 kg: held" in capsys.readouterr().out
    assert len(trimesh.load_scene(tmp_path / "gate.glb").geometry) == count > 1


@pytest.mark.slow
def test_falling_vase(capsys):
    load("falling_vase").main(shards=4, seconds=0.6)
    pieces = int(capsys.readouterr().out.splitlines()[1].split()[0])
    assert pieces > 1
