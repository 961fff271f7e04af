"""Damaged recordings end with the one line, and red."""

import pathlib

import numpy as np
import pytest

from tests import golden

DATA = pathlib.Path(__file__).parent / "data"


def stored(tmp_path, **columns):
    """Write the compact descriptors with some columns changed; None leaves one out."""
    with np.load(DATA / "desc.npz") as file:
        data = {name: file[name] for name in file.files} | columns
    path = tmp_path / "changed.npz"
    np.savez(path, **{k: v for k, v in data.items() if v is not None})
    return path


def ends_red(kind, path, capsys):
    """Whether a replay ends with its one line and the code 1."""
    code = golden.main([kind, str(path)])
    last = capsys.readouterr().out.splitlines()[-1]
    return (
        code == 1 and last.startswith(f"{kind}: 0 cases") and ", 1 mismatches" in last
    )


@pytest.mark.parametrize("kind", golden.KINDS)
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_truncated_file_is_red(kind, share, tmp_path, capsys):
    whole = (DATA / f"{kind}.npz").read_bytes()
    path = tmp_path / "cut.npz"
    path.write_bytes(whole[: int(share * len(whole))])
    assert ends_red(kind, path, capsys)


@pytest.mark.parametrize("seed", range(20))
def test_flipped_bytes_are_red_or_change_no_number(seed, tmp_path, capsys):
    rng = np.random.default_rng(seed)
    whole = bytearray((DATA / "desc.npz").read_bytes())
    for at in rng.integers(len(whole), size=2):
        whole[at] ^= 1 << int(rng.integers(8))
    path = tmp_path / "flipped.npz"
    path.write_bytes(whole)
    if ends_red("desc", path, capsys):
        return
    with np.load(DATA / "desc.npz") as ours, np.load(path) as theirs:
        assert ours.files == theirs.files
        for name in ours.files:
            np.testing.assert_array_equal(ours[name], theirs[name])


@pytest.mark.parametrize(
    "columns",
    [
        {"desc_map": None},
        {"desc_id": None},
        {"desc_n_chunk": np.zeros(300)},
        {"material_hmmdo": np.zeros((300, 4), np.float32)},
        {"desc_parent": np.zeros((2214, 1), np.uint32)},
        {"desc_flags": np.array([None])},
        {"desc_id": np.uint32(1)},
    ],
    ids=repr,
)
def test_wrong_column_is_red(columns, tmp_path, capsys):
    assert ends_red("desc", stored(tmp_path, **columns), capsys)


def test_no_file_and_no_recording_are_red(tmp_path, capsys):
    assert ends_red("desc", tmp_path / "missing.npz", capsys)
    np.save(tmp_path / "array.npy", np.arange(3))
    assert ends_red("stress", tmp_path / "array.npy", capsys)
    assert ends_red("lowlevel", DATA / "desc.npz", capsys)


def test_count_beyond_memory_is_red(tmp_path, capsys):
    with np.load(DATA / "lowlevel.npz") as file:
        data = {name: file[name] for name in file.files}
    data["case_n_round"][0] = 2**31
    np.savez(tmp_path / "changed.npz", **data)
    assert ends_red("lowlevel", tmp_path / "changed.npz", capsys)
