"""The command line: help, refusals, and one small run in a process of its own."""

import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from blastjax import __main__ as cli
from blastjax import serialize
from tests.conftest import CACHE

OPTIONS = ("--batch", "--steps", "--seed", "--out", "--show", "--fps", "--backend")


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "box.stl"
    trimesh.creation.box((0.6, 0.3, 0.9)).export(path)
    return str(path)


def test_help_names_every_option(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    assert all(option in said for option in OPTIONS)


def test_help_of_fracture(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["fracture", "--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    for option in ("--sites", "--pattern", "--then", "--noise", "--hold", "--scale"):
        assert option in said
    assert "default: 64" in said and "None" not in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--batch", "0"], "--batch"),
        (["--steps", "x"], "--steps"),
        (["--seed", "1.5"], "--seed"),
        (["--fps", "0"], "--fps"),
        (["--show", "3", "--batch", "2"], "--show"),
        (["--out", "a.xyz"], ".gif"),
        (["--out", "no/such/folder/a.gif"], "not a folder"),
        (["--backend", "paint"], "--backend"),
        (["--what"], "--what"),
        (["--asset", "no-such.npz"], "--asset"),
        (["fracture"], "mesh"),
        (["fracture", "no-such.stl"], "no-such.stl"),
        (["fracture", "BOX", "--sites", "1"], "--sites"),
        (["fracture", "BOX", "--out", "a.zip"], "--out"),
        (["fracture", "BOX", "--out", "no/such/a.npz"], "not a folder"),
        (["fracture", "BOX", "--picture", "a.gif"], "--picture"),
        (["fracture", "BOX", "--pattern", "cutout"], "--bitmap"),
        (["fracture", "BOX", "--pattern", "cutout", "--bitmap", "x.png"], "x.png"),
        (["fracture", "BOX", "--noise", "0.9", "0.1"], "is safe"),
        (["fracture", "BOX", "--scale", "nan"], "--scale"),
        (["fracture", "BOX", "--scale", "1e9"], "give `scale`"),
    ],
)
def test_bad_options_exit_with_2(words, message, capsys, box, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [box if word == "BOX" else word for word in words]
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 2
    said = capsys.readouterr()
    assert message in said.err and "Traceback" not in said.err


@pytest.mark.slow
def test_small_run_writes_a_gif_and_says_what_broke(tmp_path):
    target = tmp_path / "breach.gif"
    words = (
        "--batch 2 --steps 8 --bricks 2 --courses 2 --slots 3 --width 64 --height 48"
    )
    command = [sys.executable, "-m", "blastjax", *words.split(), "--out", str(target)]
    cached = {**os.environ, "JAX_COMPILATION_CACHE_DIR": os.fspath(CACHE)}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=500, env=cached
    )
    assert done.returncode == 0, done.stderr
    for word in ("actors", "broken bonds", "fallen volume", "largest", "steps/s"):
        assert word in done.stdout
    assert "drawn by" in done.stdout
    # Only the progress bars.
    noise = done.stdout + done.stderr
    assert "warp" not in noise and "Warning" not in noise
    with Image.open(target) as image:
        assert image.n_frames > 1


def test_interrupt_is_clean(monkeypatch, capsys):
    def interrupted(args, parser):
        raise KeyboardInterrupt

    command = cli.COMMANDS["breach"]._replace(run=interrupted)
    monkeypatch.setitem(cli.COMMANDS, "breach", command)
    assert cli.main([]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_fracture_writes_an_asset_and_says_what_it_is(box, tmp_path, capsys):
    target = tmp_path / "a.npz"
    words = ["fracture", box, "--sites", "5", "--then", "2", "--out", str(target)]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    for word in ("level 2", "support", "smallest", "to the world", "fill the solid"):
        assert word in said
    what = serialize.load(target).destructible
    assert len(what.meshes) == 1 + 5 + 10 and what.asset.has_world
    assert target.with_suffix(".png").stat().st_size > 2000
    again = tmp_path / "b.npz"
    assert cli.main([*words[:-1], str(again), "--picture", "none"]) == 0
    assert again.read_bytes() == target.read_bytes()
    assert not again.with_suffix(".png").exists()


@pytest.mark.parametrize(
    "words",
    [
        "--pattern clustered --sites 8 --clusters 2 --hold none",
        "--pattern radial --sites 13 --spokes 6 --up y",
        "--pattern slices --slices 2 1 3 --offset 0.5 --angle 10",
        "--pattern bricks --brick 0.3 0.3 0.3 --support-level 0",
        "--sites 4 --stretch 1 1 3 --noise 0.01 0.4",
    ],
)
def test_fracture_knows_the_patterns(words, box, tmp_path, capsys):
    target = str(tmp_path / "a.npz")
    words = ["fracture", box, *words.split(), "--out", target, "--picture", "none"]
    assert cli.main(words) == 0
    assert len(serialize.load(target).destructible.meshes) > 4
    assert f"wrote {target}" in capsys.readouterr().out


def test_fracture_cuts_along_a_picture(box, tmp_path):
    picture = np.zeros((12, 8), np.uint8)
    picture[3:9, 2:6] = 255
    Image.fromarray(picture).save(tmp_path / "p.png")
    target = str(tmp_path / "a.npz")
    words = ["fracture", box, "--pattern", "cutout", "--picture", "none"]
    words += ["--bitmap", str(tmp_path / "p.png"), "--out", target]
    assert cli.main(words) == 0
    what = serialize.load(target).destructible
    volume = np.sort(what.asset.chunk_volume)
    inner = 0.25 * 0.6 * 0.3 * 0.9
    np.testing.assert_allclose(volume[0], inner, rtol=0.2)


@pytest.mark.slow
def test_the_main_job_breaks_a_file(box, tmp_path, capsys):
    target, shown = str(tmp_path / "a.npz"), str(tmp_path / "a.gif")
    assert cli.main(["fracture", box, "--sites", "6", "--out", target]) == 0
    words = ["--asset", target, "--batch", "2", "--steps", "6", "--out", shown]
    assert cli.main([*words, "--width", "64", "--height", "48", "--slots", "4"]) == 0
    assert "of 6 chunks" in capsys.readouterr().out
