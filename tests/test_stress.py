"""Bond forces: statics by hand, a direct solve, and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from blastjax import author, fracture, stress
from blastjax.author import shapes
from blastjax.core import WORLD

pytestmark = pytest.mark.usefixtures("strict")

HAND = {"float32": 1e-4, "float64": 1e-6}
"""Relative error of forces against statics by hand."""
SLOPE = 1e-7
"""Relative error of derivatives against central differences in float64."""
G = 10.0
DOWN = np.array([0.0, 0.0, -G])


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


FLOAT64_IF_SLOW = pytest.mark.parametrize(
    "dtype",
    ["float32", pytest.param("float64", marks=pytest.mark.slow)],
    indirect=True,
)
"""In float64 only with `-m slow`: a chain and all direct solves are in float64 too, and
these programs are dear to compile."""


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def solved(asset, load=DOWN, state=None, **options):
    """Return the structure and its solution under gravity."""
    frame = stress.structure(asset, **options)
    state = fracture.init(asset) if state is None else state
    weight = stress.gravity(frame.mass, jnp.asarray(load, asset.bond_area.dtype))
    run = jax.jit(stress.solve, static_argnames="iterations")
    return frame, run(frame, asset, state, weight, iterations=400)


def stresses(asset, found):
    """Return the stresses of bonds between nodes one metre apart."""
    return stress.bond_stress(
        found.force,
        found.torque,
        asset.bond_normal,
        asset.bond_area,
        jnp.ones_like(asset.bond_area),
    )


def by_place(asset, axis):
    """Return bonds in order along an axis."""
    return np.argsort(np.asarray(asset.bond_centroid)[:, axis])


def close(found, expected, dtype):
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=HAND[dtype.name] * scale)


@pytest.mark.parametrize("method", ["two-level", "force"])
def test_hanging_chain(dtype, method):
    asset = shapes.grid((1, 1, 12), (0.5, 0.5, 1.0), anchor=("z+",), dtype=dtype)
    _, found = solved(asset, method=method)
    assert found.converged
    order = by_place(asset, 2)
    # The force on the first, lower node points up; at the top the world is the second.
    weight = 0.25 * 1000 * G
    close(np.asarray(found.force)[order, 2], weight * np.arange(1, 13), dtype)
    judged = stresses(asset, found)
    close(np.asarray(judged.normal)[order], 1000 * G * np.arange(1, 13.0), dtype)


@FLOAT64_IF_SLOW
def test_cantilever(dtype):
    asset = shapes.beam(9, (1.0, 0.5, 0.5), anchor=("x-",), dtype=dtype)
    _, found = solved(asset)
    order, line = by_place(asset, 0), 0.25 * 1000 * G
    free = 9.0 - np.arange(9.0)
    force, torque = np.asarray(found.force)[order], np.asarray(found.torque)[order]
    # The world is second in its bond, so its first node is pushed up from behind.
    sign = np.where(np.asarray(asset.bond_nodes)[order, 1] == 0, 1.0, -1.0)
    close(sign * force[:, 2], line * free, dtype)
    close(sign * -torque[:, 1], line * free**2 / 2, dtype)


@FLOAT64_IF_SLOW
def test_simply_supported_beam(dtype):
    asset = shapes.grid((8, 1, 1), (1.0, 0.5, 0.5), anchor=("x-", "x+"), dtype=dtype)
    ends = np.asarray(asset.bond_nodes)[:, 1] == 0
    stiffness = 1e6 * np.ones(len(ends))
    bending = np.where(ends, 0.0, 1e6)
    _, found = solved(asset, stiffness=stiffness, bending=bending)
    assert found.converged
    line = 0.25 * 1000 * G
    moment = np.abs(np.asarray(found.torque)[by_place(asset, 0), 1])
    x = np.arange(9.0)
    close(moment, line * x * (8 - x) / 2, dtype)


@FLOAT64_IF_SLOW
def test_three_hinged_arch(dtype):
    # Blocks on a half circle; hinges at both feet and the crown.
    count, radius = 12, 5.0
    angle = np.pi * (np.arange(count) + 0.5) / count
    joint = np.pi * np.arange(count + 1) / count
    place = radius * np.stack([-np.cos(angle), 0 * angle, np.sin(angle)], 1)
    at = radius * np.stack([-np.cos(joint), 0 * joint, np.sin(joint)], 1)
    pairs = [[0, WORLD], *([i, i + 1] for i in range(count - 1))]
    pairs.append([count - 1, WORLD])
    normal = np.tile([1.0, 0, 0], (count + 1, 1))
    built = author.build(
        author.Chunks(np.full(count, -1), place, np.ones(count)),
        author.Bonds(pairs, normal, np.ones(count + 1), at),
        dtype=dtype,
    )
    asset = built.asset
    bending = np.full(count + 1, 1e3)
    bending[built.bond_map[[0, count // 2, count]]] = 0.0
    stiffness = np.full(count + 1, 1e3)
    _, found = solved(asset, stiffness=stiffness, bending=bending)
    weight = 1000 * G
    half = place[: count // 2]
    lift = weight * count / 2
    # Moments of the left half about the crown.
    arm = (weight * (0 - half[:, 0])).sum()
    thrust = (lift * radius - arm) / radius
    foot = np.asarray(found.force)[built.bond_map[0]]
    close(foot, np.array([thrust, 0, lift]), dtype)
    crown = np.asarray(found.force)[built.bond_map[count // 2]]
    close(np.abs(crown), np.array([thrust, 0, 0]), dtype)


@FLOAT64_IF_SLOW
def test_symmetric_tower(dtype):
    asset = shapes.tower(4, 3, (1.0, 1.0, 1.0), dtype=dtype)
    _, found = solved(asset)
    to_world = np.asarray(asset.bond_nodes)[:, 1] == 0
    feet = np.asarray(found.force)[to_world]
    place = np.asarray(asset.bond_centroid)[to_world]
    np.testing.assert_allclose(feet[:, 2].sum(), 32 * 1000 * G, rtol=HAND[dtype.name])
    corner = np.abs(place[:, :2]).min(axis=1) > 0.5
    for group in (feet[corner, 2], feet[~corner, 2]):
        close(group, np.full(4, group.mean()), dtype)
    moment = np.cross(place, feet).sum(0)
    np.testing.assert_allclose(moment, 0, atol=HAND[dtype.name] * 32e4)


def random_break(asset, part, seed):
    state = fracture.init(asset)
    keep = np.random.default_rng(seed).random(len(asset.bond_area)) > part
    return state.replace(bond_intact=state.bond_intact & jnp.asarray(keep))


def direct(asset, frame, state, load):
    """Return bond forces (B, 6) by a dense least-squares solve in float64."""
    pairs = np.asarray(asset.bond_nodes)
    chunk = np.asarray(asset.element_chunk)[: len(frame.mass)]
    place = np.zeros((len(chunk), 3))
    place[chunk >= 0] = np.asarray(asset.chunk_centroid)[chunk[chunk >= 0]]
    at, alive = np.asarray(asset.bond_centroid), np.asarray(state.bond_intact)
    root = np.sqrt(np.where(alive, np.stack([frame.stiffness, frame.bending]), 0))
    root = np.repeat(root.T, 3, axis=1).astype(float)
    gather = np.zeros((len(chunk), 6, len(pairs), 6))
    for b, ends in enumerate(pairs):
        for node, sign in zip(ends, (1, -1), strict=True):
            if chunk[node] >= 0:
                x, y, z = at[b] - place[node]
                gather[node, :, b] = sign * np.eye(6)
                cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                gather[node, 3:, b, :3] = sign * cross
    matrix = (gather * root[None, None]).reshape(len(chunk) * 6, -1)
    right = np.concatenate([load.force, load.torque], axis=1).astype(float)
    balanced = -right.reshape(-1)
    # A floating piece bears what is left after its rigid acceleration.
    count, piece = scipy.sparse.csgraph.connected_components(
        scipy.sparse.coo_matrix(
            (np.ones(alive.sum()), pairs[alive].T), (len(chunk), len(chunk))
        ),
        directed=False,
    )
    mass, inertia = np.asarray(frame.mass, float), np.asarray(frame.inertia, float)
    for p in range(count):
        nodes = np.flatnonzero(piece == p)
        if (chunk[nodes] < 0).any():
            continue
        motion = np.zeros((len(nodes), 6, 6))
        for i, node in enumerate(nodes):
            x, y, z = place[node]
            motion[i] = np.eye(6)
            motion[i, :3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        weight = np.zeros((len(nodes), 6, 6))
        weight[:, :3, :3] = mass[nodes, None, None] * np.eye(3)
        weight[:, 3:, 3:] = inertia[nodes]
        pulled = weight @ motion
        whole = np.einsum("nij,nik->jk", motion, pulled)
        total = np.einsum("nij,ni->j", motion, right[nodes])
        moved = np.einsum("nij,j->ni", pulled, np.linalg.solve(whole, total))
        balanced.reshape(-1, 6)[nodes] += moved
    strain = np.linalg.lstsq(matrix, balanced, rcond=1e-12)[0]
    return strain.reshape(-1, 6) * root


CASES = {
    "anchored": lambda d: (shapes.grid((3, 2, 3), anchor=("z-",), dtype=d), 0.0),
    "floating": lambda d: (shapes.grid((3, 2, 2), dtype=d), 0.0),
    "broken": lambda d: (shapes.grid((3, 2, 3), anchor=("z-",), dtype=d), 0.25),
    "pieces": lambda d: (shapes.grid((3, 2, 3), anchor=("z-",), dtype=d), 0.55),
}


def varied(asset, seed=0):
    """Return a structure and a load without symmetry."""
    rng = np.random.default_rng(seed)
    bonds = len(asset.bond_area)
    frame = stress.structure(
        asset,
        density=rng.uniform(500, 2000, len(asset.chunk_volume)),
        stiffness=10 ** rng.uniform(5, 7, bonds),
        bending=10 ** rng.uniform(4, 6, bonds),
    )
    kind = asset.bond_area.dtype
    load = stress.gravity(frame.mass, jnp.asarray([1.0, 2.0, -9.0], kind))
    push = rng.normal(size=(2, *load.force.shape)) * 3000
    return frame, stress.add(load, stress.Load(*jnp.asarray(push, kind)))


@pytest.mark.parametrize("method", ["two-level", "force"])
@pytest.mark.parametrize("name", CASES)
def test_forces_are_those_of_a_direct_solve(x64, name, method):
    asset, part = CASES[name](np.float64)
    state = random_break(asset, part, 3)
    frame, load = varied(asset)
    frame = stress.structure(
        asset, stiffness=frame.stiffness, bending=frame.bending, method=method
    ).replace(mass=frame.mass, inertia=frame.inertia)
    found = jax.jit(stress.solve)(frame, asset, state, load)
    expected = direct(asset, frame, state, load)
    both = np.concatenate([found.force, found.torque], axis=1)
    np.testing.assert_allclose(both, expected, atol=1e-8 * np.abs(expected).max())
    assert found.converged


@pytest.mark.parametrize(
    "name, method",
    [
        ("anchored", "two-level"),
        pytest.param("pieces", "two-level", marks=pytest.mark.slow),
        ("floating", "force"),
        ("broken", "force"),
    ],
)
def test_derivatives_are_central_differences(x64, name, method):
    asset, part = CASES[name](np.float64)
    state = random_break(asset, part, 3)
    frame, load = varied(asset)
    plan = stress.structure(
        asset, stiffness=frame.stiffness, bending=frame.bending, method=method
    )
    rng = np.random.default_rng(1)
    weight = jnp.asarray(rng.normal(size=(len(asset.bond_area), 6)))
    names = ("load", "stiffness", "bending", "mass", "centroid", "bond")
    parts = {
        "load": load.force,
        "stiffness": jnp.log(frame.stiffness),
        "bending": jnp.log(frame.bending),
        "mass": frame.mass,
        "centroid": asset.chunk_centroid,
        "bond": asset.bond_centroid,
    }

    def loss(p):
        built = plan.replace(
            stiffness=jnp.exp(p["stiffness"]),
            bending=jnp.exp(p["bending"]),
            mass=p["mass"],
            inertia=frame.inertia,
        )
        moved = asset.replace(chunk_centroid=p["centroid"], bond_centroid=p["bond"])
        found = stress.solve(
            built, moved, state, load.replace(force=p["load"]), tolerance=1e-13
        )
        both = jnp.concatenate([found.force, found.torque], axis=1)
        return jnp.sum(weight * both)

    # One program for both: what compiling costs is more than what running costs.
    valued = jax.jit(jax.value_and_grad(loss))
    slope = valued(parts)[1]
    for name in names:
        way = jnp.asarray(rng.normal(size=parts[name].shape))
        step = 1e-2 * float(jnp.abs(parts[name]).max()) / 3
        if name in ("stiffness", "bending", "centroid", "bond"):
            step = 1e-3

        def along(t, name=name, way=way):
            return float(valued({**parts, name: parts[name] + t * way})[0])

        # Fourth order: what is left is the rounding of the loss.
        near, far = along(step) - along(-step), along(2 * step) - along(-2 * step)
        central = (8 * near - far) / (12 * step)
        found = float(jnp.sum(slope[name] * way))
        scale = float(jnp.sqrt(jnp.sum(slope[name] ** 2) * jnp.sum(way**2)))
        assert abs(found - central) <= SLOPE * scale, name

    tangent = {k: jnp.ones_like(v) for k, v in parts.items()}
    forward = jax.jit(lambda p, t: jax.jvp(loss, (p,), (t,))[1])(parts, tangent)
    reverse = sum(jnp.sum(x) for x in slope.values())
    total = sum(float(jnp.abs(x).sum()) for x in slope.values())
    assert abs(float(forward - reverse)) < SLOPE * total


@pytest.mark.parametrize(
    "method", [pytest.param("two-level", marks=pytest.mark.slow), "force"]
)
def test_derivatives_in_float32_are_those_in_float64(method):
    def slope(kind):
        with jax.enable_x64(kind == np.float64):
            asset, _ = CASES["anchored"](kind)
            frame, load = varied(asset)
            plan = stress.structure(
                asset, stiffness=frame.stiffness, bending=frame.bending, method=method
            ).replace(mass=frame.mass, inertia=frame.inertia)

            def loss(push):
                return jnp.sum(stress.solve(plan, asset, state, push).force ** 2) / 1e8

            state = fracture.init(asset)
            return np.asarray(jax.jit(jax.grad(loss))(load).force)

    exact = slope(np.float64)
    error = np.linalg.norm(slope(np.float32) - exact) / np.linalg.norm(exact)
    assert error < 1e-5


EXTREMES = ("no load", "isolated nodes", "all broken", "soft")


@jax.jit
@functools.partial(jax.grad, argnums=(0, 1, 2), has_aux=True, allow_int=True)
def slope_of_worth(frame, asset, load, state):
    """Return the slope of what bonds are used, and the solution."""
    found = stress.solve(frame, asset, state, load)
    judged = stresses(asset, found)
    worth = stress.utilisation(stress.Limits(1e6, 2e6), judged)
    return jnp.sum(worth) + jnp.sum(found.force), found


@pytest.mark.parametrize(
    "extreme, method",
    [
        ("no load", "two-level"),
        *((extreme, "force") for extreme in EXTREMES),
        *(
            pytest.param(extreme, "two-level", marks=pytest.mark.slow)
            for extreme in EXTREMES[1:]
        ),
    ],
)
def test_extremes_stay_finite(method, extreme):
    asset, _ = CASES["anchored"](np.float32)
    state = fracture.init(asset)
    frame, load = varied(asset)
    stiffness, bending = frame.stiffness, frame.bending
    if extreme == "no load":
        load = jax.tree.map(jnp.zeros_like, load)
    if extreme == "isolated nodes":
        touches = (asset.bond_nodes == 3).any(axis=1) | (asset.bond_nodes == 7).any(1)
        state = state.replace(bond_intact=state.bond_intact & ~touches)
    if extreme == "all broken":
        state = state.replace(bond_intact=jnp.zeros_like(state.bond_intact))
    if extreme == "soft":
        stiffness = jnp.where(jnp.arange(len(stiffness)) % 5 == 0, 0.0, stiffness)
        bending = jnp.where(stiffness > 0, bending, 0.0)
    plan = stress.structure(asset, stiffness=stiffness, bending=bending, method=method)

    slope, found = slope_of_worth(plan, asset, load, state)
    assert found.converged
    for leaf in jax.tree.leaves((slope, found)):
        if leaf.dtype != jax.dtypes.float0:
            assert np.isfinite(leaf).all()
    if extreme in ("no load", "all broken"):
        assert float(jnp.abs(found.force).max()) == 0.0


def test_bad_structures_are_refused():
    asset = shapes.beam(3)
    for changes, message in [
        ({"stiffness": [1.0]}, "stiffness has shape"),
        ({"stiffness": [1.0, -1.0, 1.0]}, "stiffness of bond 1 is -1.0"),
        ({"bending": [1.0, 1.0, np.nan]}, "bending of bond 2 is nan"),
        ({"method": "magic"}, "method is 'magic'"),
    ]:
        with pytest.raises(ValueError, match=message):
            stress.structure(asset, **changes)


@pytest.mark.parametrize("count", [4, pytest.param(1024, marks=pytest.mark.slow)])
def test_one_program_serves_every_state_of_breakage(count):
    asset = shapes.grid((4, 4, 4), anchor=("z-",), dtype=np.float32)
    frame = stress.structure(asset)
    load = stress.gravity(frame.mass, jnp.array([0.0, 3.0, -9.0], jnp.float32))
    traces = []

    @jax.jit
    def many(states):
        traces.append(1)
        return jax.vmap(lambda s: stress.solve(frame, asset, s, load))(states)

    whole = fracture.init(asset)
    rng = np.random.default_rng(0)
    for part in (0.0, 0.3, 0.6):
        keep = jnp.asarray(rng.random((count, len(asset.bond_area))) > part)
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), whole)
        found = many(states.replace(bond_intact=keep))
        one = whole.replace(bond_intact=keep[2])
        alone = jax.jit(stress.solve)(frame, asset, one, load)
        scale = float(jnp.abs(alone.force).max())
        np.testing.assert_allclose(found.force[2], alone.force, atol=2e-5 * scale)
        assert found.converged.all()
        assert np.isfinite(found.force).all()
    assert len(traces) == 1


@pytest.mark.slow
def test_a_warm_start_saves_the_iterations():
    asset = shapes.grid((4, 1, 8), anchor=("z-",), dtype=np.float32)
    frame = stress.structure(asset, method="two-level")
    load = stress.gravity(frame.mass, jnp.array([0.0, 0.0, -9.0], jnp.float32))
    state = fracture.init(asset)
    cold = stress.solve(frame, asset, state, load)
    more = jax.tree.map(lambda x: 1.5 * x, load)
    warm = stress.solve(frame, asset, state, more, warm_start=cold)
    assert int(warm.iterations) < 0.3 * int(cold.iterations)
    np.testing.assert_allclose(warm.force, 1.5 * cold.force, rtol=1e-3, atol=0.5)
