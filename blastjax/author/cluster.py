"""Groups of neighbours in a graph, and bonds of the same pair made one. Plain numpy."""

import heapq

import numpy as np

from blastjax.author.descriptions import Bonds
from blastjax.core import WORLD


def grow(
    place: np.ndarray, pairs: np.ndarray, weight: np.ndarray, size: int
) -> np.ndarray:
    """Return the cluster of each point, (n,) int from 0: connected, of about one size.

    Seeds lie as far apart as they can; the smallest cluster grows first, by the
    neighbour that weighs most with it. Deterministic.

    Args:
      place: (n, 3) where the points are.
      pairs: (m, 2) neighbours, each pair once.
      weight: (m,) of each pair.
      size: points wanted in a cluster.
    """
    near: list[dict[int, float]] = [{} for _ in place]
    for (a, b), w in zip(pairs.tolist(), weight.tolist(), strict=True):
        near[a][b] = near[b][a] = w
    group = np.full(len(place), -1)
    for part in _connected(near):
        _grow_part(part, _seeds(place[part], -(-len(part) // size)), near, group)
    return group


def _connected(near: list[dict[int, float]]) -> list[np.ndarray]:
    seen, parts = [False] * len(near), []
    for start in range(len(near)):
        if seen[start]:
            continue
        seen[start], part = True, [start]
        for point in part:
            for other in near[point]:
                if not seen[other]:
                    seen[other] = True
                    part.append(other)
        parts.append(np.sort(part))
    return parts


def _seeds(place: np.ndarray, number: int) -> list[int]:
    middle = place.mean(axis=0)
    chosen = [int(np.argmax(np.linalg.norm(place - middle, axis=1)))]
    distance = np.linalg.norm(place - place[chosen[0]], axis=1)
    distance[chosen[0]] = -1
    while len(chosen) < number:
        chosen.append(int(np.argmax(distance)))
        away = np.linalg.norm(place - place[chosen[-1]], axis=1)
        distance = np.minimum(distance, away)
        # Points in one place are still different points.
        distance[chosen[-1]] = -1
    return chosen


def _grow_part(
    part: np.ndarray, seeds: list[int], near: list[dict[int, float]], group: np.ndarray
) -> None:
    first = int(group.max(initial=-1)) + 1
    border: list[dict[int, float]] = [{} for _ in seeds]
    waiting = [(1, k) for k in range(len(seeds))]

    def take(point: int, k: int) -> None:
        group[point] = first + k
        for other, w in near[point].items():
            if group[other] < 0:
                border[k][other] = border[k].get(other, 0.0) + w

    for k, seed in enumerate(seeds):
        take(int(part[seed]), k)
    while waiting:
        count, k = heapq.heappop(waiting)
        free = {p: w for p, w in border[k].items() if group[p] < 0}
        border[k] = free
        if free:
            take(max(free, key=lambda p: (free[p], -p)), k)
            heapq.heappush(waiting, (count + 1, k))


def merge_pairs(bonds: Bonds) -> tuple[Bonds, np.ndarray]:
    """Sum up the bonds of each pair, the lower chunk first and the world last.

    Returns:
      The bonds, with total area and area-weighted centroid and normal, and (their
      number,) the first of the bonds that each was made of.
    """
    rank = np.where(bonds.chunks == WORLD, np.iinfo(np.int64).max, bonds.chunks)
    turned = rank[:, 0] > rank[:, 1]
    pairs = np.where(turned[:, None], bonds.chunks[:, ::-1], bonds.chunks)
    normal = np.where(turned[:, None], -bonds.normal, bonds.normal)
    _, first, place = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    place, number = place.reshape(-1), len(first)
    area = np.bincount(place, bonds.area, number)
    vector, middle = np.zeros((number, 3)), np.zeros((number, 3))
    np.add.at(vector, place, bonds.area[:, None] * normal)
    np.add.at(middle, place, bonds.area[:, None] * bonds.centroid)
    length = np.linalg.norm(vector, axis=1)
    # Where areas or normals cancel out, the first bond speaks for all.
    vector = np.where((length > 0)[:, None], vector, normal[first])
    middle = middle / np.where(area > 0, area, 1)[:, None]
    middle = np.where((area > 0)[:, None], middle, bonds.centroid[first])
    length = np.where(length > 0, length, 1)[:, None]
    return Bonds(pairs[first], vector / length, area, middle), first
