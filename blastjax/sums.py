"""Sums over the elements of each actor: mass, centre of mass, inertia.

Most actors of a broken body are single elements, which are no sum: theirs are rows of
a table that all bodies share. Few are several; in a batch each body sums up its next
one of these as a product of the table with the mask of its elements, which is cheap,
side by side with other bodies that have about as many. What is in more pieces than
that, and a body alone, is scattered.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from blastjax import graph, spatial

ROUNDS = 8
"""Actors of several elements in a body beyond which a scatter is faster."""
TOGETHER = 8192
"""Elements of bodies side by side: they stay in a core's own cache."""
BLOCK = 1024
"""Numbers added in a row: float32 loses digits in longer sums of like numbers."""

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Second moments: a symmetric matrix."""

Sums = tuple[jax.Array, jax.Array, jax.Array]
"""By label: masses (A,), centres (A * 3,), inertias about them (A * 9,)."""


@jax.custom_jvp
def moments(
    actor: jax.Array, weight: jax.Array, place: jax.Array, spin: jax.Array
) -> Sums:
    """Sum up elements by their actor.

    Args:
      actor: (A,) labels, the smallest element of each actor; negative for none.
      weight: (A,) kg.
      place: (A, 3) centres of mass, m.
      spin: (A, 9) inertias about them, kg m^2.

    Differentiable in all but the labels: a derivative is that of the scatter.
    """
    sums = graph.one_of_many(_by_scatter, _by_rounds, 3)
    return sums(weight, place, spin, actor)


@moments.defjvp
def _(primals: tuple[jax.Array, ...], tangents: tuple[Any, ...]) -> tuple[Sums, Sums]:
    actor, values = primals[0], primals[1:]
    return jax.jvp(lambda w, p, s: _by_scatter(w, p, s, actor), values, tangents[1:])


def _near(weight: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return places from the middle of them all, and that middle (1, 3).

    Far from it float32 has no digits left for their differences, and long sums of
    numbers of one sign lose them too.
    """
    # From one of them first; the first of all is the world, perhaps, which is nowhere.
    second = min(1, place.shape[0] - 1)
    one = jnp.where(weight[:1, None] != 0, place[:1], place[second : second + 1])
    about = jnp.where(weight[:, None] != 0, place - one, 0)
    middle = one + spatial.ratio(weight @ about, jnp.sum(weight))[None]
    middle = lax.stop_gradient(middle)
    # Or XLA computes the difference anew wherever it is read.
    return lax.optimization_barrier(place - middle), middle


def _by_scatter(
    weight: jax.Array, place: jax.Array, spin: jax.Array, actor: jax.Array
) -> Sums:
    num = actor.shape[0]
    place, origin = _near(weight, place)
    rows = jnp.concatenate([weight[:, None], weight[:, None] * place], axis=1)
    sums = graph.group_sum(rows, actor, num)
    mass = sums[:, :1]
    center = spatial.ratio(sums[:, 1:], mass)
    # About the actor's own centre, in a second pass: the difference of two large sums
    # would cost float32 its digits.
    arm = place - center[jnp.maximum(actor, 0)]
    square = spatial.dot(arm, arm)[:, None, None] * jnp.eye(3, dtype=arm.dtype)[None]
    steiner = square - arm[:, :, None] * arm[:, None, :]
    inertia = graph.group_sum(
        spin + weight[:, None] * steiner.reshape(num, 9), actor, num
    )
    center = center + jnp.where(mass != 0, origin, 0)
    return mass[:, 0], center.reshape(-1), inertia.reshape(-1)


def _by_rounds(
    weight: jax.Array, place: jax.Array, spin: jax.Array, actor: jax.Array
) -> Sums:
    """Sum up many bodies, actors (T, A): results (T, ...)."""
    size, num = actor.shape
    width = max(TOGETHER // num, 4)
    tiles = -(-size // width)
    if tiles < 2:
        # So few that starting all these kernels would cost more than they win.
        return jax.vmap(lambda x: _by_scatter(weight, place, spin, x))(actor)
    element = jnp.arange(num, dtype=actor.dtype)[None]
    # An element in the actor of another names an actor of several. At least as many
    # are named as bits are set, and bodies go with others of about as many.
    named = jnp.where((actor >= 0) & (actor != element), actor, num)
    bits = jnp.where(named < num, jnp.left_shift(1, named & 31), 0)
    count = lax.population_count(lax.reduce_or(bits, (1,)))
    turn = jnp.argsort(count).astype(actor.dtype)
    turn = jnp.pad(turn, (0, tiles * width - size), constant_values=size)
    named = named.at[turn].get(mode="fill", fill_value=num)
    many = count.at[turn].get(mode="fill", fill_value=0) > ROUNDS
    # Not a vmap: every tile stops when it is done.
    found = lax.map(
        lambda x: _rounds(weight, place, spin, *x),
        (named.reshape(tiles, width, num), many.reshape(tiles, width)),
    )
    label, mass, center, inertia, late = (x.reshape(-1, *x.shape[2:]) for x in found)
    # A product vectorises where a choice would not. Behind barriers, or each body would
    # choose the rows of the table anew.
    single = (actor == element).astype(weight.dtype)
    own = lax.optimization_barrier(jnp.where(weight[:, None] != 0, place, 0))
    spin = lax.optimization_barrier(spin)
    at = turn[:, None], label
    out = (
        (single * weight[None]).at[at].set(mass, mode="drop"),
        (single[:, :, None] * own[None]).at[at].set(center, mode="drop"),
        (single[:, :, None] * spin[None]).at[at].set(inertia, mode="drop"),
    )
    out = jax.tree.map(lambda x: x.reshape(size, -1), out)
    turn = jnp.where(late, turn, size)[jnp.argsort(~late)]

    def repeat(x: jax.Array) -> jax.Array:
        return jnp.broadcast_to(x[None], (width, *x.shape)).reshape(-1, *x.shape[1:])

    def scatter(i: jax.Array, out: Sums) -> Sums:
        which = lax.dynamic_slice(turn, (i * width,), (width,))
        group = actor.at[which].get(mode="clip")
        offset = num * jnp.arange(width, dtype=actor.dtype)[:, None]
        group = jnp.where(group < 0, -1, group + offset).reshape(-1)
        # One scatter of all, several times faster than a batch of them.
        found = _by_scatter(repeat(weight), repeat(place), repeat(spin), group)
        return jax.tree.map(
            lambda x, y: x.at[which].set(y.reshape(width, -1), mode="drop"), out, found
        )

    groups = -(-jnp.sum(late, dtype=jnp.int32) // width)
    return lax.fori_loop(jnp.int32(0), groups, scatter, out)


def _rounds(
    weight: jax.Array,
    place: jax.Array,
    spin: jax.Array,
    named: jax.Array,
    many: jax.Array,
) -> tuple[jax.Array, ...]:
    """Sum up the actors of several elements of n bodies, one of each at a time.

    Args:
      weight: (A,).
      place: (A, 3).
      spin: (A, 9).
      named: (n, A) the other element that names an element's actor, A if none does.
      many: (n,) bool, bodies to leave out.

    Returns:
      Labels (n, ROUNDS), A where there is none; their masses, centres (n, ROUNDS, 3)
      and inertias (n, ROUNDS, 9); and (n,) bool, bodies that have more of them.
    """
    size, num = named.shape
    block = min(num, BLOCK)
    spare = -num % block
    place, origin = _near(weight, place)
    table = jnp.concatenate([weight[:, None], weight[:, None] * place, spin], axis=1)
    weight, place, table, named = (
        jnp.pad(x, pad)
        for x, pad in (
            (weight, (0, spare)),
            (place, ((0, spare), (0, 0))),
            (table, ((0, spare), (0, 0))),
            (named, ((0, 0), (0, spare))),
        )
    )
    element = jnp.arange(num + spare, dtype=named.dtype)[None]
    named = jnp.where(element < num, named, num)
    ones = jnp.ones(block, weight.dtype)
    # Axis by axis in memory, to be read in vectors.
    axes = lax.optimization_barrier(place.T)

    def following(label: jax.Array) -> jax.Array:
        return jnp.min(jnp.where(named > label[:, None], named, num), axis=1)

    def more(carry: tuple[Any, ...]) -> jax.Array:
        i, label, _ = carry
        return (i < ROUNDS) & jnp.any(label < num)

    def take(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        i, label, out = carry
        own = label[:, None]
        mask = ((named == own) | (element == own)).astype(weight.dtype)
        # Behind barriers, or XLA computes anew what a product reads.
        mask = lax.optimization_barrier(mask)
        sums = jnp.dot(mask, table, precision="highest")
        mass = sums[:, :1]
        center = lax.optimization_barrier(spatial.ratio(sums[:, 1:4], mass))
        # About the actor's own centre, as in a scatter.
        arm = [axes[None, k] - center[:, k, None] for k in range(3)]
        heavy = [mask * weight[None] * x for x in arm]
        second = jnp.stack([heavy[j] * arm[k] for j, k in PAIRS])
        second = lax.optimization_barrier(second).reshape(6, size, -1, block)
        second = jnp.sum(jnp.dot(second, ones, precision="highest"), axis=2)
        xx, xy, xz, yy, yz, zz = second
        about = [yy + zz, -xy, -xz, -xy, xx + zz, -yz, -xz, -yz, xx + yy]
        inertia = sums[:, 4:] + jnp.stack(about, axis=1)
        center = center + jnp.where(mass != 0, origin, 0)
        found = label, mass[:, 0], center, inertia
        out = [x.at[:, i].set(y) for x, y in zip(out, found, strict=True)]
        return i + 1, following(label), out

    empty = [
        jnp.full((size, ROUNDS), num, named.dtype),
        *(jnp.zeros((size, ROUNDS, *n), weight.dtype) for n in ((), (3,), (9,))),
    ]
    first = following(jnp.full(size, -1, named.dtype))
    start = jnp.int32(0), jnp.where(many, num, first), empty
    _, label, out = lax.while_loop(more, take, start)
    return *out, many | (label < num)
