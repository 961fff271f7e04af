"""Checks of the reference by hand, so that the oracle does not rest on data alone."""

import itertools

import numpy as np
import pytest

from tests import reference as ref


def cube(subdivided=False, world=False):
    """Build a root of 2 x 2 x 2 support chunks, bonded across faces.

    Each support chunk may have two children. The first four may be bonded to the world.
    """
    places = list(itertools.product((-0.5, 0.5), repeat=3))
    parent, centroid = [-1] + [0] * 8, [(0, 0, 0), *places]
    if subdivided:
        for chunk in range(1, 9):
            parent += [chunk] * 2
            centroid += [centroid[chunk]] * 2
    pairs, normals, centres = [], [], []
    for (i, a), (j, b) in itertools.combinations(enumerate(np.array(places), 1), 2):
        if np.abs(b - a).sum() == 1:
            pairs.append((i, j))
            normals.append(b - a)
            centres.append((a + b) / 2)
    if world:
        for i in range(1, 5):
            pairs.append((i, -1))
            normals.append((-1, 0, 0))
            centres.append(np.array(places[i - 1]) - (0.5, 0, 0))
    support = [1 <= i <= 8 for i in range(len(parent))]
    chunks = ref.Chunks(parent, support, centroid)
    return ref.Asset(chunks, ref.Bonds(pairs, normals, None, centres))


def test_falloff_shatters_the_cube():
    family = ref.Family(cube())
    around = dict(damage=2, position=(0, 0, 0), min_radius=100, max_radius=200)
    bonds, chunks = family.generate(0, "falloff", around)
    assert len(bonds) == 12 and not chunks
    events = family.apply(0, bonds, chunks)
    assert [health for *_, health in events.bonds] == [0] * 12
    result = family.split(0)
    assert sorted(result.children) == list(range(8)) and result.deleted
    assert result.children[-1] == 0  # the original comes last
    assert family.visible() == {i: [i + 1] for i in range(8)}


def test_falloff_fades_between_the_radii():
    at = np.array([0.5, 1.5, 3], np.float32)
    one, two = np.float32(1), np.float32(2)
    np.testing.assert_array_equal(ref.falloff(at, two, one, two), [2, 1, 0])
    np.testing.assert_array_equal(ref.cutter(at, two, one, two), [0, 2, 0])


def test_chunk_damage_detaches_a_node_that_is_not_the_root():
    family = ref.Family(cube(subdivided=True))
    events = family.apply(0, chunk_commands=[(3, 10)])
    assert not events.bonds and len(events.chunks) == 3
    result = family.split(0)
    assert result.children == [13, 0, 12]  # the last child took its parent's place
    assert family.visible()[0] == [1, 2, 4, 5, 6, 7, 8]
    assert family.chunk_actor[3] == ref.INV


def test_chunk_damage_of_the_root_ends_the_island():
    family = ref.Family(cube(subdivided=True))
    family.apply(0, chunk_commands=[(1, 10)])
    result = family.split(0)
    assert 0 not in family.actors and result.deleted
    # Of the neighbours 1, 2 and 4 the last one to lose its bond is seen first.
    assert sorted(result.children) == [4, 8, 9]
    assert family.node_island[1:] == [4] * 7


def test_excess_damage_spills_to_children():
    family = ref.Family(cube(subdivided=True))
    events = family.apply(0, chunk_commands=[(1, 2), (1, 5)])
    # 2 - 1 is shared by two children; a dead chunk takes no more damage.
    assert [e[1:] for e in events.chunks] == [(1, -1), (9, 0.5), (10, 0.5)]
    again = family.apply(0, chunk_commands=[(9, 1)])
    assert not again.chunks and again.warnings  # nobody owns chunk 9 yet


def test_a_scratched_chunk_falls_off_whole():
    family = ref.Family(cube(), chunk_health=1)
    family.apply(0, chunk_commands=[(8, 0.25)])
    assert family.split(0).children == [7, 0]
    assert family.chunk_health[7] == 0.75


def test_split_is_asked_for_only_when_an_edge_broke():
    family = ref.Family(cube())
    family.apply(0, [(0, 1, 0.5)])
    assert not family.split_required(0)
    family.apply(0, [(0, 1, 0.5)])
    assert family.split_required(0)
    assert not family.split(0).children and not family.split_required(0)


def test_world_holds_what_is_bonded_to_it():
    family = ref.Family(cube(world=True))
    assert family.asset.world == 8 and family.external(0)
    family.apply(0, [(i, i + 4, 1) for i in range(4)])
    assert family.split(0).children == [7, 0]
    assert family.external(0) and not family.external(7)


def test_commands_for_other_actors_warn():
    family = ref.Family(cube())
    family.apply(0, chunk_commands=[(8, 0.5)])
    family.split(0)
    events = family.apply(7, [(0, 1, 1)], [(1, 1)])
    assert len(events.warnings) == 2 and not events.bonds and not events.chunks


@pytest.mark.parametrize("record", ["separate", "in place"])
def test_short_buffers_lose_events_but_not_damage(record):
    family = ref.Family(cube())
    commands = [(a, b, 1) for a, b in family.asset.pair]
    events = family.apply(0, commands, record=record, bond_room=4)
    assert len(events.bonds) == 4 and len(events.warnings) == 1
    assert not family.bond_health.any()


def test_coverage_is_repaired_at_the_highest_place():
    #       0
    #     1   2
    #    3 4 5 6
    parent = [-1, 0, 0, 1, 1, 2, 2]
    only_4 = [i == 4 for i in range(7)]
    repaired, exact = ref.ensure_coverage(parent, only_4)
    assert not exact and repaired == [i in (2, 3, 4) for i in range(7)]
    redundant = [i in (1, 2, 3) for i in range(7)]
    assert ref.ensure_coverage(parent, redundant)[0] == [i in (1, 2) for i in range(7)]


def test_reordered_chunks_make_an_asset():
    parent, support = [2, 2, -1, 0, 0], [1, 1, 0, 0, 0]
    assert ref.rejection(parent, support) == "order"
    new_index, ordered = ref.reorder_map(parent, support)
    assert not ordered and new_index == [1, 2, 0, 3, 4]
    bonds = ref.Bonds([(0, -1), (2, 1)])
    moved, turned = ref.reorder(ref.Chunks(parent, support), bonds, new_index, True)
    assert moved.parent == [ref.INV, 0, 0, 1, 1] and ref.Asset(moved)
    assert turned.chunks == [(1, ref.INV), (0, 2)]
    assert turned.normal[:, 0].tolist() == [1, -1]


def test_senseless_bonds_are_dropped():
    chunks = ref.Chunks([-1, 0, 0], [0, 1, 1])
    bonds = ref.Bonds([(1, 1), (0, 1), (2, 1), (1, 2), (9, 1), (0, -1)])
    asset = ref.Asset(chunks, bonds)
    assert asset.warnings == ["invalid", "non-support", "duplicate"]
    assert asset.pair == [(0, 1)] and asset.bond_desc == [2]
    assert asset.world == 2  # even though its only bond was dropped


def test_unbreakable_and_odd_healths_resist():
    for health in (0, -1, np.nan, np.inf, ref.FLT_MAX):
        family = ref.Family(cube(), bond_health=health)
        family.apply(0, [(0, 1, 1e30)])
        assert family.bond_connects[0] and not family.split_required(0)


def test_damage_is_normalised_by_the_material():
    assert ref.normalized_damage(100, 0, 1, 50) == 0.5
    assert ref.normalized_damage(100, 0.6, 1, 50) == 0
    assert ref.normalized_damage(100, 0, 1, 500) == 1
    assert ref.normalized_damage(-1, 0, 0.9, 5) == np.float32(0.9)
