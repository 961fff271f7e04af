"""Convex hulls: their tables, their contacts against brute force and MuJoCo C."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from blastjax import world
from blastjax.author import hulls as author
from blastjax.author.mesh import Mesh, moments
from blastjax.rigid import Resting, bodies, build, contact, hull
from tests import pieces

CUBE = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * 0.5
FIELDS = ("vertices", "normal", "offset", "corners", "size", "edges", "sides")
ROUNDING = 1e-9
"""m, double precision at metre scale through a square root or two."""
C_DEPTH = 2e-6
"""m; what MuJoCo's own search for the depth stops at (ccd_tolerance 1e-6)."""


@pytest.fixture(autouse=True)
def mjx_promotion():
    with (
        jax.enable_x64(True),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        yield


def table_of(solids):
    padded = author.pad(solids, range(len(solids)))
    fields = {name: jnp.asarray(getattr(padded, name)) for name in FIELDS}
    return hull.Table(**fields, row=jnp.arange(len(solids)))


def rotation(quaternion):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion / np.linalg.norm(quaternion))
    return matrix.reshape(3, 3)


def meet(table, pair, turn, shift):
    def one(pair, turn, shift):
        b = hull._moved(hull._solid(table, pair[1]), turn, shift)
        return hull.meet(hull._solid(table, pair[0]), b)

    return jax.vmap(one)(pair, turn, shift)


@pytest.fixture(scope="module")
def crowd():
    """Random hulls in random relative poses, and what was found between them."""
    rng = np.random.default_rng(1)
    solids = [
        author.hull(rng.normal(size=(n, 3)) * [0.3, 0.2, 0.25])
        for n in rng.integers(4, 20, 24)
    ]
    solids.append(author.hull(CUBE))
    pair = rng.integers(0, len(solids), (300, 2))
    turn = np.stack([rotation(rng.normal(size=4)) for _ in pair])
    shift = rng.normal(size=(300, 3))
    shift *= rng.uniform(0.1, 0.8, (300, 1)) / np.linalg.norm(
        shift, axis=1, keepdims=True
    )
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):
        found = jax.jit(meet)(table_of(solids), pair, turn, shift)
    return solids, pair, turn, shift, [np.asarray(x) for x in found]


def every_axis(a, b, turn, shift):
    """Return the gap of two hulls along their best axis, by trying all of them."""
    corners_a, corners_b = a.vertices, b.vertices @ turn.T + shift
    along_a, along_b = (
        corners[h.edges[:, 1]] - corners[h.edges[:, 0]]
        for corners, h in ((corners_a, a), (corners_b, b))
    )
    across = np.cross(along_a[:, None], along_b[None]).reshape(-1, 3)
    length = np.linalg.norm(across, axis=1)
    across = across[length > 1e-9] / length[length > 1e-9][:, None]
    axes = np.concatenate([a.normal, -b.normal @ turn.T, across, -across])
    return ((corners_b @ axes.T).min(0) - (corners_a @ axes.T).max(0)).max()


def test_a_hull_is_closed_and_holds_its_points():
    rng = np.random.default_rng(0)
    for count in (4, 8, 40):
        points = rng.normal(size=(count, 3))
        solid = author.hull(points, 64)
        assert len(solid.vertices) - len(solid.edges) + len(solid.loops) == 2
        reach = solid.vertices @ solid.normal.T - solid.offset
        assert reach.max() < 1e-3
        assert (points @ solid.normal.T - solid.offset).max() < 1e-3
        left = solid.normal[solid.sides[:, 0]]
        right = solid.normal[solid.sides[:, 1]]
        along = solid.vertices[solid.edges] @ np.eye(3)
        along = along[:, 1] - along[:, 0]
        assert (np.einsum("ei,ei->e", np.cross(left, right), along) > 0).all()
    cube = author.hull(CUBE)
    assert (len(cube.loops), len(cube.edges), cube.volume) == (6, 12, 1.0)


def test_a_budget_leaves_a_smaller_hull_inside():
    points = np.random.default_rng(0).normal(size=(400, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    whole = author.hull(points, 400)
    volumes = [whole.volume]
    for budget in (64, 32, 16, 8):
        solid = author.hull(points, budget)
        assert len(solid.vertices) == budget
        outside = solid.vertices @ whole.normal.T - whole.offset
        assert outside.max() < 1e-9
        volumes.append(solid.volume)
    assert (np.diff(volumes) < 0).all()
    assert volumes[2] > 0.6 * volumes[0]


@pytest.mark.parametrize(
    "points, words",
    [
        (CUBE * [1, 1, 0], "span no volume"),
        (CUBE[:3], "3 points"),
        (np.where(np.arange(8)[:, None] == 5, np.nan, CUBE), "point 5"),
    ],
)
def test_what_spans_nothing_is_refused(points, words):
    with pytest.raises(ValueError, match=words):
        author.hull(points)


def assert_best(a, along, best, found, rounding):
    """Compare the depth along an axis with the least of all, and contacts found there.

    A face is preferred to edges that are barely shallower, and to those shallower by a
    slop only if its contacts are not deeper than they.
    """
    preferred = best / hull.FACE_BIAS - rounding
    if along <= preferred:
        assert along > preferred - hull.FACE_SLOP * np.abs(a.offset).max()
        assert found.min() > preferred


def test_an_axis_is_the_best_of_all(crowd):
    solids, pair, turn, shift, (distance, _, normal) = crowd
    for (i, j), r, t, found, n in zip(pair, turn, shift, distance, normal, strict=True):
        a, b = solids[i], solids[j]
        best = every_axis(a, b, r, t)
        assert np.linalg.norm(n) == pytest.approx(1, abs=ROUNDING)
        along = ((b.vertices @ r.T + t) @ n).min() - (a.vertices @ n).max()
        assert (found.min() < 0) == (best < 0)
        if best < 0:
            assert along <= best + ROUNDING
            assert_best(a, along, best, found, 2e-5)


def test_contacts_lie_between_the_hulls(crowd):
    solids, pair, turn, shift, (distance, point, normal) = crowd
    for k in np.flatnonzero(distance.min(axis=1) < 0):
        a, b = (solids[i] for i in pair[k])
        on = distance[k] < 0
        for side, place in (
            (a, point[k][on]),
            (b, (point[k][on] - shift[k]) @ turn[k]),
        ):
            outside = place @ side.normal.T - side.offset
            assert outside.max() < -distance[k].min()
        assert np.isfinite(normal[k]).all()


def test_depth_agrees_with_mujoco_c(crowd):
    solids, pair, turn, shift, (distance, _, normal) = crowd
    compared = 0
    for k in np.flatnonzero(distance.min(axis=1) < 0)[:40]:
        spec = mujoco.MjSpec()
        spec.option.ccd_tolerance, spec.option.ccd_iterations = 1e-9, 200
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, turn[k].reshape(-1))
        for name, i, place, q in (
            ("a", pair[k, 0], np.zeros(3), [1, 0, 0, 0]),
            ("b", pair[k, 1], shift[k], quaternion),
        ):
            spec.add_mesh(name=name, uservert=solids[i].vertices.reshape(-1))
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=place, quat=q
            )
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        ends = np.zeros(6)
        depth = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, ends)
        best = every_axis(solids[pair[k, 0]], solids[pair[k, 1]], turn[k], shift[k])
        # Where C did find the least depth, so did we, up to the preference for faces.
        if abs(depth - best) < C_DEPTH:
            compared += 1
            a, b = (solids[i] for i in pair[k])
            along = ((b.vertices @ turn[k].T + shift[k]) @ normal[k]).min()
            along -= (a.vertices @ normal[k]).max()
            assert along < depth + C_DEPTH
            assert_best(a, along, depth, distance[k], 3e-5)
    assert compared >= 30


def test_a_cube_on_a_cube_meets_in_four_corners():
    table = table_of([author.hull(CUBE), author.hull(CUBE * [0.5, 0.3, 1])])
    distance, point, normal = jax.jit(meet)(
        table,
        np.array([[0, 1], [1, 0]]),
        np.stack([np.eye(3)] * 2),
        np.array([[0.1, 0.2, 0.999], [-0.1, -0.2, -0.999]]),
    )
    for k, (sign, middle) in enumerate(
        [(1, [0.1, 0.2, 0.4995]), (-1, [0, 0, -0.4995])]
    ):
        on = distance[k] < 0
        assert on.sum() == 4
        np.testing.assert_allclose(distance[k][on], -0.001, atol=ROUNDING)
        np.testing.assert_allclose(normal[k], [0, 0, sign], atol=ROUNDING)
        np.testing.assert_allclose(point[k][on].mean(axis=0), middle, atol=ROUNDING)
        corners = np.abs(np.asarray(point[k][on]) - middle)[:, :2]
        np.testing.assert_allclose(corners, np.tile([0.25, 0.15], (4, 1)), atol=1e-9)


def test_crossed_edges_meet_in_one_point():
    solid = author.hull(CUBE)
    half = np.sqrt(0.5)
    low = rotation(np.array([np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]))
    high = rotation(np.array([np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0]))
    distance, point, normal = jax.jit(meet)(
        table_of([solid]),
        np.array([[0, 0]]),
        (low.T @ high)[None],
        (low.T @ np.array([0.1, 0.05, 2 * half - 0.01]))[None],
    )
    assert (distance[0] < 0).sum() == 1
    np.testing.assert_allclose(distance[0, 0], -0.01, atol=ROUNDING)
    np.testing.assert_allclose(low @ normal[0], [0, 0, 1], atol=ROUNDING)
    np.testing.assert_allclose(low @ point[0, 0], [0.1, 0, half - 0.005], atol=ROUNDING)


def test_derivatives_are_those_of_differences(crowd):
    solids, pair, turn, shift, (distance, _, _) = crowd
    table = table_of(solids)
    # Deep enough to stay in contact, and a clear deepest point.
    first = np.sort(distance, axis=1)
    chosen = np.flatnonzero((first[:, 0] < -0.01) & (first[:, 1] - first[:, 0] > 1e-3))
    chosen = chosen[:12]

    def depth(move):
        found = meet(table, pair[chosen], turn[chosen], shift[chosen] + move)
        return jnp.min(found[0], axis=1)

    zero = jnp.zeros((len(chosen), 3))
    back = jax.jit(jax.grad(lambda move: depth(move).sum()))(zero)
    both = jax.jit(lambda tangent: jax.jvp(depth, (zero,), (tangent,))[1])
    value = jax.jit(depth)
    for axis in range(3):
        tangent = zero.at[:, axis].set(1.0)
        forward = both(tangent)
        step = 1e-6
        slope = (value(step * tangent) - value(-step * tangent)) / (2 * step)
        np.testing.assert_allclose(forward, back[:, axis], atol=1e-12)
        np.testing.assert_allclose(forward, slope, atol=1e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_coincident_hulls_have_finite_contacts_and_derivatives(dtype):
    table = jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x,
        table_of([author.hull(CUBE), author.hull(CUBE[:7] * 0.1)]),
    )
    pair = np.array([[0, 0], [0, 1], [1, 1], [0, 0]])
    turn = np.stack([np.eye(3)] * 4).astype(dtype)
    shift = np.zeros((4, 3), dtype)
    shift[3] = [1, 0, 0]

    def total(shift):
        found = meet(table, pair, turn, shift)
        return sum(jnp.sum(x) for x in found), found

    slope, found = jax.jit(jax.grad(total, has_aux=True))(shift)
    assert all(np.isfinite(x).all() for x in found)
    assert np.isfinite(slope).all()


ROUND = """
<mujoco><option timestep="0.005"/><worldbody>
<geom type="plane" size="0 0 .05" name="floor"/>
<body name="ball"><freejoint/><geom type="{}" size="0.2 0.3"/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("kind", ["sphere", "capsule"])
def test_round_shapes_meet_a_box_as_in_c(kind):
    """The deepest contact with a box-shaped hull is C's with the box."""
    cube = pieces.destructible([pieces.convex_mesh(CUBE)])
    scene = build(cube, collision="hull", model=ROUND.format(kind))
    box = build(cube.asset, model=ROUND.format(kind)).host.model
    data = mujoco.MjData(box)
    rng = np.random.default_rng(3)
    geom = box.geom("chunk0").id
    ball = next(
        g for g in range(box.ngeom) if box.geom_bodyid[g] == box.body("ball").id
    )
    find, count = hull.colliders(scene.hulls)[int(box.geom_type[ball])]
    places = rng.normal(size=(40, 3))
    places *= rng.uniform(0.55, 0.8, (40, 1)) / np.linalg.norm(
        places, axis=1, keepdims=True
    )
    turns = np.stack([rotation(rng.normal(size=4)) for _ in places])

    def ours(place, turn):
        data = world.init(scene).data
        data = data.replace(
            geom_xpos=jnp.zeros_like(data.geom_xpos).at[ball].set(place),
            geom_xmat=data.geom_xmat.at[geom].set(jnp.eye(3)).at[ball].set(turn),
        )
        return find(scene.model, data, jnp.array([[ball, geom]]))

    distance, _, frame = jax.jit(jax.vmap(ours))(places, turns)
    assert distance.shape[1] == count
    touching = 0
    for k, (place, turn) in enumerate(zip(places, turns, strict=True)):
        data.geom_xpos[:] = 100 + 10 * np.arange(box.ngeom)[:, None]
        data.geom_xpos[geom], data.geom_xpos[ball] = 0, place
        data.geom_xmat[geom], data.geom_xmat[ball] = np.eye(3).ravel(), turn.ravel()
        ends = np.zeros(6)
        deepest = mujoco.mj_geomDistance(box, data, ball, geom, 5.0, ends)
        mine = int(np.argmin(distance[k]))
        if deepest > -0.15:
            touching += deepest < 0
            assert distance[k, mine] == pytest.approx(deepest, abs=1e-3)
            if deepest < -1e-3 or deepest > 1e-3:
                axis = (ends[3:] - ends[:3]) * np.sign(deepest)
                axis /= np.linalg.norm(axis)
                assert frame[k, mine, 0] @ axis > 0.99
    assert touching >= 8


def test_tables_repeat_and_unpad():
    solids = [author.hull(CUBE), author.hull(CUBE[:5])]
    padded = author.pad(solids, [4, 9])
    assert padded.chunk.tolist() == [4, 9]
    for row, solid in enumerate(solids):
        mesh = author.unpad(padded, row)
        assert len(mesh.vertices) == len(solid.vertices)
        assert moments(mesh)[0] == pytest.approx(solid.volume, rel=1e-12)


def test_fit_reports_what_hollow_chunks_gain_and_coacd_mends_it():
    outer = pieces.convex_mesh(CUBE)
    # An L-shaped bracket: two boxes that share a corner column, as one closed mesh.
    path = np.array([[0, 0], [1, 0], [1, 0.2], [0.2, 0.2], [0.2, 1], [0, 1]], float)
    trimesh = pytest.importorskip("trimesh")
    polygon = pytest.importorskip("shapely.geometry").Polygon(path)
    solid = trimesh.creation.extrude_polygon(polygon, 0.3)
    bracket = Mesh(np.asarray(solid.vertices), np.asarray(solid.faces, np.int32))
    both = pieces.destructible([outer, bracket])
    rough, fine = author.fit(both), author.fit(both, max_hulls=4)
    assert rough.chunk.tolist() == [0, 1]
    assert author.fit_error(both, rough)[0] == pytest.approx(0, abs=1e-9)
    assert author.fit_error(both, rough)[1] > 0.5
    assert abs(author.fit_error(both, fine)[1]) < 0.1
    assert (fine.chunk == 1).sum() >= 2 and (fine.chunk == 0).sum() == 1


def test_scenes_refuse_hulls_that_do_not_fit():
    cube = pieces.destructible([pieces.convex_mesh(CUBE)])
    with pytest.raises(ValueError, match="pass a Destructible"):
        build(cube.asset, collision="hull")
    with pytest.raises(ValueError, match="chunk 0 has no hull"):
        build(cube, collision="hull", hulls=author.pad([author.hull(CUBE)], [3]))
    with pytest.raises(ValueError, match="with hulls"):
        build(cube, hulls=author.fit(cube))


def operations(sites):
    scene = build(
        pieces.voronoi(np.array([0.5, 0.4, 0.1]), sites),
        slots=2,
        collision="hull",
        max_pairs=8,
    )
    riding = bodies.nobody(scene)
    data = contact.make_data(scene)
    found = jax.jit(lambda *x: contact.collide(scene, *x))
    return found.lower(riding, scene.model, data).as_text().count(" = ")


@pytest.mark.slow
def test_the_program_does_not_grow_with_the_number_of_shapes():
    few, many = operations(8), operations(16)
    # One program for every pair: only tables' sizes and what MJX does by geom differ.
    assert abs(many - few) < 0.03 * few


def test_data_has_room_for_what_is_found():
    """Contacts enter the solver, however many MJX's own colliders would find."""
    cube = pieces.destructible([pieces.convex_mesh(CUBE)])
    scene = build(cube, collision="hull", position=(0, 0, 0.499), max_contacts=64)
    start = world.init(scene)
    impl = start.data._impl
    assert impl.contact.dist.shape == (hull.POINTS,)
    assert impl.contact.dim.tolist() == [3] * hull.POINTS
    assert impl.efc_force.shape == (4 * hull.POINTS,)
    now, _ = jax.jit(world.step)(scene, start)
    assert jax.tree.map(jnp.shape, now) == jax.tree.map(jnp.shape, start)
    force = contact.normal_force(now.data)
    assert (np.asarray(force) > 0).sum() == 4


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_pieces_come_to_rest_and_neither_sink_nor_jitter(dtype):
    from tests.benchmarks.hulls import rest

    with jax.enable_x64(dtype == "float64"):
        found = rest("slab", sites=8, seconds=4.0)
    assert found["speed"] < 1e-3
    assert found["penetration"] < 1e-3
    assert found["actors"] > 1


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_leaning_shards_of_a_vase_come_to_rest(dtype):
    from tests.benchmarks.hulls import DROPS, falls

    with jax.enable_x64(dtype == "float64"):
        found = [
            row
            for friction in (0.5, 1.0)
            for row in falls("vase", 12, 1, DROPS, friction=friction, resting=Resting())
        ]
    for row in found:
        assert row["actors"] == 12
        assert row["speed"] < 1e-6
        assert row["penetration"] < 1e-3
        # What no longer tumbles does not creep or jitter on.
        assert row["settled_in"] < 0.75
    # When a fall ends is chance: rounding decides which way a shard topples, and how
    # many do so one after the other.
    after = [row["still_after"] - row["last_broke_at"] for row in found]
    assert np.median(after) < 2.0 and max(after) < 3.0
