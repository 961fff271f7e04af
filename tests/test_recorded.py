"""The library and the reference against recordings of the C++ library."""

import pathlib

import numpy as np
import pytest

from tests import golden, recorded, replay

pytestmark = pytest.mark.usefixtures("strict")
DATA = pathlib.Path(__file__).parent / "data"


@pytest.mark.parametrize("kind", ["lowlevel", "desc"])
def test_recording_replays(kind, capsys):
    assert golden.main([kind, str(DATA / f"{kind}.npz")]) == 0
    assert ", 0 mismatches" in capsys.readouterr().out


def changed(value):
    """Return another value of the same type."""
    if value.dtype.kind == "f":
        return np.float32(1.5) if not value == 1.5 else np.float32(2.5)
    return value ^ value.dtype.type(1)


@pytest.mark.parametrize(
    "column",
    [
        "bcmd_health",
        "actor_vis",
        "state_bond_health",
        "adj_node",
        "split_child",
        "op_can_fracture",
        "chunk_leaf_count",
        "reorder_map",
        "raw_bond_area",
    ],
)
def test_changed_number_is_noticed(column, tmp_path):
    with np.load(DATA / "lowlevel.npz") as file:
        data = {name: file[name] for name in file.files}
    flat = data[column].reshape(-1)
    # In a late case, so that not only the first is read.
    at = int(0.7 * len(flat))
    flat[at] = changed(flat[at])
    np.savez(tmp_path / "changed.npz", **data)
    found = []
    try:
        for case in recorded.lowlevel_cases(tmp_path / "changed.npz"):
            found += replay.verify_lowlevel(case)
    except ValueError as error:
        found.append(str(error))
    assert found
