"""Descriptions in Blast's form."""

import json

import numpy as np
import pytest

from blastjax import author
from blastjax.author import blast
from blastjax.core import NO_PARENT, WORLD


def described():
    chunks = [
        {"parent": None, "centroid": [0, 0, 0], "volume": 2, "flags": 0},
        {"parent": 0, "centroid": [0, 0, 0], "volume": 1, "flags": 1},
        {"parent": 0, "centroid": [1, 0, 0], "volume": 1, "flags": 1},
    ]
    bonds = [
        {
            "chunkIndices": [1, 2],
            "normal": [1, 0, 0],
            "area": 0.5,
            "centroid": [1, 2, 3],
        },
        {
            "chunkIndices": [2, None],
            "normal": [1, 0, 0],
            "area": 2,
            "centroid": [0] * 3,
        },
    ]
    bonds = [{**bond, "centroid": [1, 2, 3]} for bond in bonds]
    return {"chunks": chunks, "bonds": bonds}


def test_rows_become_an_asset(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(described()))
    for source in (described(), path):
        chunks, bonds = blast.read(source)
        assert chunks.parent.tolist() == [NO_PARENT, 0, 0]
        assert chunks.support.tolist() == [False, True, True]
        assert bonds.chunks.tolist() == [[1, 2], [2, WORLD]]
        asset = author.build(chunks, bonds).asset
        assert asset.has_world and asset.height == 1
        np.testing.assert_allclose(asset.bond_area, [0.5, 2.0])


def test_columns_and_blasts_own_spelling_say_the_same():
    rows = described()
    columns = {
        kind: {k: np.array([r[k] for r in rows[kind]], object).tolist() for k in keys}
        for kind, keys in (
            ("chunks", ("parent", "centroid", "volume", "flags")),
            ("bonds", ("chunkIndices", "normal", "area", "centroid")),
        )
    }
    none = 2**32 - 1
    native = {
        "chunks": [
            {
                "parentChunkDescIndex": none if c["parent"] is None else 0,
                "centroid": c["centroid"],
                "volume": c["volume"],
                "flags": c["flags"] | 2,
                "userData": 7,
            }
            for c in rows["chunks"]
        ],
        "bonds": [
            {
                "chunkIndices": [
                    2**32 - 1 if i is None else i for i in b["chunkIndices"]
                ],
                "bond": {k: b[k] for k in ("normal", "area", "centroid")},
            }
            for b in rows["bonds"]
        ],
    }
    wanted = blast.read(rows)
    for other in (columns, native):
        for one, same in zip(blast.read(other), wanted, strict=True):
            for field in vars(same):
                np.testing.assert_array_equal(getattr(one, field), getattr(same, field))


def test_written_descriptions_are_read_back(tmp_path):
    asset = author.shapes.wall(2, 2, root=True, pieces=(2, 1, 1))
    chunks, bonds = author.describe(asset)
    found, joints = blast.read(blast.write(tmp_path / "a.json", chunks, bonds))
    for field in ("parent", "centroid", "volume", "support"):
        np.testing.assert_array_equal(getattr(found, field), getattr(chunks, field))
    for field in ("chunks", "normal", "area", "centroid"):
        np.testing.assert_array_equal(getattr(joints, field), getattr(bonds, field))


def test_no_flags_and_no_bonds_are_allowed():
    rows = described()["chunks"]
    chunks, bonds = blast.read(
        {"chunks": [{k: v for k, v in r.items() if k != "flags"} for r in rows]}
    )
    assert chunks.support.tolist() == [False, True, True] and not len(bonds.area)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda d: d.pop("chunks"), "an object with a list 'chunks'"),
        (lambda d: d["chunks"][1].pop("volume"), "chunk 1 lacks 'volume'"),
        (lambda d: d["chunks"][1].update(mass=1), "chunk 1 has 'mass'"),
        (lambda d: d["chunks"][1].pop("flags"), "some chunks have 'flags'"),
        (
            lambda d: d["chunks"][1].update(parent=0.5),
            "parent has dtype float64",
        ),
        (lambda d: d["chunks"][1].update(parent=True), "parent 1 is True"),
        (lambda d: d["chunks"][1].update(parent=2**70), "must hold integers"),
        (lambda d: d["chunks"][1].update(centroid=[0]), "chunk centroid is ragged"),
        (lambda d: d["chunks"][1].update(volume=float("nan")), "chunk volume 1 is nan"),
        (lambda d: d["chunks"][1].update(volume="big"), "chunk volume has dtype"),
        (lambda d: d["chunks"].append(3), "chunk 3 is 3; it must be an object"),
        (lambda d: d["bonds"][0].update(area=-1), "bond 0 has area -1"),
        (lambda d: d["bonds"][0].update(chunkIndices=[1]), "chunkIndices is ragged"),
        (lambda d: d.update(bonds=7), "bonds must be a list"),
    ],
)
def test_bad_descriptions_are_refused(change, message):
    data = described()
    change(data)
    with pytest.raises(ValueError, match=message):
        blast.read(data)


def test_files_that_are_no_json_are_refused(tmp_path):
    path = tmp_path / "a.json"
    for data in (b"{", b"\xff\xfe\x00", b"[" * 100000, b"[]"):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"no JSON|no description"):
            blast.read(path)
