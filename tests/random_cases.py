"""Random assets and damage, run through the reference, as a recording has them."""

import numpy as np

from tests import reference
from tests.replay import KINDS, parameters

# A few sizes, since every size costs a compilation: chunks above the support level,
# support chunks, chunks below it, bonds, the world among them.
SIZES = (
    (0, 1, 0, 0, False),
    (1, 3, 4, 3, True),
    (3, 8, 9, 12, False),
    (2, 12, 0, 24, True),
)


def random_case(seed, size, rounds=3):
    """Make a case of the given size; everything else is random."""
    rng = np.random.default_rng(seed)
    chunks, bonds = random_descriptions(rng, *size)
    support, exact = reference.ensure_coverage(chunks.parent, chunks.support)
    covered = reference.Chunks(
        chunks.parent, support, chunks.centroid, chunks.volume, chunks.userdata
    )
    new_index, ordered = reference.reorder_map(chunks.parent, support)
    keep = bool(rng.random() < 0.5)
    moved, moved_bonds = covered, bonds
    if not ordered:
        moved, moved_bonds = reference.reorder(covered, bonds, new_index, keep)
    asset = reference.Asset(moved, moved_bonds)
    bond_health = random_healths(rng, asset.n_bond)
    chunk_health = random_healths(rng, asset.n_node)
    family = reference.Family(asset, bond_health, chunk_health)
    children = [c or [reference.INV] for c in asset.children]
    case = {
        "case_flags": 0,
        "case_create_raw_ok": not reference.rejection(chunks.parent, chunks.support),
        "case_create_cov_ok": not reference.rejection(chunks.parent, support),
        "case_cov_ret": exact,
        "case_map_ret": ordered,
        "case_keep_normal_order": keep,
        "case_create_warnings": len(asset.warnings),
        "case_n_leaf": sum(not c for c in asset.children),
        "case_n_bond": asset.n_bond,
        "case_first_sub": asset.first_sub,
        "case_bond_health_mode": 1,
        "case_chunk_health_mode": 1,
        "case_n_round": rounds,
        "init_bond_health": bond_health,
        "init_chunk_health": chunk_health,
        "raw_chunk_parent": chunks.parent,
        "raw_chunk_flags": np.array(chunks.support, int),
        "raw_chunk_centroid": chunks.centroid,
        "raw_chunk_volume": chunks.volume,
        "raw_chunk_userdata": np.array(chunks.userdata),
        "raw_bond_chunks": bonds.chunks,
        "raw_bond_normal": bonds.normal,
        "raw_bond_area": bonds.area,
        "raw_bond_centroid": bonds.centroid,
        "raw_bond_userdata": np.array(bonds.userdata),
        "cov_chunk_flags": np.array(support, int),
        "reorder_map": new_index,
        "re_chunk_parent": moved.parent,
        "re_chunk_flags": np.array(moved.support, int),
        "re_bond_chunks": np.reshape(moved_bonds.chunks, (-1, 2)),
        "re_bond_normal": moved_bonds.normal,
        "chunk_parent": asset.chunk_parent,
        "chunk_centroid": asset.chunk_centroid,
        "chunk_volume": asset.chunk_volume,
        "chunk_userdata": asset.chunk_userdata,
        "chunk_first_child": [c[0] for c in children],
        "chunk_child_stop": [c[-1] + (c[0] != reference.INV) for c in children],
        "chunk_leaf_count": asset.leaf_count,
        "chunk_node": asset.chunk_node,
        "node_chunk": np.array(asset.node_chunk),
        "bond_normal": asset.bond_normal,
        "bond_area": asset.bond_area,
        "bond_centroid": asset.bond_centroid,
        "bond_userdata": asset.bond_userdata,
        "adj_node": [node for entries in asset.adjacency for node, _ in entries],
        "adj_bond": [bond for entries in asset.adjacency for _, bond in entries],
        "adj_partition": np.cumsum([0, *map(len, asset.adjacency)]),
        "ops": [[]],
        "splits": [[]],
        "states": [snapshot(family)],
    }
    for number in range(1, rounds + 1):
        ops = []
        for _ in range(rng.integers(1, 3)):
            ops.append(random_op(rng, family, number))
        splits = []
        for actor in sorted(family.actors):
            if actor in family.actors:
                family.split(actor)
                splits.append({"split_actor": actor})
        case["ops"].append(ops)
        case["splits"].append(splits)
        case["states"].append(snapshot(family))
    return case


def random_descriptions(rng, supers, supports, subs, bonds, world):
    """Describe a random hierarchy and support graph, shuffled, flags often inexact."""
    parent = [rng.integers(-1, i) if i else -1 for i in range(supers)]
    for _ in range(supports):
        parent.append(rng.integers(0, supers) if supers else -1)
    for i in range(subs):
        parent.append(rng.integers(supers, supers + supports + i))
    # An upper chunk without children would be a support chunk: give each a share.
    for i in range(supers):
        if i not in parent[supers : supers + supports]:
            parent[supers + i] = i
    count = supers + supports + subs
    support = np.zeros(count, bool)
    support[supers : supers + supports] = True
    if rng.random() < 0.3 and subs:
        support[rng.integers(supers + supports, count)] = True  # redundant
    nodes = np.arange(supers, supers + supports)
    pairs = [(a, b) for a in nodes for b in nodes if a < b]
    if world:
        pairs += [(a, -1) for a in nodes]
    chosen = [pairs[i] for i in rng.permutation(len(pairs))[:bonds]]
    if world and not any(b == -1 for _, b in chosen):
        chosen[0] = (nodes[0], -1)
    order = rng.permutation(count)
    place = np.argsort(order)
    ends = np.array(chosen, int).reshape(-1, 2)
    ends = np.where(ends < 0, -1, place[ends])
    turn = rng.random(len(ends)) < 0.5
    ends[turn] = ends[turn, ::-1]
    normal = rng.normal(size=(len(ends), 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    moved_parent = [-1 if parent[i] < 0 else int(place[parent[i]]) for i in order]
    return (
        reference.Chunks(
            moved_parent,
            support[order],
            rng.uniform(-2, 2, (count, 3)),
            rng.uniform(0.1, 2, count),
        ),
        reference.Bonds(
            [tuple(map(int, e)) for e in ends],
            normal,
            rng.uniform(0, 1, len(ends)),
            rng.uniform(-2, 2, (len(ends), 3)),
        ),
    )


def random_healths(rng, count):
    """Mostly ordinary healths, some of the odd ones that Blast takes without a word."""
    health = rng.uniform(0.2, 2, count).astype(np.float32)
    odd = rng.random(count) < 0.05
    values = np.array([0, -1, np.nan, np.inf, np.finfo(np.float32).max], np.float32)
    health[odd] = rng.choice(values, odd.sum())
    return health


def random_op(rng, family, number):
    """Do a random damage to a random actor of the family; return its record."""
    actor = int(rng.choice(sorted(family.actors)))
    kind = int(rng.integers(0, 7))
    params = np.zeros(16, np.float32)
    if kind:
        params[0] = rng.uniform(0.1, 3)
        params[1:10] = rng.uniform(-2, 2, 9)
        if kind == 4:
            params[4:7] /= np.linalg.norm(params[4:7])
        params[10:12] = np.sort(rng.uniform(0.1, 4, 2))
        params[14] = kind == 6
        program = KINDS[kind]
        bonds, chunks = family.generate(actor, program, parameters(program, params))
    else:
        bonds, chunks = random_commands(rng, family)
    before = healths(family)
    family.apply(actor, bonds, chunks)
    after = healths(family)
    changed = (before != after) & (after != 0) & np.isfinite(after)
    return {
        "op_kind": kind,
        "op_round": number,
        "op_actor": actor,
        "op_params": params,
        "bcmd_nodes": np.array([c[:2] for c in bonds], int).reshape(-1, 2),
        "bcmd_health": np.array([c[2] for c in bonds], np.float32),
        "ccmd_chunk": np.array([c[0] for c in chunks], int),
        "ccmd_health": np.array([c[1] for c in chunks], np.float32),
        "op_margin": np.abs(after[changed]).min(initial=np.inf),
        "op_can_fracture": family.can_fracture(actor),
        "op_split_required": family.split_required(actor),
    }


def random_commands(rng, family):
    """Explicit commands, odd amounts and doubles among them."""
    asset = family.asset
    amounts = [0, -1, np.nan, np.inf, 0.3, 0.5, 0.7, 1.1, 2.3]

    def amount():
        return np.float32(rng.choice(amounts) * rng.uniform(0.9, 1.1))

    bonds = [
        (*asset.pair[rng.integers(asset.n_bond)], amount())
        for _ in range(rng.integers(0, 5) if asset.n_bond else 0)
    ]
    chunks = [
        (int(rng.integers(asset.n_chunk)), amount()) for _ in range(rng.integers(0, 4))
    ]
    return bonds, chunks


def healths(family):
    """All healths in one array."""
    return np.concatenate([family.bond_health, family.chunk_health])


def snapshot(family):
    """Record the state."""
    visible = family.visible()
    return {
        "bond_health": family.bond_health.copy(),
        "chunk_health": family.chunk_health.copy(),
        "chunk_actor": np.array(family.chunk_actor),
        "node_island": np.array(family.node_island),
        "actors": [
            {
                "actor_index": index,
                "actor_graph_node_count": len(actor.nodes),
                "nodes": [n for n in actor.nodes if n != family.asset.world],
                "visible": visible[index],
                "actor_external": family.external(index),
                "actor_can_fracture": family.can_fracture(index),
                "actor_split_required": family.split_required(index),
            }
            for index, actor in sorted(family.actors.items())
        ],
    }
