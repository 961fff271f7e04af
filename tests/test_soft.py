"""Margins, expected outcomes, moments of fracture and the soft relaxation."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import author, chunks, fracture, graph, soft
from blastjax.author import shapes
from blastjax.core import UNBREAKABLE, Damage
from blastjax.soft import chance
from tests.benchmarks.timing import least

pytestmark = pytest.mark.usefixtures("strict")

NODES, EDGES = 12, 18
# Run piece by piece, each of these would compile its loops anew at every call.
margin_of = jax.jit(soft.margin)
margin_to_one = jax.jit(soft.margin, static_argnames="to")
step = jax.jit(fracture.step)


def random_graphs(seed, count, ties=False):
    """Return edges, weights and sources of random graphs, some of them odd."""
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, NODES, (count, EDGES, 2)).astype(np.int32)
    weight = rng.normal(0.2, 1.0, (count, EDGES)).astype(np.float32)
    if ties:
        weight = np.round(weight)
    gone = rng.random((count, EDGES)) < 0.1
    weight = np.where(gone, -np.inf, weight)
    sure = rng.random((count, EDGES)) < 0.05
    weight = np.where(sure, np.inf, weight).astype(np.float32)
    source = rng.random((count, NODES)) < rng.uniform(0, 0.3, (count, 1))
    return edges, weight, source


def reached(edges, alive, source):
    """Return which nodes reach a source, by plain relaxation on batches, numpy."""
    lanes = np.arange(len(edges))[:, None]
    now = source.copy()
    for _ in range(NODES):
        for a, b in ((0, 1), (1, 0)):
            np.logical_or.at(
                now, (lanes, edges[:, :, b]), now[lanes, edges[:, :, a]] & alive
            )
    return now


def check_signs(seed, count):
    margins = jax.jit(jax.vmap(lambda e, w, s: graph.bottleneck(e, w, s, NODES)))
    for ties in (False, True):
        edges, weight, source = random_graphs(seed, count, ties)
        value, edge = map(np.asarray, margins(edges, weight, source))
        for level in (0.0, -0.7, 1.0):
            truth = reached(edges, weight > level, source)
            np.testing.assert_array_equal(value > level, truth)
        finite = np.isfinite(value)
        taken = np.take_along_axis(weight, np.maximum(edge, 0), axis=1)
        np.testing.assert_array_equal(taken[finite], value[finite])
        assert (edge[~finite] == -1).all()


def test_margin_sign_is_connectivity():
    check_signs(0, 2000)


@pytest.mark.slow
def test_margin_sign_is_connectivity_on_100_000_graphs():
    for seed in range(10):
        check_signs(seed, 5000)

    # What that costs, in searches for islands of the same graphs.
    edges, weight, source = random_graphs(0, 5000)
    margins = jax.jit(jax.vmap(lambda e, w, s: graph.bottleneck(e, w, s, NODES)))
    islands = jax.jit(jax.vmap(lambda e, a: graph.islands(e, a, NODES)))
    times = least(
        {
            "margins": lambda: jax.block_until_ready(margins(edges, weight, source)),
            "islands": lambda: jax.block_until_ready(islands(edges, weight > 0)),
        },
        20,
    )
    ratio = times["margins"] / times["islands"]
    print(f"a margin costs {ratio:.1f} searches for islands")
    assert ratio < 10


def test_margin_slope_is_its_difference_quotient():
    """One node's margin falls with one bond only, everywhere but at ties."""
    with jax.enable_x64(True):
        edges, weight, source = random_graphs(3, 100)
        weight = weight.astype(np.float64)

        def value(e, w, s):
            found = graph.bottleneck(e, w, s, NODES)[0]
            return jnp.where(jnp.isfinite(found), found, 0)

        slope = jax.jit(jax.vmap(jax.jacrev(value, 1)))(edges, weight, source)
        forward = jax.jit(jax.vmap(jax.jacfwd(value, 1)))(edges, weight, source)
        np.testing.assert_array_equal(slope, forward)
        run = jax.jit(jax.vmap(value))
        h = 1e-7
        for bond in range(EDGES):
            off = np.where(np.arange(EDGES) == bond, h, 0.0)
            up, down = (run(edges, weight + s * off, source) for s in (1, -1))
            finite = np.asarray(up - down) / (2 * h)
            np.testing.assert_allclose(slope[:, :, bond], finite, atol=1e-7)


@pytest.fixture(scope="module")
def wall():
    """A wall of 5 x 4, held below, and a blow that breaks some of it."""
    asset = shapes.grid((5, 1, 4), anchor=("z-",), dtype=np.float32)
    state = fracture.init(asset, jnp.ones(asset.bond_area.shape, jnp.float32))
    bond = 1.6 * jnp.abs(jnp.sin(5 * asset.bond_centroid.sum(1)))
    return asset, state, Damage(bond=bond)


def test_margin_agrees_with_split(wall):
    asset, state, blow = wall
    margin = margin_of(asset, state, blow)
    after, _ = step(asset, state, blow)
    nodes = asset.span_node.shape[0]
    held = np.asarray(after.actor[:nodes]) == 0
    assert 0 < (~held).sum() < nodes
    np.testing.assert_array_equal(np.asarray(margin) > 0, held)
    # Once it is done, the state alone says the same.
    now = margin_of(asset, after)
    np.testing.assert_array_equal(np.asarray(now) > 0, held)
    # To one node, and to a set of nodes.
    to_last = margin_to_one(asset, state, blow, to=nodes - 1)
    same = np.asarray(after.actor[:nodes]) == int(after.actor[nodes - 1])
    np.testing.assert_array_equal(np.asarray(to_last) > 0, same)
    few = jnp.arange(nodes) % 7 == 3
    to_few = np.asarray(margin_of(asset, state, blow, to=few)) > 0
    np.testing.assert_array_equal(
        to_few, np.isin(after.actor[:nodes], after.actor[:nodes][few])
    )


def test_margin_knows_broken_unbreakable_and_cut(wall):
    asset, state, blow = wall
    nodes = asset.span_node.shape[0]
    health = state.bond_health.at[0].set(UNBREAKABLE).at[1].set(0.0)
    odd = fracture.init(asset, health)
    left = soft.bond_margin(asset, odd, blow)
    # A bond that starts without health connects, and bond damage cannot change that.
    assert left[0] == left[1] == jnp.inf
    chunk = jnp.zeros(odd.actor.shape).at[nodes - 1].set(0.5)
    cut = Damage(bond=blow.bond, chunk=chunk)
    left = np.asarray(soft.bond_margin(asset, odd, cut))
    touched = (np.asarray(asset.bond_nodes) == nodes - 1).any(axis=1)
    assert (left[touched] == -np.inf).all() and (left[~touched] > -np.inf).all()
    after, _ = step(asset, odd, cut)
    np.testing.assert_array_equal(
        np.asarray(margin_of(asset, odd, cut)) > 0,
        np.asarray(after.actor[:nodes]) == 0,
    )


def test_losses_count_who_is_on_the_wrong_side(wall):
    asset, state, blow = wall
    margin = margin_of(asset, state, blow)
    loose = margin <= 0
    right = soft.release_loss(asset, margin, loose, temperature=1e-4)
    assert float(right) < 1e-3
    one = jnp.arange(margin.shape[0]) == int(jnp.argmax(loose))
    wrong = soft.release_loss(asset, margin, loose ^ one, temperature=1e-4)
    np.testing.assert_allclose(wrong, -margin[jnp.argmax(one)], rtol=1e-3)
    held = soft.hold_loss(asset, margin, ~loose, temperature=1e-4)
    assert float(held) < 1e-3
    assert float(soft.hold_loss(asset, margin, one)) > 0.05
    # What bond damage cannot bring about costs infinitely much, with no slope.
    rock = fracture.init(asset, jnp.full(asset.bond_area.shape, UNBREAKABLE))
    cost, slope = jax.value_and_grad(
        lambda b: soft.release_loss(asset, margin_of(asset, rock, Damage(bond=b)), one)
    )(blow.bond)
    assert cost == jnp.inf and not slope.any()


def test_perturbed_margin_is_the_mean_and_spreads_its_slope(wall):
    asset, state, blow = wall
    key = jax.random.key(0)

    def total(health, scale):
        noisy = soft.perturbed_margin(
            asset,
            state.replace(bond_health=health),
            blow,
            key=key,
            samples=64,
            scale=scale,
        )
        return jnp.sum(jnp.where(jnp.isfinite(noisy), noisy, 0))

    both = jax.jit(jax.value_and_grad(total))
    mean, sharp = both(state.bond_health, 1e-6)
    _, soft_ = both(state.bond_health, 0.3)
    assert (np.asarray(soft_) > 0).sum() > (np.asarray(sharp) > 0).sum()
    # One unit of health for all bonds moves every node's margin by one unit.
    nodes = asset.span_node.shape[0] - 1
    np.testing.assert_allclose(soft_.sum(), nodes, rtol=1e-5)
    hard = margin_of(asset, state, blow)[1:].sum()
    np.testing.assert_allclose(mean, hard, atol=1e-3)


def test_margin_refuses(wall):
    asset, state, _ = wall
    with pytest.raises(ValueError, match="no bond leads to the world"):
        soft.margin(shapes.grid((2, 1, 1)), state)
    with pytest.raises(ValueError, match="`to` has shape"):
        soft.margin(asset, state, to=jnp.ones(3, bool))
    with pytest.raises(ValueError, match="samples is 0"):
        soft.perturbed_margin(asset, state, key=jax.random.key(0), samples=0)


# Expected outcomes, against all outcomes of a body of few bonds.

MODELS = {"logistic": soft.logistic(0.3), "weibull": soft.weibull(3.0)}


@pytest.fixture(scope="module")
def small():
    """Four boxes held below, 6 bonds."""
    return shapes.grid((2, 1, 2), anchor=("z-",), dtype=np.float32)


def story(asset):
    """Return parameters and what they do: healths and damage, and a loss of both."""
    bonds = asset.bond_area.shape[0]
    health = jnp.linspace(0.8, 1.5, bonds).astype(jnp.float32)
    parameters = {"health": health, "amount": jnp.float32(1.0)}
    share = 0.6 + 0.5 * jnp.abs(jnp.sin(jnp.arange(bonds, dtype=jnp.float32)))

    def act(parameters):
        state = fracture.init(asset, parameters["health"])
        return state, Damage(bond=parameters["amount"] * share)

    def loss(state, parameters):
        nodes = asset.span_node.shape[0]
        number = jnp.arange(1.0, 1.0 + nodes, dtype=jnp.float32)
        loose = jnp.where(state.actor[:nodes] != 0, number, 0)
        # With a part that outcomes do not decide: the pathwise term.
        kept = 0.3 * jnp.sum(state.bond_health**2)
        return jnp.sum(loose) + kept + 0.5 * parameters["amount"] ** 2

    return parameters, act, loss


def exact(asset, act, loss, parameters, strength):
    """Return the mean over all outcomes, with their chances."""
    state, blow = act(parameters)
    p = jax.nn.sigmoid(strength(state.bond_health, blow.bond))
    left = jnp.maximum(state.bond_health - blow.bond, 0)
    outcomes = np.array(list(itertools.product((False, True), repeat=len(p))))

    def one(alive):
        after = state.replace(bond_intact=alive, bond_health=jnp.where(alive, left, 0))
        after, _ = fracture.split(asset, after)
        return jnp.prod(jnp.where(alive, p, 1 - p)) * loss(after, parameters)

    return jnp.sum(jax.vmap(one)(outcomes))


def far(estimate, truth):
    """Return the worst distance of an expectation, in its own standard errors."""
    value, slope = truth
    pairs = [(estimate.value, value, estimate.value_error)]
    pairs += zip(
        *map(jax.tree.leaves, (estimate.gradient, slope, estimate.gradient_error)),
        strict=True,
    )
    return max(float(jnp.max(jnp.abs(a - b) / (e + 1e-6))) for a, b, e in pairs)


@pytest.mark.parametrize(
    "name", ["logistic", pytest.param("weibull", marks=pytest.mark.slow)]
)
def test_expectation_is_that_of_all_outcomes(small, name):
    parameters, act, loss = story(small)
    strength = MODELS[name]
    truth = jax.jit(jax.value_and_grad(lambda p: exact(small, act, loss, p, strength)))(
        parameters
    )
    for estimate, samples in ((soft.expect, 4096), (soft.expect_by_flips, 512)):
        run = jax.jit(
            lambda p, key, f=estimate, k=samples: f(
                small, act, loss, p, key, k, strength=strength
            )
        )
        found = run(parameters, jax.random.key(1))
        assert far(found, truth) < 4.5
        # The errors are of the size that they claim to be.
        size = jnp.linalg.norm(truth[1]["health"])
        assert float(jnp.linalg.norm(found.gradient_error["health"]) / size) < 0.2


@pytest.mark.parametrize("samples", (5, 12))
def test_fit_of_each_sample_leaves_it_out(samples):
    rng = np.random.default_rng(samples)
    p = rng.uniform(0.1, 0.9, 8)
    alive = rng.random((samples, 8)) < p
    value, variance = rng.normal(3.0, 1.0, samples), p * (1 - p)
    # More samples than bonds, and fewer: the two ways to solve it.
    left, slope = chance._leave_one_out(
        jnp.asarray(alive - p), jnp.asarray(value), jnp.asarray(variance)
    )
    ridge = np.zeros((9, 9))
    np.fill_diagonal(ridge[1:, 1:], variance.sum() / 2 + 1)
    rows = np.concatenate([np.ones((samples, 1)), alive - p], axis=1)
    for i in range(samples):
        others = np.delete(rows, i, axis=0)
        fit = np.linalg.solve(others.T @ others + ridge, others.T @ np.delete(value, i))
        np.testing.assert_allclose(left[i], value[i] - rows[i] @ fit, rtol=2e-5)
        np.testing.assert_allclose(slope[i], fit[1:], rtol=2e-4, atol=2e-6)


def test_expectation_leaves_certain_bonds_alone(small):
    parameters, act, loss = story(small)

    def odd(parameters):
        state, blow = act(parameters)
        health = state.bond_health.at[0].set(UNBREAKABLE).at[1].set(0.0)
        chunk = jnp.zeros(state.actor.shape).at[2].set(0.5)
        return fracture.init(small, health), Damage(bond=blow.bond, chunk=chunk)

    for estimate in (soft.expect, soft.expect_by_flips):
        found = jax.jit(
            lambda p, f=estimate: f(small, odd, loss, p, jax.random.key(0), 8)
        )(parameters)
        for leaf in jax.tree.leaves(found.gradient):
            assert np.isfinite(leaf).all()
        assert not found.gradient["health"][:2].any()


def test_expectation_refuses(small):
    parameters, act, loss = story(small)
    for estimate in (soft.expect, soft.expect_by_flips):
        with pytest.raises(ValueError, match="samples is 1"):
            estimate(small, act, loss, parameters, jax.random.key(0), 1)


# Moments of fracture.


def test_moment_of_fracture_and_what_follows():
    """A load that grows as t^2 wears a bond down; then the mass falls."""
    with jax.enable_x64(True):

        def motion(time, y, intact):
            fall = jnp.where(intact[0], 0.0, -9.81)
            speed = {"z": y["v"], "v": fall + 0.0 * time}
            return speed, jnp.array([y["load"] * time**2, 0.0])

        def run(load, health, steps=7, crossings=1):
            def with_load(time, y, intact):
                speed, rate = motion(time, {**y, "load": load}, intact)
                return speed, rate

            y = {"z": jnp.zeros(()), "v": jnp.zeros(())}
            return soft.evolve(
                with_load,
                y,
                jnp.stack([health, health]),
                duration=1.0,
                steps=steps,
                crossings=crossings,
            )

        load, health = jnp.float64(3.0), jnp.float64(0.2)
        moment = (3 * health / load) ** (1 / 3)
        end = jax.jit(run)(load, health)
        np.testing.assert_allclose(end.break_time[0], moment, rtol=1e-13)
        assert end.break_time[1] == jnp.inf and int(end.late) == 0
        np.testing.assert_allclose(
            end.y["z"], -9.81 * (1 - moment) ** 2 / 2, rtol=1e-12
        )
        d_moment = -moment / (3 * load), moment / (3 * health)
        after = [9.81 * (1 - moment) * d for d in d_moment]

        def reals(load, health):
            end = run(load, health)
            return end.break_time[0], end.y["z"], end.health[1]

        truth = np.array([d_moment, after, (0.0, 1.0)])
        for jacobian in (jax.jacfwd, jax.jacrev):
            slope = jax.jit(jacobian(reals, (0, 1)))(load, health)
            np.testing.assert_allclose(slope, truth, rtol=1e-11, atol=1e-12)


def test_moments_in_one_step_in_order_and_late_ones_are_counted():
    def motion(time, y, intact):
        # The second bond takes over what the first one carried.
        return {}, jnp.where(intact[0], jnp.array([1.0, 0.0]), jnp.array([0.0, 2.0]))

    def run(health, crossings):
        return soft.evolve(
            motion, {}, health, duration=jnp.float32(1), steps=1, crossings=crossings
        )

    health = jnp.array([0.3, 0.8], jnp.float32)
    run = jax.jit(run, static_argnums=1)
    end = run(health, 2)
    np.testing.assert_allclose(end.break_time, [0.3, 0.7], rtol=1e-5)
    slope = jax.jit(jax.jacrev(lambda h: run(h, 2).break_time))(health)
    np.testing.assert_allclose(slope, [[1, 0], [1, 0.5]], rtol=1e-5)
    few = run(health, 1)
    assert int(few.late) == 1 and int(end.late) == 0
    np.testing.assert_allclose(few.break_time, [0.3, 1.0], rtol=1e-5)


def test_moments_refuse():
    health = jnp.ones(1)
    for options in ({"steps": 0}, {"steps": 1, "crossings": 0}):
        with pytest.raises(ValueError, match="give 1 or more"):
            soft.evolve(
                lambda t, y, i: ({}, i * 1.0), {}, health, duration=1.0, **options
            )


# The soft relaxation.


def momenta(asset, velocity, spin, density):
    """Return mass-weighted linear and angular momentum about the origin."""
    mass = density * np.asarray(asset.chunk_volume)
    inertia = density * np.asarray(asset.chunk_inertia)
    place = np.asarray(asset.chunk_centroid)
    p = mass[:, None] * velocity
    turn = np.einsum("nij,nj->ni", inertia, spin) + np.cross(place, p)
    return p.sum(0), turn.sum(0)


def test_sharing_conserves_momentum_and_ends_in_rigid_bodies():
    with jax.enable_x64(True):
        asset = shapes.grid((3, 2, 2), (0.5, 0.4, 0.3), dtype=np.float64)
        rng = np.random.default_rng(0)
        velocity, spin = rng.normal(size=(2, 12, 3))
        density = 700.0
        before = momenta(asset, velocity, spin, density)
        bonds = asset.bond_area.shape[0]

        shared = jax.jit(
            lambda weight, stiffness: soft.share_velocity(
                asset, weight, velocity, spin, density=density, stiffness=stiffness
            )
        )

        def share(weight, stiffness):
            return tuple(map(np.asarray, shared(weight, stiffness)))

        for weight in (np.zeros(bonds), np.ones(bonds), rng.random(bonds)):
            for a, b in zip(
                momenta(asset, *share(jnp.asarray(weight), 30.0), density),
                before,
                strict=True,
            ):
                np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)
        v, _ = share(jnp.zeros(bonds), 30.0)
        np.testing.assert_allclose(v, velocity, rtol=1e-12)
        # Two rigid halves: weights of zero across, large stiffness.
        across = np.abs(np.asarray(asset.bond_normal)[:, 0]) > 0.5
        cut = across & (np.asarray(asset.bond_centroid)[:, 0] > 0)
        v, w = share(jnp.asarray(np.where(cut, 0.0, 1.0)), 1e9)
        place = np.asarray(asset.chunk_centroid)
        right = place[:, 0] > 0.3
        for part in (right, ~right):
            np.testing.assert_allclose(
                w[part], w[part][:1].repeat(part.sum(), 0), atol=1e-6
            )
            rigid = v[part][0] + np.cross(w[part][0], place[part] - place[part][0])
            np.testing.assert_allclose(v[part], rigid, atol=1e-6)
        assert np.abs(w[right][0] - w[~right][0]).max() > 0.1


def test_relaxed_wall_has_slopes_and_the_world_stays(wall):
    asset, state, blow = wall
    nodes = asset.span_node.shape[0]
    velocity = jnp.zeros((nodes, 3), jnp.float32).at[nodes - 1, 0].set(1.0)

    def moved(amount):
        weight = soft.loosen(asset, state, Damage(bond=amount * blow.bond))
        v, _ = soft.share_velocity(
            asset, weight, velocity, jnp.zeros_like(velocity), stiffness=10.0
        )
        return v

    v, slope = jax.jit(lambda x: jax.jvp(moved, (x,), (jnp.ones_like(x),)))(
        jnp.float32(1.0)
    )
    assert not v[0].any() and np.isfinite(slope).all() and np.abs(slope).max() > 1e-4
    padded = author.pad(
        asset,
        author.Capacity(
            chunks=22,
            nodes=23,
            sub_chunks=0,
            bonds=40,
            has_world=True,
            depth=0,
            height=0,
        ),
    )
    assert chunks.is_chunk(padded).shape[0] == 23
    whole = soft.loosen(padded, fracture.init(padded))
    bonds = asset.bond_area.shape[0]
    assert not whole[bonds:].any() and (whole[:bonds] > 0.99).all()
