"""What a load does to a structure: who is near failing, what breaks, what falls.

`judge` says how much of its strength every bond and actor uses. `collapse` goes on from
there: what breaks hands its load to the rest, until nothing more breaks. `excess` is
the load that bonds could not carry when they broke, as it acts on the pieces.
"""

import functools

import jax
import jax.numpy as jnp

from blastjax import fracture, graph, pytree, spatial
from blastjax.core import Asset, Damage, FractureEvents, SplitEvents, State
from blastjax.stress import limits as material_limits
from blastjax.stress.equilibrium import Solution, solve
from blastjax.stress.limits import BondStress, Limits
from blastjax.stress.loads import Load, node_place
from blastjax.stress.structures import Structure

ROUNDS = 100
"""Most rounds of a collapse, unless told otherwise."""


@pytree.dataclass
class Verdict(pytree.Node):
    """How a state bears a load."""

    solution: Solution
    """The forces in the bonds, and how far to trust them."""
    stress: BondStress
    """What they make of the bonds' areas, at both faces."""
    utilisation: jax.Array
    """(B,) part of its elastic limit that each bond uses; from 1 on it yields."""
    actor_utilisation: jax.Array
    """(A,) by label, the largest among the actor's bonds."""
    safety: jax.Array
    """(A,) by label, the factor by which its load may grow until the first bond yields;
    infinite where nothing is borne."""


@pytree.dataclass
class Collapse(pytree.Node):
    """How a collapse went."""

    fracture: FractureEvents
    """What broke, summed over the rounds."""
    split: SplitEvents
    """What came apart between the first state and the last."""
    verdict: Verdict
    """On the last round's solve; if settled, on what still stands."""
    rounds: jax.Array
    """() int32 solves; the last of a settled collapse breaks nothing."""
    settled: jax.Array
    """() bool, whether the last round broke nothing."""
    converged: jax.Array
    """() bool, whether every solve met its tolerance."""


def judge(
    structure: Structure,
    asset: Asset,
    state: State,
    load: Load,
    limits: Limits,
    *,
    material: jax.Array | None = None,
    area: jax.Array | None = None,
    tolerance: float | None = None,
    iterations: int = 200,
    warm_start: Solution | None = None,
) -> Verdict:
    """Return how near to failing a load brings bonds and actors.

    Args:
      structure: of this asset.
      asset: the asset.
      state: says which bonds connect, and whose they are.
      load: on the nodes. Pieces that the world does not hold are in free fall under
        gravity, and bear nothing of it.
      limits: of one material, or of M.
      material: (B,) int32, the material of each bond; None if there is one only.
      area: (B,) that bears the load, m^2; by default the asset's bonded areas, whatever
        health is left (Blast takes the health itself).
      tolerance: of `solve`.
      iterations: of `solve`.
      warm_start: of `solve`.

    Returns:
      A Verdict. Differentiable in all but which bonds connect; at an actor, the
      derivative is that of its worst bond.
    """
    solution = solve(
        structure,
        asset,
        state,
        load,
        tolerance=tolerance,
        iterations=iterations,
        warm_start=warm_start,
    )
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    place = node_place(asset)
    distance = spatial.norm(place[second] - place[first])
    if asset.has_world:
        outward = 2 * spatial.norm(asset.bond_centroid - place[first])
        distance = jnp.where(second == 0, outward, distance)
    stress = material_limits.bond_stress(
        solution.force,
        solution.torque,
        asset.bond_normal,
        asset.bond_area if area is None else area,
        distance,
        both_faces=True,
    )
    nothing = jnp.zeros(state.actor.shape, stress.normal.dtype)
    verdict = Verdict(
        solution=solution,
        stress=stress,
        utilisation=material_limits.utilisation(limits, stress, material),
        actor_utilisation=nothing,
        safety=nothing,
    )
    return _by_actor(asset, state, verdict)


def _by_actor(asset: Asset, state: State, verdict: Verdict) -> Verdict:
    """Fill in the fields by label."""
    owner = state.actor[asset.bond_nodes[:, 0]]
    worst = _worst(verdict.utilisation, owner, state.actor.shape[0])
    factor = spatial.ratio(jnp.ones_like(worst), worst)
    return verdict.replace(
        actor_utilisation=worst, safety=jnp.where(worst > 0, factor, jnp.inf)
    )


def _worst(values: jax.Array, group: jax.Array, count: int) -> jax.Array:
    """Return the largest value, 0 or more, of each group, with its derivative."""
    size = values.shape[0]
    if size == 0:
        return jnp.zeros(count, values.dtype)
    # A scatter of maxima has no derivative; the place of the maximum needs none.
    fixed = jax.lax.stop_gradient(values)
    at = jnp.where(group < 0, count, group)
    most = jnp.zeros(count, values.dtype).at[at].max(fixed, mode="drop")
    first = (fixed > 0) & (fixed == most[jnp.maximum(group, 0)])
    index = jnp.where(first, jnp.arange(size, dtype=jnp.int32), size)
    place = jnp.full(count, size, jnp.int32).at[at].min(index, mode="drop")
    return values.at[place].get(mode="fill", fill_value=0)


def stress_damage(
    state: State,
    verdict: Verdict,
    limits: Limits,
    *,
    material: jax.Array | None = None,
) -> Damage:
    """Return the health that the judged stress takes from bonds; see `limits.damage`.

    Unbreakable bonds take none. Differentiable as that is.
    """
    health = state.bond_health
    if state.bond_unbreakable is not None:
        health = jnp.where(state.bond_unbreakable, 0, health)
    bond = material_limits.damage(limits, verdict.stress, health, material)
    return Damage(bond=bond)


@functools.partial(jax.jit, static_argnames=("tolerance", "iterations"))
def collapse(
    structure: Structure,
    asset: Asset,
    state: State,
    load: Load,
    limits: Limits,
    *,
    rounds: int | jax.Array = ROUNDS,
    material: jax.Array | None = None,
    area: jax.Array | None = None,
    tolerance: float | None = None,
    iterations: int = 200,
) -> tuple[State, Collapse]:
    """Solve, damage and break, round after round, until nothing more breaks.

    A round takes from each bond what `limits.damage` says. Between the elastic and the
    fatal limit that is a part of its health each time: such bonds weaken, they do not
    break by themselves, and do not keep the collapse going.

    Args:
      structure: of this asset.
      asset: the asset.
      state: its state.
      load: on the nodes, the same in all rounds: collapse is slow, pieces that came
        loose press on nothing.
      limits: of one material, or of M.
      rounds: most of them, 1 or more.
      material: as for `judge`.
      area: as for `judge`.
      tolerance: of `solve`.
      iterations: of `solve`.

    Returns:
      The state, split, and how it went. Forward-mode derivatives only, for the number
      of rounds is open.
    """

    def one(state: State) -> tuple[State, Verdict, FractureEvents]:
        verdict = judge(
            structure,
            asset,
            state,
            load,
            limits,
            material=material,
            area=area,
            tolerance=tolerance,
            iterations=iterations,
        )
        dealt = stress_damage(state, verdict, limits, material=material)
        state, broken = fracture.apply(asset, state, dealt)
        return state, verdict, broken

    def more(carry: _Round) -> jax.Array:
        return ~carry.settled & (carry.number < rounds)

    def go_on(carry: _Round) -> _Round:
        state, verdict, broken = one(carry.state)
        return _Round(
            state=state,
            verdict=verdict,
            fracture=jax.tree.map(_total, carry.fracture, broken),
            number=carry.number + 1,
            settled=~jnp.any(broken.bond_broken),
            converged=carry.converged & verdict.solution.converged,
        )

    _, verdict, broken = jax.eval_shape(one, state)
    first = _Round(
        state=state,
        verdict=jax.tree.map(_blank, verdict),
        fracture=jax.tree.map(_blank, broken),
        number=jnp.zeros((), jnp.int32),
        settled=jnp.zeros((), bool),
        converged=jnp.ones((), bool),
    )
    last = jax.lax.while_loop(more, go_on, first)
    # The solver finds loose pieces by itself: actors need one split only, at the end.
    state, parted = fracture.split(asset, last.state)
    return state, Collapse(
        fracture=last.fracture,
        split=parted,
        verdict=_by_actor(asset, state, last.verdict),
        rounds=last.number,
        settled=last.settled,
        converged=last.converged,
    )


@pytree.dataclass
class _Round(pytree.Node):
    state: State
    verdict: Verdict
    fracture: FractureEvents
    number: jax.Array
    settled: jax.Array
    converged: jax.Array


def _blank(shape: jax.ShapeDtypeStruct) -> jax.Array:
    return jnp.zeros(shape.shape, shape.dtype)


def _total(sum_: jax.Array, each: jax.Array) -> jax.Array:
    return sum_ | each if sum_.dtype == bool else sum_ + each


def excess(
    asset: Asset,
    state: State,
    verdict: Verdict,
    broken: jax.Array,
    limits: Limits,
    center: jax.Array,
    *,
    material: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Return what is left of a load when the bonds that bore it have broken.

    A broken bond carried its force and torque up to the point where they met the first
    fatal limit; what goes beyond has nothing to balance it, and pushes the two pieces
    apart (or together, or past each other), equally and oppositely. A bond that fatigue
    broke below its limits leaves nothing.

    It is meant for loads that nothing else simulates, such as a blast: gravity and
    contacts act on the pieces by themselves.

    Args:
      asset: the asset.
      state: after the split, says whose the ends of the bonds are now.
      verdict: on the load under which they broke.
      broken: (B,) bool, the bonds that broke.
      limits: as for the verdict.
      center: (A, 3) by label, about which torques are taken, m: the actors' centres of
        mass, `chunks.moments(...).center`.
      material: as for the verdict.

    Returns:
      Force (A, 3) N and torque (A, 3) N m on each actor, by label, rest frame. What the
      world holds has a row too. Differentiable; which bonds broke, and what came apart,
      is constant.
    """
    own = material_limits.effective(limits)
    fatal = own.replace(
        compression_elastic=own.compression_fatal,
        tension_elastic=own.tension_fatal,
        shear_elastic=own.shear_fatal,
    )
    used = material_limits.utilisation(fatal, verdict.stress, material)
    beyond = broken & (used > 1)
    part = jnp.where(beyond, 1 - 1 / jnp.where(beyond, used, 1), 0)[:, None]
    # The bond held its first node with this; without it, the load has its way.
    force = -part * verdict.solution.force
    torque = -part * verdict.solution.torque

    count = state.actor.shape[0]
    pushes = turns = jnp.zeros((count, 3), force.dtype)
    for side, sign in ((0, 1.0), (1, -1.0)):
        label = state.actor[asset.bond_nodes[:, side]]
        arm = asset.bond_centroid - center[jnp.maximum(label, 0)]
        turn = torque + jnp.cross(arm, force)
        pushes = pushes + graph.group_sum(sign * force, label, count)
        turns = turns + graph.group_sum(sign * turn, label, count)
    return pushes, turns
