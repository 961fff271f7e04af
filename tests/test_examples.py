"""The examples run and print what they promise."""

import importlib.util
import pathlib

import numpy as np

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
