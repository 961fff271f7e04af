"""Groups of neighbours in a graph. Plain numpy."""

import heapq

import numpy as np


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
