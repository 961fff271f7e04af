"""Scenes, slots, contacts and the solver, against MuJoCo and conservation laws."""

import inspect

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver
from mujoco.mjx._src import solver as mjx_solver

from blastjax import chunks, fracture, world
from blastjax.author import shapes
from blastjax.core import UNBREAKABLE, Damage
from blastjax.rigid import bodies, build, contact, engine, rows, solver

EDGE = (0.5, 0.5, 0.5)
PLANE_BOX = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX)


@pytest.fixture(autouse=True)
def mjx_promotion():
    """MJX itself mixes dtypes and ranks."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def x64(mjx_promotion):
    with jax.enable_x64(True):
        yield


def block(shape=(2, 2, 2), **options):
    return shapes.grid(shape, EDGE, **options)


# One unbroken actor against a single rigid body.

MJX_ERROR = 1e-12
"""m, from MJX with its contact problem solved to rounding."""
C_ERROR = 1e-8
"""m; the same, through the chaos of an impact."""


def one_body(asset, center):
    """Return the model of the asset as one body that cannot break."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option iterations="50" tolerance="1e-15" '
        'ls_iterations="50" ls_tolerance="1e-10">'
        '<flag eulerdamp="disable"/></option><worldbody>'
        '<geom type="plane" size="0 0 .05"/></worldbody></mujoco>'
    )
    body = spec.worldbody.add_body(name="one")
    body.add_freejoint()
    places, sizes = np.asarray(asset.chunk_centroid), np.asarray(asset.chunk_size)
    for place, size in zip(places, sizes, strict=True):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=place - center,
            density=1000.0,
            contype=0,
            conaffinity=1,
            friction=[1.0, 0.005, 0.0001],
        )
    return spec.compile()


def motion(kind, height):
    turn, place, speed = [1.0, 0, 0, 0], [0, 0, height], np.zeros(6)
    if kind == "falling":
        turn, place = [0.9, 0.2, 0.3, 0.1], [0, 0, height + 1.5]
        speed[:] = [0.3, -0.2, 0, 1.0, 0.5, -0.7]
    if kind == "sliding":
        speed[:2] = [3.0, 1.0]
    return np.concatenate([place, np.array(turn) / np.linalg.norm(turn)]), speed


def unit_quaternions(poses):
    turn = poses[..., 3:]
    length = np.linalg.norm(turn, axis=-1, keepdims=True)
    return np.concatenate([poses[..., :3], turn / length], axis=-1)


def polished(model, data, solve=mjx_solver.solve):
    """Solve by MJX, then take two more Newton steps on its own rows.

    Its solver stops when the cost no longer falls. Close to the minimum rounding alone
    decides about that, and at no tolerance does it go on: it ends 1.4e-12 m from here.
    """
    data = solve(model, data)
    impl, mass = data._impl, mjx.full_m(model, data)
    jacobian, stiff = impl.efc_J, impl.efc_D
    a = data.qacc
    for _ in range(2):
        slack = jacobian @ a - impl.efc_aref
        pushes = jnp.where(slack < 0, stiff, 0.0)
        gradient = mass @ (a - data.qacc_smooth) + jacobian.T @ (pushes * slack)
        a = a - jnp.linalg.solve(mass + (jacobian.T * pushes) @ jacobian, gradient)
    return data.replace(qacc=a)


def compare(monkeypatch, shape, cases, seconds):
    """Return the worst distance from MJX's and from C's one body, m."""
    asset = shapes.grid(shape, EDGE, dtype=np.float64)
    scene = build(
        asset,
        slots=3,
        chunk_contacts=False,
        iterations=100,
        line_search=20,
        tolerance=1e-15,
    )
    start = world.init(scene)
    center = np.asarray(start.bodies.center[0])
    lowest = (asset.chunk_centroid - asset.chunk_size)[:, 2].min()
    poses, speeds = zip(
        *(motion(kind, center[2] - float(lowest)) for kind, _ in cases), strict=True
    )
    poses, speeds = np.stack(poses), np.stack(speeds)
    steps = np.array([dt for _, dt in cases])

    def placed(pose, speed):
        data = start.data
        qpos = data.qpos.at[scene.host.slot_qpos[0]].set(pose)
        qvel = data.qvel.at[scene.host.slot_dof[0]].set(speed)
        return start.replace(data=data.replace(qpos=qpos, qvel=qvel))

    def ours(dt, now):
        model = scene.model.tree_replace({"opt.timestep": dt})
        return world.step(scene.replace(model=model), now)[0]

    model = one_body(asset, center)
    device = mjx.put_model(model, impl="jax")
    data = mjx.make_data(device)

    def theirs(dt, now):
        return mjx.step(device.tree_replace({"opt.timestep": dt}), now)

    # MJX's own plane-box function keeps other corners than C does.
    def as_in_c(m, d, key, geom):
        return contact._plane_box(m, d, geom)

    as_in_c.ncon = 4
    monkeypatch.setitem(collision_driver._COLLISION_FUNC, PLANE_BOX, as_in_c)
    monkeypatch.setattr(mjx_solver, "solve", polished)
    ours, theirs = jax.jit(jax.vmap(ours)), jax.jit(jax.vmap(theirs))
    worlds = jax.vmap(placed)(poses, speeds)
    datas = jax.vmap(lambda q, v: data.replace(qpos=q, qvel=v))(poses, speeds)
    mine, other = [], []
    for _ in range(round(seconds / steps.min())):
        worlds, datas = ours(steps, worlds), theirs(steps, datas)
        mine.append(np.asarray(worlds.data.qpos[:, scene.host.slot_qpos[0]]))
        other.append(np.asarray(datas.qpos))
    mine, other = (unit_quaternions(np.stack(x)) for x in (mine, other))

    from_mjx = from_c = 0.0
    for lane, dt in enumerate(steps):
        model.opt.timestep = dt
        native = mujoco.MjData(model)
        native.qpos[:], native.qvel[:] = poses[lane], speeds[lane]
        for step in range(round(seconds / dt)):
            mujoco.mj_step(model, native)
            off = mine[step, lane] - unit_quaternions(native.qpos)
            from_c = max(from_c, np.abs(off).max())
        count = round(seconds / dt)
        off = mine[:count, lane] - other[:count, lane]
        from_mjx = max(from_mjx, np.abs(off).max())
    return from_mjx, from_c


def test_unbroken_actor_is_a_rigid_body(x64, monkeypatch):
    cases = [("falling", 0.005), ("sliding", 0.005)]
    from_mjx, from_c = compare(monkeypatch, (4, 1, 1), cases, 1.0)
    assert from_mjx < MJX_ERROR
    assert from_c < C_ERROR


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(8, 1, 1), (4, 1, 2), (3, 3, 3)])
def test_unbroken_actor_is_a_rigid_body_for_two_seconds(x64, monkeypatch, shape):
    kinds = ("falling", "sliding", "resting")
    cases = [(kind, dt) for kind in kinds for dt in (0.002, 0.005)]
    from_mjx, from_c = compare(monkeypatch, shape, cases, 2.0)
    print(f"{shape}: {from_mjx:.1e} m from MJX, {from_c:.1e} m from C")
    assert from_mjx < MJX_ERROR
    assert from_c < C_ERROR


# What a split keeps.


def quantities(scene, moment):
    """Return mass, momentum, angular momentum about the origin, kinetic energy."""
    riding = moment.bodies
    seen = bodies.frames(scene, riding, moment.data)
    used = np.asarray(riding.label) >= 0
    total = [0.0, np.zeros(3), np.zeros(3), 0.0]
    for k in np.flatnonzero(used):
        x, v = np.asarray(seen.position[k], float), np.asarray(seen.velocity[k], float)
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, np.asarray(seen.quaternion[k], float))
        turn = matrix.reshape(3, 3)
        mass, inertia = float(riding.mass[k]), np.asarray(riding.inertia[k], float)
        w = np.asarray(seen.spin[k], float)
        total[0] += mass
        total[1] = total[1] + mass * v
        total[2] = total[2] + np.cross(x, mass * v) + turn @ inertia @ w
        total[3] += 0.5 * mass * v @ v + 0.5 * w @ inertia @ w
    return total


@jax.jit
def shatter(scene, moment, bonds):
    """Break bonds (B,) bool and regroup, without physics."""
    asset = scene.asset
    hit = jnp.where(jnp.asarray(bonds), 2.0, 0.0).astype(scene.position.dtype)
    state, _ = fracture.apply(asset, moment.state, Damage(bond=hit))
    state, parted = fracture.split(asset, state)
    return world._regroup(scene, moment, state, parted, False, 7)[0]


@pytest.mark.parametrize("double, tolerance", [(True, 1e-14), (False, 1e-6)])
def test_split_keeps_momentum_and_energy(double, tolerance):
    with jax.enable_x64(double):
        asset = block(dtype=np.float64 if double else np.float32)
        scene = build(asset, slots=8, position=(0.3, -0.2, 1.0), chunk_contacts=False)
        start = world.init(scene, velocity=(1.0, 2.0, -0.5), spin=(3.0, -1.0, 2.0))
        across = np.asarray(asset.bond_normal)[:, 0] > 0.5
        before = quantities(scene, start)
        halves = shatter(scene, start, across)
        pieces = shatter(scene, halves, np.ones_like(across))
        assert int(chunks.active(asset, pieces.state).sum()) == 8
        for after in (quantities(scene, halves), quantities(scene, pieces)):
            for a, b in zip(before, after, strict=True):
                scale = max(np.abs(a).max(), 1e-30)
                assert np.abs(np.asarray(a) - b).max() / scale < tolerance


def test_heavier_heir_keeps_the_slot_and_the_others_fill_up():
    # 2 x 1 x 3 cubes: cut off the upper layer of two, then all of it.
    asset = block((2, 1, 3))
    scene = build(asset, slots=4)
    start = world.init(scene)
    assert start.bodies.label.tolist() == [0, -1, -1, -1]
    place = np.asarray(asset.bond_centroid)
    upright = np.abs(np.asarray(asset.bond_normal)[:, 2]) > 0.5
    cut = shatter(scene, start, upright & (place[:, 2] > 0.8))
    top = min(np.flatnonzero(np.asarray(asset.chunk_centroid)[:, 2] > 1.0))
    assert cut.bodies.label.tolist() == [0, top, -1, -1]
    # The two pieces have known each other for as long as grace says, and only they.
    assert cut.bodies.grace[0, 1] == cut.bodies.grace[1, 0] == 7
    assert int((cut.bodies.grace > 0).sum()) == 2
    again = shatter(scene, start, upright & (place[:, 2] > 0.8))
    assert all(
        bool(jnp.all(a == b))
        for a, b in zip(jax.tree.leaves(cut), jax.tree.leaves(again), strict=True)
    )
    # Six equal cubes for four slots: the smaller labels stay.
    dust = shatter(scene, cut, np.ones(len(place), bool))
    labels = dust.bodies.label.tolist()
    assert sorted(labels) == [0, 1, 2, 3]
    assert labels[0] == 0 and labels[1] == top
    assert int(dust.debris.count) == 2
    assert np.isclose(float(dust.debris.volume), 2 * 0.125)
    assert np.isclose(float(dust.debris.mass), 2 * 125.0)
    assert (np.asarray(dust.state.actor) == -1).sum() == 2
    total = float((dust.bodies.mass * (dust.bodies.label >= 0)).sum())
    assert np.isclose(total + float(dust.debris.mass), 6 * 125.0)


def test_what_the_world_holds_stays_and_lets_go():
    asset = shapes.wall(2, 2, anchor=("z-",))
    assert asset.has_world
    scene = build(asset, slots=4, position=(0.0, 1.0, 0.5), chunk_contacts=False)
    start = world.init(scene)
    assert start.bodies.label.tolist() == [-1] * 4
    chunk = np.asarray(asset.element_chunk) >= 0
    assert (np.asarray(start.bodies.slot)[chunk] == scene.slots).all()
    place, _ = bodies.chunk_poses(scene, start.bodies, start.data)
    rest = np.asarray(asset.chunk_centroid)[np.asarray(asset.element_chunk)[chunk]]
    np.testing.assert_allclose(
        np.asarray(place)[chunk], rest + np.array([0, 1, 0.5]), atol=1e-6
    )
    to_world = np.asarray(asset.bond_nodes)[:, 1] == 0
    free = shatter(scene, start, to_world)
    assert int((free.bodies.label >= 0).sum()) == 1
    moved, _ = bodies.chunk_poses(scene, free.bodies, free.data)
    away = np.asarray(moved)[chunk] - np.asarray(place)[chunk]
    assert np.abs(away).max() < 1e-6
    assert float(jnp.abs(free.data.qvel).max()) == 0.0


# Collision.


@jax.jit
def find(scene, moment):
    model = bodies.weigh(scene, moment.bodies)
    seen = bodies.frames(scene, moment.bodies, moment.data)
    data, _ = bodies.kinematics(scene, model, moment.bodies, seen, moment.data)
    data, found = contact.collide(scene, moment.bodies, model, data)
    return data._impl.contact, found


def touching(scene, moment):
    """Return the contacts of a world at its start, and what was dropped."""
    contacts, found = find(scene, moment)
    active = np.asarray(contacts.dist < contacts.includemargin)
    return contacts, active, found


def test_resting_block_touches_with_its_lower_corners():
    scene = build(
        block((2, 1, 2)), slots=2, position=(0, 0, -0.001), chunk_contacts=False
    )
    found, active, seen = touching(scene, world.init(scene))
    assert active.sum() == 8
    np.testing.assert_allclose(np.asarray(found.dist)[active], -0.001, atol=1e-6)
    # Chunks of one actor do not meet: all contacts are with the floor, geom 0.
    assert (np.asarray(found.geom)[active, 0] == 0).all()
    assert int(seen.dropped.pairs) == int(seen.dropped.contacts) == 0


def test_pieces_meet_once_their_grace_is_over():
    asset = block((2, 1, 1))
    scene = build(asset, slots=2, position=(0, 0, 5.0))
    apart = shatter(scene, world.init(scene), np.ones(1, bool))
    # Push one cube into the other.
    x = scene.host.slot_qpos[1, 0]
    data = apart.data.replace(qpos=apart.data.qpos.at[x].add(-0.01))
    apart = apart.replace(data=data)
    _, active, _ = touching(scene, apart)
    assert not active.any()
    riding = apart.bodies
    for _ in range(7):
        riding = bodies.settle(scene, riding)
    # The overlap that they had when grace ended does not push them apart,
    _, active, seen = touching(scene, apart.replace(bodies=riding))
    assert not active.any()
    np.testing.assert_allclose(seen.overlap[0, 1], 0.01, atol=1e-6)
    # but more does, and what they lose of it they never get back.
    riding = riding.replace(overlap=seen.overlap)

    def at(offset):
        qpos = apart.data.qpos.at[x].add(offset)
        data = apart.data.replace(qpos=qpos)
        return apart.replace(data=data, bodies=riding)

    contacts, active, _ = touching(scene, at(-0.02))
    assert active.sum() == 4
    np.testing.assert_allclose(np.asarray(contacts.dist)[active], -0.02, atol=1e-6)
    _, _, seen = touching(scene, at(0.02))
    assert float(seen.overlap[0, 1]) == 0.0


def test_caps_keep_the_outline_and_count_what_they_drop():
    asset = block((3, 3, 1))
    scene = build(asset, slots=9, position=(0, 0, -0.001), max_contacts=10, max_pairs=2)
    found, active, seen = touching(scene, world.init(scene))
    assert active.sum() == 10
    assert int(seen.dropped.contacts) == 36 - 10
    kept = np.asarray(found.pos)[:, :2]
    corners = np.array([(x, y) for x in (-0.75, 0.75) for y in (-0.75, 0.75)])
    gap = np.linalg.norm(kept[:, None] - corners[None], axis=-1).min(axis=0)
    assert gap.max() < 1e-5
    dust = shatter(scene, world.init(scene), np.ones(12, bool))
    riding = dust.bodies.replace(grace=jnp.zeros_like(dust.bodies.grace))
    _, _, seen = touching(scene, dust.replace(bodies=riding))
    # 12 pairs share a face and 8 an edge; bounding spheres overlap for all of them.
    assert int(seen.dropped.pairs) == 20 - 2


def test_chunks_of_no_actor_touch_nothing():
    asset = block((2, 1, 1))
    scene = build(asset, slots=2, position=(0, 0, -0.001), chunk_contacts=False)
    state = fracture.init(asset)
    state = fracture.deactivate(asset, state, jnp.ones(2, bool))
    empty = world.init(scene, state)
    _, active, _ = touching(scene, empty)
    assert not active.any()
    assert empty.bodies.label.tolist() == [-1, -1]


# The solver.


def random_rows(rng, unknowns, count):
    upper = np.where(np.arange(count) < 2, np.inf, 0.0)
    upper[2:4] = 0.3
    lower = np.where(np.isfinite(upper) & (upper > 0), -upper, -np.inf)
    return solver.Rows(
        jacobian=jnp.asarray(rng.normal(size=(count, unknowns))),
        stiffness=jnp.asarray(rng.uniform(0.5, 50.0, size=count)),
        reference=jnp.asarray(rng.normal(size=count)),
        lower=jnp.asarray(lower),
        upper=jnp.asarray(upper),
    )


def random_contacts(rng, size, count, slots, sides, users):
    one = rng.integers(0, slots + 1, count)
    other = (one + rng.integers(1, slots + 1, count)) % (slots + 1)

    def side(slot):
        jacobian = jnp.asarray(rng.normal(size=(size, 6, count)))
        return jnp.asarray(slot, jnp.int32), jacobian

    user = jnp.asarray(rng.normal(size=(size, count, users)))
    return solver.Contacts(
        sides=tuple(map(side, (one, other)[:sides])),
        user=user if users else None,
        stiffness=jnp.asarray(rng.uniform(0.5, 50.0, size=count)),
        reference=jnp.asarray(rng.normal(size=(size, count))),
    )


def random_problem(seed, users=5, slots=3, sides=2, meets=True):
    """A problem of all kinds of rows, and contacts with 1, 3 and 4 dimensions."""
    rng = np.random.default_rng(seed)

    def inertia(size):
        root = rng.normal(size=(size, size))
        return jnp.asarray(root @ root.T + np.eye(size))

    return solver.Problem(
        user_inertia=inertia(users),
        slot_inertia=jnp.stack([inertia(6) for _ in range(slots)], axis=-1),
        free=solver.Motion(
            user=jnp.asarray(rng.normal(size=users)),
            slots=jnp.asarray(rng.normal(size=(6, slots))),
        ),
        rows=random_rows(rng, users, 12) if users else None,
        contacts=tuple(
            random_contacts(rng, size, 4, slots, sides, users if meets else 0)
            for size in (1, 3, 4)
        ),
    )


PROBLEMS = {
    "coupled": {},
    "without user": {"users": 0},
    "apart": {"sides": 1, "meets": False},
    "blocks": {"users": 0, "sides": 1},
}


def solution(problem):
    guess = jax.tree.map(jnp.zeros_like, problem.free)
    return solver.solve(problem, guess, 0.0, iterations=50, search_steps=20)


@jax.jit
def dense(problem):
    """Return M, J, D, r, lower, upper and a0 without any structure."""

    def split(flat):
        users, slots = problem.free.user.shape[0], problem.free.slots.shape[1]
        return solver.Motion(flat[:users], flat[users:].reshape(slots, 6).T)

    def edges(flat):
        own, contacts = solver.apply_jacobian(problem, split(flat))
        parts = [] if own is None else [own]
        parts += [solver._edges(x).reshape(-1) for x in contacts]
        return jnp.concatenate(parts)

    free = rows.vector(problem.free)
    jacobian = jax.jacfwd(edges)(jnp.zeros_like(free))
    mass = jax.jacfwd(lambda a: rows.vector(solver.apply_inertia(problem, split(a))))
    own = problem.rows
    parts = (
        [] if own is None else [(own.stiffness, own.reference, own.lower, own.upper)]
    )
    for c in problem.contacts:
        wanted = solver._edges(c.reference)
        stiff = jnp.broadcast_to(c.stiffness, wanted.shape)
        ends = jnp.full_like(wanted, -jnp.inf), jnp.zeros_like(wanted)
        parts.append(tuple(x.reshape(-1) for x in (stiff, wanted, *ends)))
    rest = [jnp.concatenate(x) for x in zip(*parts, strict=True)]
    return mass(free), jacobian, *rest, free


@pytest.mark.parametrize("kind", PROBLEMS)
def test_solver_finds_the_minimum_of_equalities_friction_and_contacts(x64, kind):
    solve = jax.jit(solution)
    for seed in range(3):
        problem = random_problem(seed, **PROBLEMS[kind])
        a, forces, pull, report = solve(problem)
        seen = map(np.asarray, dense(problem))
        mass, jacobian, stiff, wanted, lower, upper, free = seen
        a = np.asarray(rows.vector(a))
        push = np.clip(stiff * (jacobian @ a - wanted), lower, upper)
        own = [] if forces.rows is None else [forces.rows]
        force = np.concatenate([x.reshape(-1) for x in (*own, *forces.edges)])
        np.testing.assert_allclose(force, -push, atol=1e-12)
        np.testing.assert_allclose(rows.vector(pull), -push @ jacobian, atol=1e-11)
        assert np.abs(mass @ (a - free) + push @ jacobian).max() < 1e-12
        assert float(report.residual) < 1e-13
        assert int(report.iterations) < 15


@pytest.mark.parametrize("kind", ["coupled", "blocks"])
def test_solver_has_forward_and_reverse_derivatives(x64, kind):
    problem = random_problem(1, **PROBLEMS[kind])
    leaves, form = jax.tree.flatten(problem)
    real = [jnp.issubdtype(x.dtype, jnp.floating) for x in leaves]
    values = [x for x, is_real in zip(leaves, real, strict=True) if is_real]
    rng = np.random.default_rng(2)
    tangents = [jnp.asarray(rng.normal(size=x.shape)) for x in values]

    def answer(values):
        left = iter(values)
        mixed = [next(left) if r else x for x, r in zip(leaves, real, strict=True)]
        changed = jax.tree.unflatten(form, mixed)
        user, slots = changed.user_inertia, changed.slot_inertia
        changed = changed.replace(
            user_inertia=0.5 * (user + user.T),
            slot_inertia=0.5 * (slots + slots.transpose(1, 0, 2)),
        )
        a, forces, _, _ = solution(changed)
        return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves((a, forces)))

    @jax.jit
    def slopes(h):
        near = [x + h * t for x, t in zip(values, tangents, strict=True)]
        value, forward = jax.jvp(answer, (near,), (tangents,))
        pulled = jax.grad(answer)(near)
        reverse = sum(jnp.sum(g * t) for g, t in zip(pulled, tangents, strict=True))
        return value, forward, reverse

    h = 1e-6
    (below, _, _), (_, forward, reverse), (above, _, _) = map(slopes, (-h, 0.0, h))
    assert abs(reverse / forward - 1) < 1e-12
    assert abs((above - below) / (2 * h) / forward - 1) < 1e-7


@pytest.mark.parametrize(
    "integrator", ["Euler", pytest.param("implicitfast", marks=pytest.mark.slow)]
)
def test_a_body_whose_inertia_lies_askew_tumbles_as_euler_says(x64, integrator):
    """Also beside a joint of the user's that is damped implicitly."""
    model = f"""
    <mujoco><option integrator="{integrator}" gravity="0 0 0" timestep="0.001"/>
      <worldbody><body pos="9 0 0"><joint axis="0 1 0" damping="1"/>
        <geom type="box" size=".1 .2 .3"/></body></worldbody></mujoco>"""
    inertia = np.array([[0.05, 0.02, -0.01], [0.02, 0.11, 0.03], [-0.01, 0.03, 0.09]])
    asset = block((1, 1, 1))
    askew = asset.replace(chunk_inertia=jnp.asarray(inertia)[None])
    scene = build(askew, slots=1, model=model, density=1.0, chunk_contacts=False)
    spin = np.array([1.0, 5.0, 2.0])
    start = world.init(scene, spin=spin)
    push = np.array([0.3, -0.2, 0.1, 0.02, 0.05, -0.04])
    slot = scene.host.slot_body[0]
    data = start.data.replace(xfrc_applied=start.data.xfrc_applied.at[slot].set(push))
    data = data.replace(qvel=data.qvel.at[0].set(2.0))
    moment, _ = jax.jit(world.step)(scene, start.replace(data=data))
    change = (moment.data.qvel - data.qvel) / 0.001
    mass = float(asset.chunk_volume[0])
    turn = np.linalg.solve(inertia, push[3:] - np.cross(spin, inertia @ spin))
    expected = np.concatenate([push[:3] / mass, turn])
    np.testing.assert_allclose(change[scene.host.slot_dof[0]], expected, rtol=1e-9)
    # The joint: (I + h d) a = -d w.
    own = mujoco.MjModel.from_xml_string(model)
    about = own.body_inertia[1, 1]
    np.testing.assert_allclose(change[0], -2.0 / (about + 0.001), rtol=1e-9)


# The tie to MJX.

ROBOT = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .05"/>
    <body name="arm" pos="0 0 1">
      <joint name="a" type="hinge" axis="0 1 0" damping="0.1" range="-40 40"
        limited="true"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05" contype="0"
        conaffinity="0"/>
      <body name="fore" pos="0.5 0 0">
        <joint name="b" type="hinge" axis="0 1 0" frictionloss="0.2"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.04" contype="0"
          conaffinity="0"/>
      </body>
    </body>
    <body name="ball" pos="2 0 0.3"><freejoint/><geom size="0.1"/></body>
  </worldbody>
  <equality><weld body1="fore" body2="world" active="false"/></equality>
  <actuator><position name="p" joint="b" kp="5"/></actuator>
  <sensor><jointpos joint="a"/><jointvel joint="b"/></sensor>
</mujoco>
"""


def test_canary_robots_move_as_mjx_moves_them(x64):
    """Whatever MJX changes inside, a step of ours stays a step of MJX."""
    scene = build(
        shapes.grid((1, 1, 1), EDGE, dtype=np.float64),
        slots=1,
        position=(0, 9.0, 2.0),
        model=ROBOT,
        iterations=50,
        line_search=20,
        tolerance=1e-15,
    )
    user = mujoco.MjSpec.from_string(ROBOT)
    user.option.iterations, user.option.tolerance = 50, 1e-15
    model = mjx.put_model(user.compile(), impl="jax")
    data = mjx.make_data(model).replace(ctrl=jnp.array([0.7]))
    theirs = jax.jit(mjx.step)
    ours = jax.jit(lambda w: world.step(scene, w, ctrl=jnp.array([0.7])))
    moment = world.init(scene)
    for _ in range(150):
        data = theirs(model, data)
        moment, events = ours(moment)
    count = model.nq
    np.testing.assert_allclose(moment.data.qpos[:count], data.qpos, atol=1e-9)
    np.testing.assert_allclose(moment.data.sensordata, data.sensordata, atol=1e-9)
    # The chunk is a ball game of its own: free fall.
    time = 150 * 0.004
    drop = float(moment.data.qpos[scene.host.slot_qpos[0, 2]]) - (2.0 + 0.25)
    assert abs(drop + 9.81 * 0.5 * time * (time + 0.004)) < 1e-9
    assert events.damage is None


WATCHED = """
<mujoco>
  <worldbody>
    <light pos="0 0 9"/>
    <geom type="plane" size="0 0 .05" pos="0 0 -0.1" euler="3 0 0"/>
    <camera name="seen" mode="targetbody" target="chunk0" pos="3 0 1"/>
    <body name="post" pos="5 0 0" euler="0 20 10">
      <geom size="0.1 0.2 0.3" type="box" pos="0.1 0 0.2" euler="10 0 0"/>
      <body name="shelf" pos="0.5 0.1 0" euler="0 0 40">
        <geom size="0.1"/><site name="top" pos="0 0.2 0" euler="0 5 0"/>
      </body>
    </body>
    <body name="hand" mocap="true" pos="4 4 4">
      <geom size="0.1" contype="0" conaffinity="0"/>
    </body>
    {}
  </worldbody>
  <sensor>
    <framelinvel objtype="body" objname="slot0"/>
    <frameangvel objtype="body" objname="slot1"/>
    <framepos objtype="body" objname="chunk2"/>
  </sensor>
</mujoco>
"""


@pytest.mark.parametrize("jointed", [False, True])
def test_bodies_are_where_mjx_puts_them(x64, jointed):
    arm = """<body pos="2 0 1"><joint axis="0 1 0" pos="0.1 0 0"/><geom size="0.1"/>
      <body pos="0.5 0 0"><joint type="ball"/><geom size="0.1" pos="0 0.1 0"/></body>
    </body>"""
    scene = build(
        shapes.grid((3, 1, 1), EDGE, dtype=np.float64),
        slots=3,
        position=(0, 0, 2.0),
        chunk_contacts=False,
        model=WATCHED.format(arm if jointed else ""),
    )
    everything = Damage(bond=jnp.full(len(scene.asset.bond_area), 2.0))
    state, _ = fracture.step(scene.asset, fracture.init(scene.asset), everything)
    start = world.init(scene, state)
    rng = np.random.default_rng(3)
    data, model = start.data, bodies.weigh(scene, start.bodies)
    data = data.replace(
        qpos=data.qpos + 0.3 * rng.standard_normal(data.qpos.shape),
        qvel=jnp.asarray(rng.standard_normal(data.qvel.shape)),
        mocap_quat=data.mocap_quat.at[0].set([0.3, 0.4, 0.5, 0.6]),
    )
    start = start.replace(data=data)

    def ours(start):
        seen = bodies.frames(scene, start.bodies, start.data)
        data, own = bodies.kinematics(scene, model, start.bodies, seen, start.data)
        data = engine.position_sensors(model, data)
        return bodies.accelerate(scene, model, start.bodies, seen, data, own)[0]

    def theirs(start):
        data = bodies.place(scene, start.bodies, start.data)
        for stage in ("kinematics", "com_pos", "camlight", "com_vel"):
            data = getattr(engine.smooth, stage)(model, data)
        return engine.sensor.sensor_vel(model, engine.sensor.sensor_pos(model, data))

    found, expected = jax.jit(ours)(start), jax.jit(theirs)(start)
    names = (
        "qpos xpos xquat xmat xipos xanchor xaxis geom_xpos geom_xmat site_xpos "
        "site_xmat cam_xpos cam_xmat mocap_pos mocap_quat cdof cvel cdof_dot sensordata"
    )
    for name in names.split():
        a, b = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(a, b, atol=1e-13, err_msg=name)
    slots = scene.host.slot_body
    np.testing.assert_array_equal(found.subtree_com[slots], found.xpos[slots])
    assert np.abs(found.sensordata).min() > 0


def test_canary_private_names():
    model = inspect.signature(engine.smooth.kinematics).parameters
    assert list(model) == ["m", "d"]
    for module, names in (
        (
            engine.smooth,
            "com_pos com_vel crb transmission camlight tendon tendon_armature",
        ),
        (engine.forward, "fwd_velocity fwd_actuation _advance"),
        (engine.sensor, "sensor_pos sensor_vel sensor_acc"),
        (engine.support, "jac full_m"),
        (engine.derivative, "deriv_smooth_vel"),
        (engine.constraint, "_kbi make_constraint make_efc_type make_efc_address"),
    ):
        for name in names.split():
            assert callable(getattr(module, name)), name
    for name in ("_contact_groups", "_COLLISION_FUNC", "_numeric", "geom_pairs"):
        assert hasattr(engine.collision_driver, name)


# Validation.


@pytest.mark.parametrize(
    "options, message",
    [
        ({"slots": 0}, "slots is 0"),
        ({"position": (0, 0)}, "position has shape"),
        ({"position": (0, 0, np.nan)}, "position .* not finite"),
        ({"quaternion": (0, 0, 0, 0)}, "quaternion .* no length"),
        ({"density": 0.0}, "density is 0.0 kg"),
        ({"density": np.ones(3)}, "density has shape"),
        ({"density": np.r_[np.ones(7), -1.0]}, "density of chunk 7 is -1.0"),
        ({"friction": -1.0}, "friction is -1.0"),
        ({"collision": "mesh"}, "collision is 'mesh', .*use 'hull'"),
        ({"timestep": 0.0}, "timestep is 0.0"),
        ({"max_contacts": 0}, "max_contacts is 0"),
        ({"iterations": 0}, "iterations 0"),
        ({"model": "nowhere.xml"}, "neither MJCF nor a file"),
        ({"model": "<mujoco><option cone='elliptic'/></mujoco>"}, "elliptic"),
        ({"model": "<mujoco><option integrator='RK4'/></mujoco>"}, "integrator"),
        (
            {"model": "<mujoco><worldbody><body name='slot3'/></worldbody></mujoco>"},
            "a body 'slot3'",
        ),
        (
            {
                "model": "<mujoco><equality><weld body1='slot0' body2='world'/>"
                "</equality></mujoco>"
            },
            "an equality constraint of the model is on a chunk or a slot",
        ),
    ],
)
def test_build_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        build(block(), **options)


@pytest.mark.parametrize(
    "field, value, message",
    [
        ("chunk_size", 0.0, r"element 3 \(chunk 3\) has half extents"),
        ("chunk_volume", 0.0, r"element 3 \(chunk 3\) has volume 0.0"),
        ("chunk_inertia", 0.0, r"element 3 \(chunk 3\) has an inertia"),
        ("chunk_centroid", np.nan, r"element 3 \(chunk 3\) has centroid"),
    ],
)
def test_build_refuses_chunks_that_cannot_move(field, value, message):
    asset = block()
    broken = asset.replace(**{field: getattr(asset, field).at[3].set(value)})
    with pytest.raises(ValueError, match=message):
        build(broken)


def test_user_model_keeps_its_addresses():
    scene = build(block(), model=ROBOT, slots=2)
    model = scene.host.model
    own = mujoco.MjModel.from_xml_string(ROBOT)
    for kind, count in (
        (mujoco.mjtObj.mjOBJ_BODY, own.nbody),
        (mujoco.mjtObj.mjOBJ_GEOM, own.ngeom),
        (mujoco.mjtObj.mjOBJ_JOINT, own.njnt),
    ):
        for i in range(count):
            name = mujoco.mj_id2name(own, kind, i)
            assert mujoco.mj_id2name(model, kind, i) == name
    assert (scene.host.slot_qpos >= own.nq).all()
    assert hash(jax.tree.structure(scene)) == hash(jax.tree.structure(scene))


def test_unbreakable_healths_pass_through_init():
    scene = build(block(), slots=2)
    start = world.init(scene, bond_health=UNBREAKABLE)
    assert start.state.bond_unbreakable is not None


def test_the_users_own_meet_where_no_chunk_meets_anything():
    bits = 'contype="2" conaffinity="2"'
    model = (
        f'<mujoco><worldbody><geom type="plane" size="0 0 .05" {bits}/>'
        f'<body pos="0 0 0.0995"><freejoint/><geom type="sphere" size="0.1" {bits}/>'
        "</body></worldbody></mujoco>"
    )
    scene = build(
        block((1, 1, 1)), model=model, position=(2.0, 0, 1.0), chunk_contacts=False
    )
    assert scene.host.chunk_sides == () and scene.host.user_meets
    end, _ = jax.jit(lambda w: world.rollout(scene, w, 50))(world.init(scene))
    duration = 50 * scene.host.model.opt.timestep
    fallen = 1.25 - end.data.qpos[scene.host.slot_qpos[0, 2]]
    assert fallen == pytest.approx(9.81 * duration**2 / 2, rel=0.05)
    assert end.data.qpos[2] == pytest.approx(0.1, abs=1e-3)
