"""A slow, plain-Python Blast: the oracle of the test suite.

It follows the low-level library of NVIDIA Blast 5 to the last bit and the last list
order: descriptors -> asset -> family -> damage commands -> events -> split actors.
Nothing here knows jax.

Words, as in Blast: a *support chunk* is a chunk that bonds can join; *upper* chunks are
the support chunks and their ancestors, *sub-support* chunks their descendants. A *node*
is a support chunk, or the world, which is the last node. A *slot* holds one health and
names one actor at most: first the nodes, then the sub-support chunks.

All floats are float32, each operation rounded on its own and sums taken from left to
right, so that results can be compared bit by bit. Indices are Python ints, INV for none
or for the world; -1 is accepted for INV wherever a parent or a bond's chunk is given.
"""

import collections
import dataclasses
import itertools

import numpy as np

INV = 2**32 - 1
"""No chunk, no node, no actor; the parent of a root; the world's chunk."""
F32 = np.float32
FLT_MAX = np.finfo(F32).max
UNBREAKABLE = F32(0.5) * FLT_MAX
"""Healths from here up cannot be damaged."""


def indices(values):
    """Python ints of index values, -1 read as INV."""
    return [int(v) & INV for v in np.asarray(values).ravel()]


def floats(values, *shape):
    """Fresh float32 array of the given shape."""
    return np.array(values, F32).reshape(shape)


def can_damage(health):
    """Whether damage changes this health: not if <= 0, NaN, infinite or unbreakable."""
    return (health > 0) & (health < UNBREAKABLE)


def dot(a, b):
    """Dot products of vectors in the last axis, summed from left to right."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a, b):
    """Cross products of vectors in the last axis."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def length(a):
    """Lengths of vectors in the last axis."""
    return np.sqrt(dot(a, a))


def normalized_damage(health, minimum, maximum, damage):
    """Damage as a part of the material's health, cut at its two thresholds."""
    with np.errstate(all="ignore"):
        share = F32(damage) / F32(health) if health > 0 else F32(1)
    if not share > minimum:
        return F32(0)
    return share if share < maximum else F32(maximum)


# Descriptors


@dataclasses.dataclass
class Chunks:
    """Descriptions of chunks; row i of every array belongs to chunk i."""

    parent: list[int]
    support: list[bool]
    centroid: np.ndarray | None = None
    volume: np.ndarray | None = None
    userdata: list[int] | None = None

    def __post_init__(self):
        n = len(self.parent)
        self.parent = indices(self.parent)
        self.support = [bool(s) for s in self.support]
        self.centroid = floats(
            np.zeros(3 * n) if self.centroid is None else self.centroid, n, 3
        )
        self.volume = floats(np.ones(n) if self.volume is None else self.volume, n)
        self.userdata = indices(range(n) if self.userdata is None else self.userdata)


@dataclasses.dataclass
class Bonds:
    """Descriptions of bonds; a bond's second or first chunk may be INV, the world."""

    chunks: list[tuple[int, int]] = ()
    normal: np.ndarray | None = None
    area: np.ndarray | None = None
    centroid: np.ndarray | None = None
    userdata: list[int] | None = None

    def __post_init__(self):
        n = len(self.chunks)
        ends = indices(self.chunks)
        self.chunks = list(zip(ends[::2], ends[1::2], strict=True))
        self.normal = floats(
            np.tile([1, 0, 0], n) if self.normal is None else self.normal, n, 3
        )
        self.area = floats(np.ones(n) if self.area is None else self.area, n)
        self.centroid = floats(
            np.zeros(3 * n) if self.centroid is None else self.centroid, n, 3
        )
        self.userdata = indices(range(n) if self.userdata is None else self.userdata)


def ancestors(parent, chunk):
    """Yield the parent of a chunk, its parent, and so on up to the root."""
    while (chunk := parent[chunk]) != INV:
        yield chunk


def has_loop(parent):
    """Whether following parents from some chunk never ends."""
    for chunk in range(len(parent)):
        for steps, _ in enumerate(ancestors(parent, chunk)):
            if steps >= len(parent):
                return True
    return False


def ensure_coverage(parent, support):
    """Repair flags so that every leaf has exactly one support chunk above or at it.

    Returns the flags, and whether they were right already. Parents must have no loops.
    """
    parent = indices(parent)
    kept = [
        bool(flag) and not any(support[a] for a in ancestors(parent, chunk))
        for chunk, flag in enumerate(support)
    ]
    below = list(kept)  # has support at or below it
    for chunk, flag in enumerate(kept):
        if flag:
            for ancestor in ancestors(parent, chunk):
                below[ancestor] = True

    def missing(chunk):
        topmost = parent[chunk] == INV or below[parent[chunk]]
        covered = below[chunk] or any(kept[a] for a in ancestors(parent, chunk))
        return topmost and not covered

    repaired = [flag or missing(chunk) for chunk, flag in enumerate(kept)]
    return repaired, repaired == [bool(flag) for flag in support]


def is_upper(parent, support):
    """List whether each chunk is a support chunk or has one below it."""
    upper = [bool(flag) for flag in support]
    for chunk, flag in enumerate(support):
        if flag:
            for ancestor in ancestors(parent, chunk):
                upper[ancestor] = True
    return upper


def reorder_map(parent, support):
    """Find the order in which an asset can be created.

    Returns the new index of every chunk, and whether the order was right already (this
    asks for more than `rejection`: parents in order of their children's groups).
    Returns (None, False) if support coverage is inexact.
    """
    parent = indices(parent)
    if not ensure_coverage(parent, support)[1]:
        return None, False
    upper = is_upper(parent, support)
    order = list(range(len(parent)))
    position = list(order)

    def key(chunk):
        above = -1 if parent[chunk] == INV else position[parent[chunk]]
        return not upper[chunk], above

    ordered = True
    while any(key(a) > key(b) for a, b in itertools.pairwise(order)):
        ordered = False
        order.sort(key=key)  # by the parents' positions before this pass
        position = list(np.argsort(order))
    return [int(p) for p in position], ordered


def reorder(chunks, bonds, new_index, keep_normal_order=False):
    """Move chunk i to new_index[i] and rename parents and the bonds' chunks.

    With keep_normal_order, the normal of a bond whose chunk indices change their order
    is negated, so that it still points from the lower to the higher one.
    """
    n = len(new_index)
    order = np.argsort(new_index)

    def rename(chunk):
        return new_index[chunk] if chunk < n else chunk

    ends = [(rename(a), rename(b)) for a, b in bonds.chunks]
    normal = bonds.normal.copy()
    for i, ((a, b), (c, d)) in enumerate(zip(bonds.chunks, ends, strict=True)):
        if keep_normal_order and (a < b) != (c < d):
            normal[i] = -normal[i]
    moved = Chunks(
        parent=[rename(chunks.parent[i]) for i in order],
        support=[chunks.support[i] for i in order],
        centroid=chunks.centroid[order],
        volume=chunks.volume[order],
        userdata=[chunks.userdata[i] for i in order],
    )
    return moved, dataclasses.replace(bonds, chunks=ends, normal=normal)


def rejection(parent, support):
    """Say why these chunks make no asset: loop, coverage, order; None if they do."""
    parent = indices(parent)
    if has_loop(parent):
        return "loop"
    if not ensure_coverage(parent, support)[1]:
        return "coverage"
    upper = is_upper(parent, support)
    groups = [p for i, p in enumerate(parent) if i == 0 or p != parent[i - 1]]
    roots_first = INV not in parent[parent.count(INV) :]
    parents_first = all(p < i for i, p in enumerate(parent) if p != INV)
    contiguous = len(groups) == len(set(groups))
    uppers_first = upper == sorted(upper, reverse=True)
    ordered = roots_first and parents_first and contiguous and uppers_first
    return None if ordered else "order"


# The asset


class Asset:
    """What all instances share: the chunk hierarchy and the support graph.

    Raises ValueError when Blast would return NULL. Bonds that make no sense are
    dropped, with one entry in `warnings` for each of three kinds.
    """

    def __init__(self, chunks, bonds=None):
        reason = rejection(chunks.parent, chunks.support)
        if reason:
            raise ValueError(f"no asset can be made of these chunks: {reason}")
        bonds = Bonds() if bonds is None else bonds
        n = len(chunks.parent)
        self.chunk_parent = chunks.parent
        self.chunk_centroid = chunks.centroid
        self.chunk_volume = chunks.volume
        self.chunk_userdata = chunks.userdata
        upper = is_upper(chunks.parent, chunks.support)
        self.first_sub = sum(upper)
        """Number of upper chunks, which is the first sub-support chunk."""

        self.children = [[] for _ in range(n)]
        for chunk, parent in enumerate(chunks.parent):
            if parent != INV:
                self.children[parent].append(chunk)
        self.leaf_count = [0] * n
        for chunk in reversed(range(n)):  # children come after parents
            below = sum(self.leaf_count[c] for c in self.children[chunk])
            self.leaf_count[chunk] = below or 1

        self.node_chunk = [i for i in range(n) if chunks.support[i]]
        self.chunk_node = [INV] * n
        for node, chunk in enumerate(self.node_chunk):
            self.chunk_node[chunk] = node
        self.n_support = len(self.node_chunk)
        self._make_bonds(bonds)

        self.n_chunk, self.n_node, self.n_bond = n, len(self.node_chunk), len(self.pair)
        self.n_lower = self.n_node + n - self.first_sub
        """Number of slots: of healths, and of actors at most."""

    def _make_bonds(self, bonds):
        """Keep the good bonds, in the order of their nodes, and link the nodes."""
        n = len(self.chunk_parent)
        dropped = set()
        kept = {}
        has_world = False
        for i, (a, b) in enumerate(bonds.chunks):
            if a == b or any(c >= n and c != INV for c in (a, b)):
                dropped.add("invalid")
                continue
            has_world |= INV in (a, b)
            nodes = [self.n_support if c == INV else self.chunk_node[c] for c in (a, b)]
            if INV in nodes:
                dropped.add("non-support")
            elif (pair := (min(nodes), max(nodes))) in kept:
                dropped.add("duplicate")
            else:
                kept[pair] = i
        self.warnings = [
            w for w in ("invalid", "non-support", "duplicate") if w in dropped
        ]
        self.world = INV
        """The world's node, INV if nothing can be bonded to it."""
        if has_world:
            self.world = self.n_support
            self.node_chunk.append(INV)

        self.pair = sorted(kept)
        """The two nodes of every bond, the lower first."""
        self.bond_desc = [kept[pair] for pair in self.pair]
        """Which description every bond comes from."""
        self.bond_normal = bonds.normal[self.bond_desc]
        self.bond_area = bonds.area[self.bond_desc]
        self.bond_centroid = bonds.centroid[self.bond_desc]
        self.bond_userdata = [bonds.userdata[i] for i in self.bond_desc]
        self.bond_between = {pair: bond for bond, pair in enumerate(self.pair)}
        self.adjacency = [[] for _ in self.node_chunk]
        """(neighbour, bond) of every node, in ascending order."""
        for bond, (low, high) in enumerate(self.pair):
            self.adjacency[low].append((high, bond))
            self.adjacency[high].append((low, bond))
        for entries in self.adjacency:
            entries.sort()

    @property
    def size(self):
        """Bytes that Blast needs for this asset."""
        records = [
            96,  # header
            32 * self.n_chunk,
            32 * self.n_bond,
            4 * self.n_chunk,
            4 * self.n_chunk,  # leaf counts, chunk to node
            4 * self.n_node,
            4 * (self.n_node + 1),  # node to chunk, adjacency ranges
            8 * self.n_bond,
            8 * self.n_bond,  # adjacent nodes, adjacent bonds
        ]
        return sum((r + 15) // 16 * 16 for r in records)

    def slot(self, chunk):
        """Where the health of a chunk is; INV above the support chunks."""
        if chunk >= self.first_sub:
            return self.n_node + chunk - self.first_sub
        return self.chunk_node[chunk]

    def subtree(self, chunk):
        """Yield a chunk and all chunks below it."""
        yield chunk
        for child in self.children[chunk]:
            yield from self.subtree(child)


# One instance


class Actor:
    """A piece of a family: graph nodes in list order, or one sub-support chunk."""

    def __init__(self, index, nodes=(), chunk=INV):
        self.index = index
        self.nodes = list(nodes)
        """Graph nodes, the world included; empty for a sub-support chunk."""
        self.chunk = chunk
        """The sub-support chunk, INV for an actor with graph nodes."""
        self.dirty = []
        """Nodes that lost a bond since the last split, which takes the last first."""


@dataclasses.dataclass
class Events:
    """What `Family.apply` did."""

    bonds: list = dataclasses.field(default_factory=list)
    """(userdata, node0, node1, health afterwards)"""
    chunks: list = dataclasses.field(default_factory=list)
    """(userdata, chunk, health afterwards)"""
    warnings: list = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Split:
    """What `Family.split` did."""

    children: list
    """Indices of the actors that the split reports."""
    deleted: bool
    """Whether Blast reports the actor that was split as deleted."""
    warnings: list


class Family:
    """One instance of an asset: healths, and the actors it has come apart into.

    Healths are one number for all, or an array: one per bond, one per graph node (a
    sub-support chunk starts with that of the support chunk above it).
    """

    def __init__(self, asset, bond_health=1.0, chunk_health=1.0):
        self.asset = asset
        self.bond_health = np.empty(asset.n_bond, F32)
        self.bond_health[:] = bond_health
        self.chunk_health = np.zeros(asset.n_lower, F32)
        if np.ndim(chunk_health) == 0:
            self.chunk_health[:] = chunk_health
        else:
            for node in range(asset.n_support):
                for chunk in asset.subtree(asset.node_chunk[node]):
                    self.chunk_health[asset.slot(chunk)] = chunk_health[node]
        self.bond_connects = [True] * asset.n_bond
        """Whether islands reach across the bond; starts true at any health."""
        self.is_dirty = [False] * asset.n_node
        self.node_island = [INV] * asset.n_node
        for node in range(asset.n_node):
            if self.node_island[node] == INV:
                for member in self.component(node):
                    self.node_island[member] = node
        self.chunk_actor = [0] * asset.first_sub
        """The actor that owns each upper chunk, INV if none owns all of it."""
        self.actors = {0: Actor(0, range(asset.n_node))}
        """All active actors, by index."""

    # Queries

    def component(self, node):
        """List the nodes that a node reaches across bonds."""
        found = {node: None}
        queue = [node]
        while queue:
            for other, bond in self.asset.adjacency[queue.pop()]:
                if other not in found and self.bond_connects[bond]:
                    found[other] = None
                    queue.append(other)
        return list(found)

    def slot(self, index):
        """Health slot of an actor that has no or one graph node."""
        actor = self.actors[index]
        return self.asset.slot(actor.chunk) if not actor.nodes else actor.nodes[0]

    def lone_chunk(self, index):
        """Chunk of an actor that has no or one graph node."""
        actor = self.actors[index]
        return self.asset.node_chunk[actor.nodes[0]] if actor.nodes else actor.chunk

    def visible(self):
        """Map every actor to the sorted list of chunks that show it."""
        shown = {i: [] if a.nodes else [a.chunk] for i, a in self.actors.items()}
        for chunk, owner in enumerate(self.chunk_actor):
            parent = self.asset.chunk_parent[chunk]
            hidden = parent != INV and self.chunk_actor[parent] == owner
            if owner != INV and not hidden:
                shown[owner].append(chunk)
        return shown

    def can_fracture(self, index):
        """Whether damage could still do anything to an actor."""
        if len(self.actors[index].nodes) > 1:
            return True
        return bool(self.chunk_health[self.slot(index)] > 0)

    def is_brittle(self, index):
        """Whether an actor is one dead chunk that falls into its children."""
        chunk = self.lone_chunk(index)
        dead = self.chunk_health[self.slot(index)] <= 0
        return bool(dead) and chunk != INV and bool(self.asset.children[chunk])

    def split_required(self, index):
        """Whether a split could change an actor."""
        actor = self.actors[index]
        return bool(actor.dirty) if len(actor.nodes) > 1 else self.is_brittle(index)

    def external(self, index):
        """Whether an actor is bonded to the world."""
        world = self.asset.world
        return world != INV and self.node_island[world] == index

    def max_split(self, index):
        """Room that a split of an actor may need for new actors."""
        actor, asset = self.actors[index], self.asset
        chunks = [asset.node_chunk[n] for n in actor.nodes] or [actor.chunk]
        return sum(asset.leaf_count[c] for c in chunks if c != INV) + 1

    # Damage

    def generate(self, index, kind, params):
        """Run a damage program on an actor.

        kind is one of PROGRAMS, params maps names to numbers: damage, position, and
        what the program's function says. Returns bond commands (node0, node1, damage)
        and chunk commands (chunk, damage).
        """
        params = {name: F32(value) for name, value in params.items()}
        graph, subgraph = PROGRAMS[kind]
        with np.errstate(all="ignore"):
            if len(self.actors[index].nodes) > 1:
                return graph(self, self.actors[index], **params)
            return [], subgraph(self.asset, self.lone_chunk(index), **params)

    def apply(
        self,
        index,
        bond_commands=(),
        chunk_commands=(),
        *,
        record="separate",
        bond_room=INV,
        chunk_room=INV,
    ):
        """Take health from chunks, then from bonds.

        record: "separate" event buffers, "in place" of the commands (which changes the
        order of events), or "nothing". The rooms are the capacities of the buffers;
        events beyond them are lost.
        """
        events = Events()
        with np.errstate(all="ignore"):
            self._damage_chunks(index, chunk_commands, events, record == "in place")
            self._damage_bonds(index, bond_commands, events)
        if record == "nothing":
            return Events(warnings=events.warnings)
        if len(events.chunks) > chunk_room:
            events.warnings.append("chunk events lost")
        if len(events.bonds) > bond_room:
            events.warnings.append("bond events lost")
        del events.bonds[bond_room:], events.chunks[chunk_room:]
        return events

    def _owner(self, chunk):
        """Actor that owns a chunk, INV if there is none."""
        if chunk == INV:
            return INV
        if chunk < self.asset.first_sub:
            return self.chunk_actor[chunk]
        slot = self.asset.slot(chunk)
        return slot if slot in self.actors else INV

    def _damage_chunks(self, index, commands, events, spread_last):
        asset = self.asset
        for chunk, damage in commands:
            slot, damage = asset.slot(chunk), F32(damage)
            if slot == INV or not can_damage(self.chunk_health[slot]) or not damage > 0:
                continue
            owner = self._owner(chunk)
            if owner != index:
                events.warnings.append("chunk of another actor")
                continue
            if slot < asset.n_node and len(self.actors[index].nodes) > 1:
                self._detach(index, slot)
            self._hit_chunk(chunk, damage, events)
            if not spread_last:
                self._spread_excess(events.chunks[-1], events)
        if spread_last:
            for event in list(events.chunks):
                self._spread_excess(event, events)

    def _hit_chunk(self, chunk, damage, events):
        slot = self.asset.slot(chunk)
        self.chunk_health[slot] -= damage
        event = self.asset.chunk_userdata[chunk], chunk, self.chunk_health[slot]
        events.chunks.append(event)

    def _spread_excess(self, event, events):
        _, chunk, health = event
        if health < 0:
            self._spread(chunk, -health, events)

    def _spread(self, chunk, excess, events):
        """Share out damage among the children of a chunk, and on to theirs."""
        children = self.asset.children[chunk]
        if not children:
            return
        share = excess / F32(len(children))
        for child in children:
            slot = self.asset.slot(child)
            before = self.chunk_health[slot]
            if can_damage(before):
                self._hit_chunk(child, share, events)
                rest = share - before
                if self.chunk_health[slot] <= 0 and rest > 0:
                    self._spread(child, rest, events)

    def _detach(self, index, node):
        """Break all bonds of a node, even those that damage would not break."""
        for other, bond in self.asset.adjacency[node]:
            if self.bond_health[bond] > 0:
                self.bond_health[bond] = 0
            if self.bond_connects[bond]:
                self.bond_connects[bond] = False
                self._mark_dirty(index, other)
        self._mark_dirty(index, node)

    def _mark_dirty(self, index, node):
        if not self.is_dirty[node]:
            self.is_dirty[node] = True
            self.actors[index].dirty.append(node)

    def _damage_bonds(self, index, commands, events):
        asset = self.asset
        for node0, node1, damage in commands:
            owners = {self._owner(asset.node_chunk[n]) for n in (node0, node1)} - {INV}
            if len(owners) == 2:
                continue
            if owners != {index}:
                events.warnings.append("bond of another actor")
                continue
            bond = asset.bond_between.get((min(node0, node1), max(node0, node1)))
            if bond is None:
                continue
            damage = F32(damage)
            if can_damage(self.bond_health[bond]) and damage > 0:
                self.bond_health[bond] -= damage
                if self.bond_health[bond] <= 0:
                    self.bond_health[bond] = 0
                    if self.bond_connects[bond]:
                        self.bond_connects[bond] = False
                        self._mark_dirty(index, node0)
                        self._mark_dirty(index, node1)
            health = self.bond_health[bond]
            events.bonds.append((asset.bond_userdata[bond], node0, node1, health))

    # Splitting

    def split(self, index, max_new=INV):
        """Replace an actor by the pieces that it has come apart into.

        max_new is the room for reported actors; less than `max_split` is misuse.
        """
        warnings = []
        if len(self.actors[index].nodes) > 1:
            new = self._separate(index, max_new)
        elif self.is_brittle(index):
            new = self._release(index, max_new, warnings)
        else:
            new = []
        i = 0
        while i < len(new):
            if len(self.actors[new[i]].nodes) > 1 or not self.is_brittle(new[i]):
                i += 1
                continue
            new += self._release(new[i], max_new - len(new), warnings)
            new[i] = new[-1]
            new.pop()
        return Split(new, bool(new), warnings)

    def _separate(self, index, max_new):
        """Give every island of an actor an actor of its own."""
        actor = self.actors[index]
        self._find_islands(actor)
        pieces = {}
        for node in actor.nodes:
            pieces.setdefault(self.node_island[node], []).append(node)
        stay = pieces.pop(index, [])
        for island, nodes in pieces.items():
            self.actors[island] = Actor(island, reversed(nodes))
        actor.nodes = stay
        new = list(pieces)
        if stay:
            new.append(index)
        else:
            del self.actors[index]
        new = new[:max_new]
        if len(new) <= 1:
            return []
        for i in new:
            self._claim(i)
        shown = self.visible()
        for i in new:
            if not shown[i]:
                del self.actors[i]
        return [i for i in new if i in self.actors]

    def _find_islands(self, actor):
        """Name the components that lost touch with their island's root."""
        swept = set()
        while actor.dirty:
            node = actor.dirty.pop()
            self.is_dirty[node] = False
            if node in swept or self.node_island[node] == node:
                continue
            members = self.component(node)
            swept.update(members)
            if self.node_island[node] not in members:
                for member in members:
                    self.node_island[member] = node

    def _claim(self, index):
        """Note an actor as the owner of its chunks and of what they make up."""
        for node in self.actors[index].nodes:
            chunk = self.asset.node_chunk[node]
            if chunk == INV:
                continue
            self.chunk_actor[chunk] = index
            for ancestor in ancestors(self.asset.chunk_parent, chunk):
                owners = {self.chunk_actor[c] for c in self.asset.children[ancestor]}
                self.chunk_actor[ancestor] = owners.pop() if len(owners) == 1 else INV

    def _release(self, index, room, warnings):
        """Replace an actor of one dead chunk by the children of that chunk."""
        chunk = self.lone_chunk(index)
        for top in self.visible()[index]:
            for member in self.asset.subtree(top):
                if member < self.asset.first_sub:
                    self.chunk_actor[member] = INV
        del self.actors[index]
        children = self.asset.children[chunk]
        if len(children) > room:
            warnings.append("no room for all children")
            children = children[:room]
        for child in children:
            slot = self.asset.slot(child)
            self.actors[slot] = Actor(slot, chunk=child)
        return [self.asset.slot(child) for child in children]


# Damage programs: a graph form (family, actor, ...) for actors of several nodes, and a
# form (asset, chunk, ...) for single chunks.


def falloff(distance, damage, min_radius, max_radius):
    """Full damage within the inner radius, none beyond the outer, linear between."""
    fade = F32(1) - (distance - min_radius) / (max_radius - min_radius)
    near = np.where(distance < min_radius, damage, fade * damage)
    return np.where(distance > max_radius, F32(0), near)


def cutter(distance, damage, min_radius, max_radius):
    """Full damage between the two radii."""
    inside = (distance >= min_radius) & (distance <= max_radius)
    return np.where(inside, damage, F32(0))


def to_point(x, position):
    """Distances from a point."""
    return length(position - x)


def to_segment(x, position, position1):
    """Distances from a segment."""
    v, w = position1 - position, x - position
    along, whole = dot(w, v), dot(v, v)
    beside = length(w - v * (along / whole)[..., None])
    inner = np.where(whole < along, length(x - position1), beside)
    return np.where(along <= 0, length(w), inner)


def _breakable_bonds(family, actor):
    """Yield (node, higher neighbour, bond) of an actor, each bond once."""
    breakable = can_damage(family.bond_health)
    for node in actor.nodes:
        for other, bond in family.asset.adjacency[node]:
            if other > node and breakable[bond]:
                yield node, other, bond


def _radial(profile, distance_to):
    """Make the program that damages by distance from a shape."""

    def graph(family, actor, damage, min_radius, max_radius, **shape):
        distance = distance_to(family.asset.bond_centroid, **shape)
        amount = profile(distance, damage, min_radius, max_radius)
        bonds = _breakable_bonds(family, actor)
        return [(a, b, amount[i]) for a, b, i in bonds if amount[i] > 0], []

    def subgraph(asset, chunk, damage, min_radius, max_radius, **shape):
        distance = distance_to(asset.chunk_centroid[chunk], **shape)
        amount = profile(distance, damage, min_radius, max_radius)[()]
        return [(chunk, amount)] if amount > 0 else []

    return graph, subgraph


def closest_node(family, actor, position):
    """Find the node nearest to a position, first by chunks and then by its bonds.

    INV if no chunk of the actor is alive. Normals are taken to point from the lower to
    the higher node.
    """
    asset, alive = family.asset, family.chunk_health > 0
    nodes = [n for n in actor.nodes if alive[n] and n != asset.world]
    if not nodes:
        return INV
    offset = position - asset.chunk_centroid[[asset.node_chunk[n] for n in nodes]]
    node = nodes[int(np.argmin(dot(offset, offset)))]
    bonds = [
        (other, bond)
        for other, bond in asset.adjacency[node]
        if other != asset.world and family.bond_health[bond] > 0 and alive[other]
    ]
    if not bonds:
        return node
    offset = position - asset.bond_centroid[[bond for _, bond in bonds]]
    nearest = int(np.argmin(dot(offset, offset)))
    other, bond = bonds[nearest]
    side = dot(offset[nearest], asset.bond_normal[bond])
    return min(node, other) if side < 0 else max(node, other)


def _shear(family, actor, damage, position, normal, min_radius, max_radius):
    """Walk from the closest node along a direction and break what lies across it."""
    asset = family.asset
    node = closest_node(family, actor, position)
    if node == INV:
        return [], []
    chunk_commands = [
        (
            asset.node_chunk[node],
            falloff(
                to_point(asset.chunk_centroid[asset.node_chunk[node]], position),
                damage,
                min_radius,
                max_radius,
            )[()],
        )
    ]
    distance = to_point(asset.bond_centroid, position)
    amount = falloff(distance, damage, min_radius, max_radius)
    weight = abs(F32(1) - abs(dot(normal, asset.bond_normal)))
    ahead = dot(asset.bond_centroid - position, normal)
    breakable = can_damage(family.bond_health)
    bond_commands = []
    furthest, following = F32(0), INV
    while True:
        for other, bond in asset.adjacency[node]:
            if not breakable[bond]:
                continue
            if ahead[bond] > furthest:
                furthest, following = ahead[bond], other
            if amount[bond] > 0:
                bond_commands.append((node, other, weight[bond] * amount[bond]))
        if following in (node, INV):
            return bond_commands, chunk_commands
        node = following


def _shear_chunk(asset, chunk, normal, **params):
    return _radial(falloff, to_point)[1](asset, chunk, **params)


def hits_triangle(start, end, corners):
    """Whether segments meet a triangle."""
    a, b, c = corners
    area = cross(b - a, c - a)
    size = length(area)
    normal = area / size if size > 0 else area
    offset = -dot(a, normal)
    t = (-offset - dot(start, normal)) / dot(end - start, normal)
    x = start + (end - start) * t[..., None]
    whole = dot(normal, area)
    v = dot(normal, cross(b - x, c - x)) / whole
    w = dot(normal, cross(c - x, a - x)) / whole
    reached = (t > F32(-1e-4)) & (t < F32(1) + F32(1e-4))
    return reached & (v > 0) & (w > 0) & (F32(1) - v - w > 0)


def _triangle(family, actor, damage, corners):
    """Break the bonds whose line from centroid to centroid meets a triangle."""
    asset = family.asset
    bonds = list(_breakable_bonds(family, actor))
    if not bonds:
        return [], []
    low, high, bond = (list(column) for column in zip(*bonds, strict=True))
    start = asset.chunk_centroid[[asset.node_chunk[n] for n in low]]
    end = np.array(
        [
            asset.chunk_centroid[asset.node_chunk[n]] if n != asset.world else (0, 0, 0)
            for n in high
        ],
        F32,
    )
    normal, centroid = asset.bond_normal[bond], asset.bond_centroid[bond]
    foot = start + normal * dot(centroid - start, normal)[:, None]
    end = np.where(np.array(high)[:, None] == asset.world, foot, end)
    hit = hits_triangle(start, end, corners)
    return [(low[i], high[i], damage) for i in np.flatnonzero(hit)], []


def _triangle_chunk(asset, chunk, damage, corners):
    """Break a chunk if the line between two neighbours in its list of children does.

    The last child is paired with the chunk after it, which belongs to something else.
    """
    for child in asset.children[chunk]:
        if child + 1 < asset.n_chunk:
            start, end = asset.chunk_centroid[child : child + 2]
            if hits_triangle(start, end, corners):
                return [(chunk, damage)]
    return []


def _impact(family, actor, damage, position, min_radius, max_radius, accelerator=1):
    """Spread damage over the graph from the closest node, by the distance travelled."""
    asset = family.asset
    node = closest_node(family, actor, position)
    if node == INV or not accelerator:
        return [], []
    room = len(actor.nodes)
    breakable = can_damage(family.bond_health)
    queue = collections.deque([(node, F32(0))])
    visited = set()
    commands = []
    while queue:
        node, travelled = queue.popleft()
        here = asset.chunk_centroid[asset.node_chunk[node]]
        for other, bond in asset.adjacency[node]:
            if bond in visited or not breakable[bond]:
                continue
            visited.add(bond)
            if other == asset.world:
                step = F32(2) * length(asset.bond_centroid[bond] - here)
            else:
                step = length(asset.chunk_centroid[asset.node_chunk[other]] - here)
            total = travelled + step
            amount = damage * falloff(total, F32(1), min_radius, max_radius)
            if amount > 0:
                commands.append((node, other, amount))
                if other != asset.world and len(queue) < room:
                    queue.append((other, total))
    return commands, []


def _impact_chunk(asset, chunk, damage, **_):
    return [(chunk, damage)]


PROGRAMS = {
    "falloff": _radial(falloff, to_point),
    "cutter": _radial(cutter, to_point),
    "capsule": _radial(falloff, to_segment),
    "shear": (_shear, _shear_chunk),
    "triangle": (_triangle, _triangle_chunk),
    "impact": (_impact, _impact_chunk),
}
"""Damage programs and their parameters besides `damage`: falloff and cutter (position,
min_radius, max_radius), capsule (also position1), shear (also normal), triangle
(corners, one a row), impact (position, min_radius, max_radius, accelerator)."""
