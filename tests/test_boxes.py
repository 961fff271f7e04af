"""Boxes against boxes: every axis tried, MuJoCo C, hulls, and their derivatives."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from blastjax.author import hulls as author
from blastjax.rigid import box, engine, hull
from tests.test_hulls import CUBE, rotation, table_of

COUNT = 400
"""Pairs of a kind, the same for all: programs are shared."""
ROUNDING = 1e-9
"""Of a box, in double precision, through a square root or two."""
SINGLE = 2e-6
"""The same in single precision."""


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):
        yield


def contacts(place, turn, half):
    """Collide boxes (2, n, ...) pair by pair: (n, 4), (n, 4, 3) and (n, 3, 3)."""
    count = place.shape[1]
    pair = np.arange(2 * count).reshape(2, count).T
    flat = [x.reshape(2 * count, *x.shape[2:]) for x in (place, turn, half)]
    model = SimpleNamespace(geom_size=flat[2], geom_margin=jnp.zeros(2 * count))
    model.geom_margin = model.geom_margin.astype(half.dtype)
    data = SimpleNamespace(geom_xpos=flat[0], geom_xmat=flat[1])
    distance, point, frame = box.box_box(model, data, pair)
    each = frame.reshape(count, box.POINTS, 3, 3)[:, 0]
    shape = (count, box.POINTS)
    return distance.reshape(shape), point.reshape(*shape, 3), each


collide = jax.jit(contacts)


def scattered(kind):
    """Return places, turns and half extents of pairs of boxes."""
    rng = np.random.default_rng(5)
    half = rng.uniform(0.2, 1.0, (2, COUNT, 3))
    turn = np.stack([rotation(q) for q in rng.normal(size=(2 * COUNT, 4))])
    turn = turn.reshape(2, COUNT, 3, 3)
    place = np.zeros((2, COUNT, 3))
    away = rng.normal(size=(COUNT, 3))
    place[1] = away * (
        rng.uniform(0.2, 2.0, (COUNT, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    )
    upright = np.broadcast_to(np.eye(3), turn.shape)
    over = rng.uniform(-0.9, 0.9, (COUNT, 3)) * half.sum(axis=0)
    if kind == "far away":
        place += [1e3, -2e3, 5e2]
    if kind in ("1 mm", "100 m"):
        scale = {"1 mm": 1e-3, "100 m": 100.0}[kind]
        half, place = half * scale, place * scale
    if kind == "stacked":
        over[:, 2] = half[:, :, 2].sum(axis=0) - 1e-3
        place[1], turn = over, upright
    if kind == "turned on top":
        over[:, 2] = half[:, :, 2].sum(axis=0) - 1e-3
        angle = rng.uniform(0, np.pi, COUNT)
        about = [rotation(np.array([np.cos(x), 0, 0, np.sin(x)])) for x in angle]
        place[1], turn = 0.3 * over, np.stack([upright[0], np.stack(about)])
    if kind == "almost flat":
        over[:, 2] = half[:, :, 2].sum(axis=0) - 1e-4
        tilt = rng.normal(size=(COUNT, 3)) * 10.0 ** rng.uniform(-6, -2, (COUNT, 1))
        tilted = [rotation(np.array([1.0, *x])) for x in tilt]
        place[1], turn = over, np.stack([upright[0], np.stack(tilted)])
    if kind == "corner on face":
        turn = np.stack([upright[0], turn[1]])
        reach = np.sum(np.abs(turn[1][:, 2]) * half[1], axis=1)
        place[1] = 0.5 * over
        place[1, :, 2] = half[0, :, 2] + reach - 0.01
    if kind == "rods":
        half = half * [1, 0.01, 0.01]
        place[1] = rng.normal(size=(COUNT, 3)) * 0.02
    if kind == "rods side by side":
        half = half * [1, 0.01, 0.01]
        tilt = [
            rotation(np.array([1.0, *x])) for x in rng.normal(size=(COUNT, 3)) / 300
        ]
        place[1] = rng.normal(size=(COUNT, 3)) * [0.3, 0.008, 0.008]
        turn = np.stack([upright[0], np.stack(tilt)])
    if kind == "plates":
        half = half * [1, 1, 0.01]
        place[1] *= 0.3
    if kind == "one in the other":
        place[1] *= 0.01
    return place, turn, half


KINDS = (
    "random",
    "far away",
    "1 mm",
    "100 m",
    "stacked",
    "turned on top",
    "almost flat",
    "corner on face",
    "rods",
    "rods side by side",
    "plates",
    "one in the other",
)


def gap_along(axes, place, turn, half):
    """Return how far boxes are apart along unit axes (n, k, 3), (n, k)."""
    reach = sum(
        np.abs(np.einsum("nkx,nxi->nki", axes, turn[side])) @ half[side][:, :, None]
        for side in (0, 1)
    )[..., 0]
    return np.abs(np.einsum("nkx,nx->nk", axes, place[1] - place[0])) - reach


def every_axis(place, turn, half):
    """Return the gap along the best axis, by trying all of them."""
    faces = np.concatenate([turn[0], turn[1]], axis=2).swapaxes(1, 2)
    across = np.cross(
        turn[0].swapaxes(1, 2)[:, :, None], turn[1].swapaxes(1, 2)[:, None]
    ).reshape(-1, 9, 3)
    length = np.linalg.norm(across, axis=2)
    # Of parallel edges a face's normal says it all.
    parallel = length < 1e-3
    length = np.where(parallel, 1.0, length)
    edges = np.where(parallel[..., None], faces[:, :1], across / length[..., None])
    return gap_along(np.concatenate([faces, edges], axis=1), place, turn, half).max(1)


@pytest.mark.parametrize("kind", KINDS)
def test_the_axis_is_the_best_of_all_and_points_lie_between(kind):
    place, turn, half = scattered(kind)
    best = every_axis(place, turn, half)
    small, size = half.max(axis=2).min(axis=0), half.max(axis=2).max(axis=0)
    distance, point, frame = map(np.asarray, collide(place, turn, half))
    assert np.isfinite(point).all() and np.isfinite(frame).all()
    sure = np.abs(best) > ROUNDING * size * (1e3 if kind == "far away" else 1)
    touching = best < 0
    assert sure.mean() > 0.9 and touching.sum() > 50
    deepest = distance.min(axis=1)
    assert ((deepest < 0) == touching)[sure].all()
    # Faces are preferred to edges that are barely shallower.
    slack = 1e-8 * size
    along = gap_along(frame[:, :1], place, turn, half)[:, 0]
    assert (along <= best + slack)[touching].all()
    worse = along < best / hull.FACE_BIAS - 2e-5 * size - slack
    assert (along > best / hull.FACE_BIAS - hull.FACE_SLOP * small - slack)[
        touching
    ].all()
    assert (deepest > best / hull.FACE_BIAS - 2e-5 * size - slack)[
        touching & worse
    ].all()
    assert (deepest <= -ROUNDING * size)[touching & sure].all()
    assert (np.einsum("nx,nx->n", frame[:, 0], place[1] - place[0]) >= -slack).all()
    np.testing.assert_allclose(
        frame @ frame.swapaxes(1, 2), np.broadcast_to(np.eye(3), frame.shape), atol=1e-9
    )
    for side in (0, 1):
        seen = np.einsum("nxi,npx->npi", turn[side], point - place[side][:, None])
        outside = (np.abs(seen) - half[side][:, None]).max(axis=2)
        assert (outside < -distance + 1e-4 * size[:, None])[distance < 0].all()


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_finds_the_same(kind):
    place, turn, half = scattered(kind)
    # What rounds already on the way in is no fault of the collider.
    place, turn, half = (x.astype(np.float32) for x in (place, turn, half))
    exact = [np.asarray(x) for x in collide(*map(np.float64, (place, turn, half)))]
    distance, point, frame = map(np.asarray, collide(place, turn, half))
    assert distance.dtype == point.dtype == frame.dtype == np.float32
    size = half.max(axis=2).max(axis=0)
    same = np.einsum("nx,nx->n", frame[:, 0], exact[2][:, 0]) > 0.9999
    assert same.mean() > 0.98
    # Where boxes overlap deeply or not at all other axes may be as good.
    best = every_axis(*map(np.float64, (place, turn, half)))
    clear = np.abs(best) > SINGLE * size
    assert ((distance.min(axis=1) < 0) == (best < 0))[clear].all()
    wrong = np.abs(distance.min(axis=1) - exact[0].min(axis=1))
    assert (wrong < SINGLE * size)[same & (best < -SINGLE * size)].all()


@pytest.mark.parametrize("kind", ["random", "stacked", "corner on face", "plates"])
def test_depth_and_normal_agree_with_mujoco_c(kind):
    place, turn, half = scattered(kind)
    spec = mujoco.MjSpec()
    for _ in range(2):
        body = spec.worldbody.add_body()
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 1, 1])
    model = spec.compile()
    data = mujoco.MjData(model)
    distance, _, frame = map(np.asarray, collide(place, turn, half))
    best = every_axis(place, turn, half)
    compared = 0
    for k in range(0, COUNT, 2):
        model.geom_size[:] = half[:, k]
        model.geom_rbound[:] = np.linalg.norm(half[:, k], axis=1)
        model.geom_aabb[:, 3:] = half[:, k]
        for side in (0, 1):
            pose = data.qpos[7 * side : 7 * side + 7]
            pose[:3] = place[side, k]
            mujoco.mju_mat2Quat(pose[3:], turn[side, k].reshape(-1))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        native = [c for c in data.contact[: data.ncon] if c.dist < 0]
        assert bool(native) == (best[k] < 0)
        along = frame[k, 0]
        # C prefers faces less; where it took the same axis the depth is the same.
        if native and native[0].frame[:3] @ along > 1 - 1e-9:
            compared += 1
            deepest = min(c.dist for c in native)
            assert distance[k].min() == pytest.approx(deepest, abs=1e-6)
    assert compared > 40


def test_depth_agrees_with_that_of_hulls():
    place, turn, half = scattered("random")
    place, turn, half = (x[:, :60] for x in (place, turn, half))
    ours, _, frame = map(np.asarray, collide(*scattered("random")))
    solids = [author.hull(2 * CUBE * h) for h in half.reshape(-1, 3)]
    table = table_of(solids)

    def one(a, b, turn, shift):
        return hull.meet(
            hull._solid(table, a), hull._moved(hull._solid(table, b), turn, shift)
        )

    between = np.einsum("nxi,nxj->nij", turn[0], turn[1])
    shift = np.einsum("nxi,nx->ni", turn[0], place[1] - place[0])
    number = np.arange(60)
    theirs, _, normal = jax.jit(jax.vmap(one))(number, 60 + number, between, shift)
    normal = np.einsum("nxi,ni->nx", turn[0], normal)
    same = np.einsum("nx,nx->n", normal, frame[:60, 0]) > 1 - 1e-9
    touching = theirs.min(axis=1) < 0
    assert (touching == (ours[:60].min(axis=1) < 0)).all()
    assert (same & touching).sum() > 0.9 * touching.sum()
    np.testing.assert_allclose(
        ours[:60].min(axis=1)[same & touching],
        theirs.min(axis=1)[same & touching],
        atol=1e-6,
    )


def test_faces_meet_in_their_corners():
    place, turn, half = scattered("stacked")
    distance, point, frame = map(np.asarray, collide(place, turn, half))
    np.testing.assert_allclose(distance, -1e-3, atol=ROUNDING)
    np.testing.assert_allclose(frame[:, 0], np.tile([0, 0, 1], (COUNT, 1)), atol=1e-12)
    low = np.maximum(-half[0], place[1] - half[1])[:, None, :2]
    high = np.minimum(half[0], place[1] + half[1])[:, None, :2]
    corner = np.where([[0, 0], [0, 1], [1, 0], [1, 1]], high, low)
    gap = np.linalg.norm(corner[:, :, None] - point[:, None, :, :2], axis=-1)
    np.testing.assert_allclose(gap.min(axis=2), 0, atol=ROUNDING)
    height = np.broadcast_to(half[0, :, None, 2] - 5e-4, (COUNT, 4))
    np.testing.assert_allclose(point[..., 2], height, atol=ROUNDING)


def test_faces_of_one_size_keep_their_outline_whatever_the_rounding():
    rng = np.random.default_rng(2)
    place, _, half = scattered("stacked")
    half[1] = half[0]
    place[1] = 0.0
    place[1, :, 2] = 2 * half[0, :, 2] - 1e-4
    for scale in (0.0, 1e-8, 1e-6, 1e-5):
        moved = place + scale * rng.normal(size=place.shape)
        tilt = scale * rng.normal(size=(2, COUNT, 3))
        turned = np.stack([[rotation([1.0, *x]) for x in side] for side in tilt])
        for dtype in (np.float32, np.float64):
            found = collide(*(x.astype(dtype) for x in (moved, turned, half)))
            distance, point, _ = map(np.asarray, found)
            assert (distance < 0).all()
            corner = np.abs(point[..., :2]) / half[0][:, None, :2]
            # Moved and tilted by up to some four deviations, of boxes 1:5.
            np.testing.assert_allclose(corner, 1.0, atol=1e-5 + 100 * scale)


def test_a_frame_is_completed_as_mujoco_completes_it():
    _, _, frame = collide(*scattered("random"))
    expected = jax.jit(jax.vmap(engine.contact_frame))(frame[:, 0])
    np.testing.assert_allclose(frame, expected, atol=1e-12)


def measured(place, spin, half, turn, weight):
    """Sum what contacts are, by fixed weights, per pair: in whatever order."""
    angle = jnp.sqrt(jnp.sum(spin * spin, axis=-1) + 1e-30)[..., None, None]
    x, y, z = jnp.moveaxis(spin, -1, 0)
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    cross = cross.reshape(*spin.shape, 3)
    turned = jnp.eye(3) + cross * jnp.sin(angle) / angle
    turned = turned + cross @ cross * (1 - jnp.cos(angle)) / angle**2
    distance, point, frame = contacts(place, turned @ turn, half)
    on = jax.lax.stop_gradient(distance < 0)
    total = jnp.sum(jnp.where(on, weight[0] * distance, 0.0), axis=1)
    total += jnp.sum(jnp.where(on[..., None], weight[1] * point, 0.0), axis=(1, 2))
    return total + jnp.sum(weight[2] * frame, axis=(1, 2)), on


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    place, turn, half = scattered("random")
    rng = np.random.default_rng(0)
    weight = [rng.normal(size=(COUNT, *shape)) for shape in ((1,), (1, 3), (3, 3))]
    start = (place, np.full(place.shape, 1e-3), half)
    tangent = tuple(rng.normal(size=x.shape) for x in start)

    def value(*start):
        return measured(*start, turn, weight)[0]

    @jax.jit
    def slopes():
        _, forward = jax.jvp(value, start, tangent)
        back = jax.grad(lambda *x: value(*x).sum(), argnums=(0, 1, 2))(*start)
        return forward, back

    @jax.jit
    def moved(step):
        return measured(
            *(x + step * t for x, t in zip(start, tangent, strict=True)), turn, weight
        )

    forward, back = slopes()
    total = sum(np.sum(x * t) for x, t in zip(back, tangent, strict=True))
    assert total == pytest.approx(float(forward.sum()), rel=1e-10)
    step = 1e-6
    (above, on), (below, other) = moved(step), moved(-step)
    difference = (above - below) / (2 * step)
    wrong = np.abs(difference - forward) / (1 + np.abs(forward))
    smooth = (np.asarray(on) == np.asarray(other)).all(axis=1)
    # A few features change within the step: there it is a jump.
    assert (wrong[smooth] < 1e-6).mean() > 0.99
    touching = np.asarray(on).any(axis=1)
    assert touching.sum() > 100


@pytest.mark.parametrize(
    "dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)]
)
def test_coincident_and_touching_boxes_have_finite_derivatives(dtype):
    place = np.zeros((2, 6, 3), dtype)
    place[1, 1:4] = np.eye(3)
    place[1, 4] = [1, 1, 0]
    place[1, 5] = [1, 1, 1]
    turn = np.broadcast_to(np.eye(3, dtype=dtype), (2, 6, 3, 3))
    half = np.full((2, 6, 3), 0.5, dtype)

    def total(*x):
        found = contacts(*x)
        return sum(jnp.sum(part) for part in found), found

    slope, found = jax.jit(jax.grad(total, argnums=(0, 1, 2), has_aux=True))(
        place, turn, half
    )
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((slope, found)))
