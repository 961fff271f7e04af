"""Forces in the bonds of a structure at rest, or moving as rigid pieces.

Every node has a displacement and a rotation; a bond resists, at its centroid, the
relative displacement of its two nodes with a stiffness and their relative rotation with
another. Equilibrium asks that the bond forces J balance the load at every node, and J
is, of all that do, the one of least elastic energy:

    C J + load = 0,   J = W C^T u,   W the stiffnesses.

Pieces that the world does not hold are balanced by their rigid acceleration first.
Masses enter through loads only, never into the operator.

Two methods solve it on the `frames.Frame` of a state: `force_method` where a structure
has few independent cycles, and `two_level_method` for all others.
"""

from typing import Any

import jax
import jax.numpy as jnp

from blastjax import graph, pytree, spatial
from blastjax.core import Asset, State
from blastjax.stress import force_method, frames, two_level_method
from blastjax.stress.loads import Load
from blastjax.stress.structures import FORCE, Structure

NOISE = 30
"""Roundings of its load up to which a piece counts as unloaded."""


@pytree.dataclass
class Solution(pytree.Node):
    """Bond forces, and how far to trust them."""

    force: jax.Array
    """(B, 3) that the bond exerts on its first node, N: along the normal, tension."""
    torque: jax.Array
    """(B, 3) that the bond exerts on its first node about its own centroid, N m."""
    residual: jax.Array
    """() norm of what stays unbalanced, over that of the load or of all bond forces."""
    iterations: jax.Array
    """() int32, steps taken."""
    converged: jax.Array
    """() bool, whether the residual is within the tolerance."""
    strain: jax.Array
    """(B, 6) for a warm start: forces over the roots of the stiffnesses, scaled."""
    carries: jax.Array
    """(B,) bool, the bonds that could carry."""


def solve(
    structure: Structure,
    asset: Asset,
    state: State,
    load: Load,
    *,
    tolerance: float | None = None,
    iterations: int = 200,
    warm_start: Solution | None = None,
) -> Solution:
    """Return the forces in the bonds that balance a load.

    All actors are solved at once; bonds that do not connect carry nothing.

    Args:
      structure: of this asset; its leaves may be traced.
      asset: the asset.
      state: says which bonds connect.
      load: on the nodes; what acts on the world and on padding is ignored.
      tolerance: residual to stop at; by default 1e-6 in float32 and 1e-10 in float64.
      iterations: most steps of the two-level method.
      warm_start: where that method starts, say from the last step. It helps as long as
        the same bonds connect, and is not used otherwise.

    Returns:
      A Solution. Where the iteration ends short of the tolerance, it is the best that
      was found, and says so. Differentiable, forward and reverse, by the implicit
      function theorem, in the load, the masses and stiffnesses of the structure and the
      geometry of the asset; which bonds connect is constant.
    """
    dtype = asset.chunk_centroid.dtype
    if tolerance is None:
        tolerance = 1e-10 if dtype == jnp.float64 else 1e-6
    if not asset.bond_area.shape[0]:
        return _nothing(dtype)
    frame = frames.assemble(structure, asset, state)
    load, peak = _unit_load(load, frame)
    right = _balanced(frame, structure, load)
    scale = jax.lax.stop_gradient(frames.size(right))
    scale = jnp.where(scale > 0, scale, 1.0)
    start = jnp.zeros_like(frame.root)
    if warm_start is not None:
        same = jnp.all(warm_start.carries == frame.alive)
        start = jnp.where(same, jax.lax.stop_gradient(warm_start.strain), 0.0)
    fixed, plain = jax.lax.stop_gradient((frame, structure))
    method = force_method.solve if structure.method == FORCE else two_level_method.solve

    def equations(unknowns: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        # In the square roots of the stiffnesses the system is symmetric, and harmless
        # where a bond has none.
        strain, shift = unknowns
        return (
            strain - frame.root * frames.stretch(frame, shift),
            -frames.gather(frame, frame.root * strain),
        )

    def run(_: Any, target: tuple[jax.Array, jax.Array]) -> Any:
        return method(fixed, plain, target, start, tolerance, iterations)

    right = right / scale
    # Nothing, but as differentiable as the rest: where only the load varies, JAX takes
    # no symbolic zero here.
    nothing = jnp.zeros_like(frame.root) + 0 * jnp.sum(right)
    (strain, _), (residual, count) = jax.lax.custom_linear_solve(
        equations,
        (nothing, right),
        solve=run,
        symmetric=True,
        has_aux=True,
    )
    bond = frame.root * strain * scale * jnp.where(jnp.isfinite(peak), peak, 0)
    # A load that is no number, or too large for one, bears no answer.
    fits = jnp.isfinite(peak) & jnp.isfinite(jnp.max(jnp.abs(bond)))
    bond = jnp.where(fits, bond, 0)
    return Solution(
        force=bond[:, :3],
        torque=bond[:, 3:] * frame.length,
        residual=jnp.where(fits, residual, jnp.inf),
        iterations=count,
        converged=fits & (residual <= tolerance),
        strain=strain,
        carries=frame.alive,
    )


def _nothing(dtype: Any) -> Solution:
    """Return the solution of an asset without bonds."""
    return Solution(
        force=jnp.zeros((0, 3), dtype),
        torque=jnp.zeros((0, 3), dtype),
        residual=jnp.zeros((), dtype),
        iterations=jnp.zeros((), jnp.int32),
        converged=jnp.ones((), bool),
        strain=jnp.zeros((0, 6), dtype),
        carries=jnp.zeros(0, bool),
    )


def _unit_load(load: Load, frame: frames.Frame) -> tuple[Load, jax.Array]:
    """Return a load of largest entry 1, whose square is a number, and what it was."""
    both = jnp.stack([load.force, load.torque / frame.length])
    both = jnp.where(frame.bears[None, :, None], both, 0)
    peak = jax.lax.stop_gradient(jnp.max(jnp.abs(both)))
    scale = jnp.where(jnp.isfinite(peak) & (peak > 0), peak, 1)

    def unit(x: jax.Array) -> jax.Array:
        x = jnp.where(frame.bears[:, None] & jnp.isfinite(x), x, 0)
        return x / scale

    return Load(force=unit(load.force), torque=unit(load.torque)), peak


def _balanced(frame: frames.Frame, structure: Structure, load: Load) -> jax.Array:
    """Return the load less what moves floating pieces as a whole, (N, 6)."""
    force, torque = load.force, load.torque / frame.length
    num_nodes = force.shape[0]
    label = jnp.where(frame.floats, frame.label, num_nodes)
    mass = jnp.where(frame.floats, structure.mass, 0)

    def total(x: jax.Array) -> jax.Array:
        return graph.group_sum(x, label, num_nodes)

    def back(x: jax.Array) -> jax.Array:
        return frames.rows(x, label)

    whole = total(mass)
    center = spatial.ratio(total(mass[:, None] * frame.place), whole[:, None])
    arm = frame.place - back(center)
    eye = jnp.eye(3, dtype=arm.dtype)[None]
    steiner = spatial.dot(arm, arm)[:, None, None] * eye
    steiner = steiner - arm[:, :, None] * arm[:, None, :]
    own = jnp.where(frame.floats[:, None, None], structure.inertia / frame.length**2, 0)
    inertia = total(mass[:, None, None] * steiner + own)
    # Twice, since what the first time leaves in float32 no bond forces can balance.
    for _ in range(2):
        pull = total(force)
        twist = total(torque + jnp.cross(arm, force))
        linear = back(spatial.ratio(pull, whole[:, None]))
        angular = back(_solve_3x3(inertia, twist))
        force = force - mass[:, None] * (linear + jnp.cross(angular, arm))
        torque = torque - jnp.einsum("nij,nj->ni", own, angular)
    both = jnp.concatenate([force, torque], axis=1)
    both = jnp.where(frame.bears[:, None], both, 0)

    # A piece that falls freely bears nothing: what is left of its load is rounding.
    def strength(x: jax.Array) -> jax.Array:
        return graph.group_sum(jnp.sum(x * x, axis=1), frame.label, num_nodes)

    whole_load = jnp.concatenate([load.force, load.torque / frame.length], axis=1)
    noise = (NOISE * jnp.finfo(mass.dtype).eps) ** 2 * strength(whole_load)
    bears = strength(both) > noise
    return jnp.where(bears[frame.label][:, None], both, 0)


def _solve_3x3(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve (n, 3, 3) x = (n, 3); 0 where the matrix is singular."""
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=(1, 2)))
    scale = jnp.where(scale > 0, scale, 1)
    inverse = _inverse_3x3(matrix / scale[:, None, None])
    return jnp.einsum("nij,nj->ni", inverse, right / scale[:, None])


def _inverse_3x3(matrix: jax.Array) -> jax.Array:
    """Invert matrices (n, 3, 3) by cofactors; 0 where they are singular."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    determinant = spatial.dot(a, jnp.cross(b, c))
    return spatial.ratio(cofactors, determinant[:, None, None])
