"""A soft relaxation of fracture: a model of its own, not the hard one's derivative.

Bonds hold by a weight between 0 and 1, and chunks share their momentum through bonds in
proportion to it. With weights of 0 and 1 and a large stiffness the pieces move as rigid
bodies; in between they are something that no body is. Its derivative is exact for this
model. As an estimate of how the mean outcome of the hard model changes it was measured
to be poor (see `python -m tests.benchmarks.gradient_quality`): use it where a smooth
model is wanted, and `margin` or `expect` where the truth is.
"""

import jax
import jax.numpy as jnp

from blastjax import chunks
from blastjax.core import Asset, Damage, State
from blastjax.soft.margins import bond_margin


def loosen(
    asset: Asset,
    state: State,
    damage: Damage | None = None,
    *,
    temperature: float | jax.Array = 0.1,
) -> jax.Array:
    """Return how much each bond still holds after damage, (B,) from 0 to 1.

    Args:
      asset: the asset.
      state: its state before the damage.
      damage: what is about to hit; None for the state as it is.
      temperature: health over which a bond goes from holding to broken.

    Returns:
      sigmoid(margin / temperature), 0 for broken and 1 for unbreakable bonds. The
      derivative is exact for the soft model, and biased for the hard one.
    """
    margin = bond_margin(asset, state, damage)
    finite = jnp.isfinite(margin)
    scaled = jnp.where(finite, margin, 0) / jnp.asarray(temperature, margin.dtype)
    fixed = jnp.where(margin > 0, 1.0, 0.0).astype(margin.dtype)
    return jnp.where(finite, jax.nn.sigmoid(scaled), fixed)


def share_velocity(
    asset: Asset,
    weight: jax.Array,
    velocity: jax.Array,
    spin: jax.Array,
    *,
    density: float | jax.Array = 1.0,
    stiffness: float | jax.Array = 1e4,
) -> tuple[jax.Array, jax.Array]:
    """Let chunks share their momentum through bonds that hold by a weight.

    Solves (M + beta C' W C) u = M u0 for velocities and spins u of all chunks, where C
    maps them to the differences across each bond's centroid. Linear and angular
    momentum are conserved whatever the weights, but for what flows to the world.

    Args:
      asset: the asset.
      weight: (B,) from 0, broken, to 1, whole: see `loosen`.
      velocity: (N, 3) of each node's centre of mass, m/s.
      spin: (N, 3) angular velocity, rad/s.
      density: kg/m^3, one for all or (C,).
      stiffness: beta, in units of the mean node's mass and inertia.

    Returns:
      (N, 3) velocities and (N, 3) spins, rest axes. Rows of the world and of padding
      are zero. Differentiable in weights, velocities, density and geometry. Dense: the
      cost grows with the cube of the nodes, fine for some hundred.
    """
    num_nodes, dtype = velocity.shape[0], velocity.dtype
    real = chunks.is_chunk(asset)[:num_nodes]
    density = jnp.broadcast_to(jnp.asarray(density, dtype), asset.chunk_volume.shape)
    whole = chunks.element_values(asset, density * asset.chunk_volume)[:num_nodes]
    body = chunks.element_values(asset, density[:, None, None] * asset.chunk_inertia)
    place = chunks.element_values(asset, asset.chunk_centroid)[:num_nodes]
    mass = jnp.where(real & (whole > 0), whole, 1)
    eye = jnp.eye(3, dtype=dtype)
    heavy = real & (jnp.trace(body[:num_nodes], axis1=1, axis2=2) > 0)
    inertia = jnp.where(heavy[:, None, None], body[:num_nodes], eye[None])

    matrix = _inertia_matrix(mass, inertia)
    count = jnp.maximum(jnp.sum(real, dtype=jnp.int32), 1).astype(dtype)
    push = jnp.sum(jnp.where(real, mass, 0)) / count
    turn = jnp.sum(jnp.where(real, inertia[:, 0, 0], 0)) / count
    scale = jnp.asarray(stiffness, dtype) * jnp.stack([push] * 3 + [turn] * 3)
    gap = _gap_matrix(asset, place, real)
    rows = gap.reshape(-1, 6, 6 * num_nodes)
    pull = (weight.astype(dtype)[:, None] * scale[None])[:, :, None] * rows
    total = matrix + gap.T @ pull.reshape(gap.shape)

    still = real[:, None]
    motion = jnp.concatenate(
        [jnp.where(still, velocity, 0), jnp.where(still, spin, 0)], axis=1
    ).reshape(-1)
    # Scaled to a unit diagonal: masses and inertias differ by orders of magnitude.
    unit = 1 / jnp.sqrt(jnp.diagonal(total))
    factor = jax.scipy.linalg.cho_factor(unit[:, None] * total * unit[None])
    shared = unit * jax.scipy.linalg.cho_solve(factor, unit * (matrix @ motion))
    shared = shared.reshape(num_nodes, 6)
    return shared[:, :3], shared[:, 3:]


def _inertia_matrix(mass: jax.Array, inertia: jax.Array) -> jax.Array:
    """Return M, (6N, 6N), from masses (N,) and inertias (N, 3, 3)."""
    num_nodes = mass.shape[0]
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)
    block = jnp.zeros((num_nodes, 6, 6), mass.dtype)
    eye = jnp.eye(3, dtype=mass.dtype)
    block = block.at[:, :3, :3].set(mass[:, None, None] * eye[None])
    block = block.at[:, 3:, 3:].set(inertia)
    matrix = jnp.zeros((num_nodes, 6, num_nodes, 6), mass.dtype)
    matrix = matrix.at[nodes, :, nodes, :].set(block)
    return matrix.reshape(6 * num_nodes, 6 * num_nodes)


def _gap_matrix(asset: Asset, place: jax.Array, real: jax.Array) -> jax.Array:
    """Return C, (6B, 6N): motion of a bond's first node less the second's."""
    num_nodes, num_bonds = place.shape[0], asset.bond_nodes.shape[0]
    bonds = jnp.arange(num_bonds, dtype=jnp.int32)
    gap = jnp.zeros((num_bonds, 6, num_nodes, 6), place.dtype)
    for side, sign in ((0, 1.0), (1, -1.0)):
        node = asset.bond_nodes[:, side]
        arm = asset.bond_centroid - place[node]
        zero = jnp.zeros_like(arm[:, 0])
        x, y, z = arm[:, 0], arm[:, 1], arm[:, 2]
        # Columns of spin x arm.
        turn = jnp.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1)
        block = jnp.zeros((num_bonds, 6, 6), place.dtype)
        block = block.at[:, :3, 3:].set(turn.reshape(-1, 3, 3))
        block = block + jnp.eye(6, dtype=place.dtype)[None]
        block = jnp.where(real[node][:, None, None], sign * block, 0)
        gap = gap.at[bonds, :, node, :].add(block)
    return gap.reshape(6 * num_bonds, 6 * num_nodes)
