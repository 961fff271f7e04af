"""The command line: help, refusals, and one small run in a process of its own."""

import os
import subprocess
import sys

import pytest
from PIL import Image

from blastjax import __main__ as cli
from tests.conftest import CACHE

OPTIONS = ("--batch", "--steps", "--seed", "--out", "--show", "--fps", "--backend")


def test_help_names_every_option(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    assert all(option in said for option in OPTIONS)


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
    ],
)
def test_bad_options_exit_with_2(words, message, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 2
    said = capsys.readouterr()
    assert message in said.err and "Traceback" not in said.err


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
