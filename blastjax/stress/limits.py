"""From bond loads to stresses, and from stresses to damage: Blast's material rules.

A *load* is the force (N) and torque (N m) that a bond transmits, as it acts on the
bond's first node. Its stress is a pressure along the bond normal (tension positive) and
a shear across it, Pa; bending and twisting add to them. Below the *elastic* limit of
its kind a stress does nothing, at the *fatal* limit it breaks the bond, and in between
it takes the proportional part of the bond's health.
"""

import jax
import jax.numpy as jnp

from blastjax import pytree, spatial
from blastjax.core import UNBREAKABLE

Scalar = float | jax.Array


@pytree.dataclass
class Limits(pytree.Node):
    """What a material bears, Pa: all fields () or all (M,), one a material.

    Negative limits of tension and shear stand for those of compression.
    """

    compression_elastic: Scalar
    """Pressure from which bonds take damage."""
    compression_fatal: Scalar
    """Pressure at which they break."""
    tension_elastic: Scalar = -1.0
    """Pull from which bonds take damage."""
    tension_fatal: Scalar = -1.0
    """Pull at which they break."""
    shear_elastic: Scalar = -1.0
    """Shear from which bonds take damage."""
    shear_fatal: Scalar = -1.0
    """Shear at which they break."""


@pytree.dataclass
class BondStress(pytree.Node):
    """Stress of each bond, Pa."""

    normal: jax.Array
    """(B,) along the bond normal: tension above zero, compression below."""
    shear: jax.Array
    """(B,) across it, never negative."""
    opposite: jax.Array | None = None
    """(B,) normal stress at a bent bond's other face; None if one speaks for both."""


def effective(limits: Limits) -> Limits:
    """Return the limits with the inherited ones filled in.

    Elastic and fatal limits inherit each by itself. Differentiable, exactly.
    """
    elastic = jnp.asarray(limits.compression_elastic)
    fatal = jnp.asarray(limits.compression_fatal)

    def inherit(own: Scalar, parent: jax.Array) -> jax.Array:
        own = jnp.asarray(own, parent.dtype)
        return jnp.where(own < 0, parent, own)

    return Limits(
        compression_elastic=elastic,
        compression_fatal=fatal,
        tension_elastic=inherit(limits.tension_elastic, elastic),
        tension_fatal=inherit(limits.tension_fatal, fatal),
        shear_elastic=inherit(limits.shear_elastic, elastic),
        shear_fatal=inherit(limits.shear_fatal, fatal),
    )


def bond_stress(
    force: jax.Array,
    torque: jax.Array,
    normal: jax.Array,
    area: jax.Array,
    distance: jax.Array,
    *,
    both_faces: bool = False,
) -> BondStress:
    """Combine the loads of bonds into stresses, with Blast's section moduli.

    Twisting adds `2 |twist| / (area distance)` to the shear, and bending as much to the
    pressure, away from zero.

    Args:
      force: (B, 3) on the first node, N; along the normal it is tension.
      torque: (B, 3) on the first node, N m.
      normal: (B, 3) unit, from the first node towards the second.
      area: (B,) that bears the load, m^2; in Blast, the bond's health.
      distance: (B,) between the nodes, m.
      both_faces: give the stress at the opposite face too, from which bending takes
        what it adds here. Blast judges one face: under pure bending, rounding decides
        whether that is the pressed or the pulled one.

    Returns:
      The stresses, zero where the area is. Differentiable; where the pressure passes
      zero under bending, that of one face jumps, and the derivative misses it.
    """
    along, across = _parts(force, normal)
    twist, bend = _parts(torque, normal)
    pressure = spatial.ratio(along, area)
    sign = jnp.where(jnp.signbit(pressure), -1, 1).astype(pressure.dtype)
    lever = distance * area / 2
    bending = sign * spatial.ratio(bend, lever)
    return BondStress(
        normal=pressure + bending,
        opposite=pressure - bending if both_faces else None,
        shear=spatial.ratio(across, area) + spatial.ratio(jnp.abs(twist), lever),
    )


def _parts(vector: jax.Array, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the component along a unit normal, and the length of the rest."""
    along = spatial.dot(vector, normal)
    # Not as a difference of squares: that costs float32 half its digits.
    return along, spatial.norm(vector - along[:, None] * normal)


def _of_bonds(limits: Limits, material: jax.Array | None, like: jax.Array) -> Limits:
    """Return effective limits of each bond, (B,) or ()."""
    full = effective(limits)

    def pick(limit: Scalar) -> jax.Array:
        limit = jnp.asarray(limit, like.dtype)
        if material is not None and limit.ndim:
            limit = limit[material]
        return jnp.broadcast_to(limit, like.shape)

    return Limits(
        compression_elastic=pick(full.compression_elastic),
        compression_fatal=pick(full.compression_fatal),
        tension_elastic=pick(full.tension_elastic),
        tension_fatal=pick(full.tension_fatal),
        shear_elastic=pick(full.shear_elastic),
        shear_fatal=pick(full.shear_fatal),
    )


def utilisation(
    limits: Limits, stress: BondStress, material: jax.Array | None = None
) -> jax.Array:
    """Return how much of its elastic limit each bond uses, (B,); from 1 on it yields.

    The largest over compression, tension and shear; infinite if a limit is zero and the
    stress is not.

    Args:
      limits: of one material, or of M.
      stress: of the bonds.
      material: (B,) int32, the material of each bond; None if there is one only.

    Differentiable; where two of them tie, half of each.
    """
    own = _of_bonds(limits, material, stress.normal)

    def part(load: jax.Array, limit: jax.Array) -> jax.Array:
        load = jnp.maximum(load, 0)
        weak = (limit <= 0) & (load > 0)
        return jnp.where(weak, jnp.inf, spatial.ratio(load, limit))

    used = part(stress.shear, jnp.asarray(own.shear_elastic))
    for normal in _faces(stress):
        pressed = part(-normal, jnp.asarray(own.compression_elastic))
        pulled = part(normal, jnp.asarray(own.tension_elastic))
        used = jnp.maximum(used, jnp.maximum(pressed, pulled))
    return used


def _faces(stress: BondStress) -> list[jax.Array]:
    return [x for x in (stress.normal, stress.opposite) if x is not None]


def overstressed(
    limits: Limits, stress: BondStress, material: jax.Array | None = None
) -> jax.Array:
    """Return which bonds exceed an elastic limit, (B,) bool.

    Piecewise constant: no derivative passes.
    """
    own = _of_bonds(limits, material, stress.normal)
    over = stress.shear > own.shear_elastic
    for normal in _faces(stress):
        over = over | (-normal > own.compression_elastic)
        over = over | (normal > own.tension_elastic)
    return over


def damage(
    limits: Limits,
    stress: BondStress,
    health: jax.Array,
    material: jax.Array | None = None,
) -> jax.Array:
    """Return the health that stress takes from each bond, (B,), by Blast's rule.

    The part of the way from the elastic to the fatal limit, for pressure and for shear,
    times the health; it may be more than the health. Where the fatal limit is not above
    the elastic one, Blast divides by 1 Pa instead, and so does this.

    Args:
      limits: of one material, or of M.
      stress: of the bonds.
      health: (B,) of the bonds; those without any, and from UNBREAKABLE up, take no
        damage.
      material: (B,) int32, the material of each bond; None if there is one only.

    Differentiable; misses the jump where limits do not leave room between them.
    """
    own = _of_bonds(limits, material, stress.normal)

    def part(load: jax.Array, elastic: Scalar, fatal: Scalar) -> jax.Array:
        width = jnp.asarray(fatal - elastic)
        share = (load - elastic) / jnp.where(width > 0, width, 1)
        return jnp.where(load > elastic, share, 0)

    share = jnp.zeros_like(stress.normal)
    for normal in _faces(stress):
        pressed = part(-normal, own.compression_elastic, own.compression_fatal)
        pulled = part(normal, own.tension_elastic, own.tension_fatal)
        # Of either sign: where a limit is zero, both parts must not count.
        face = jnp.where(-normal > own.compression_elastic, pressed, pulled)
        share = jnp.maximum(share, face)
    share = share + part(stress.shear, own.shear_elastic, own.shear_fatal)
    # Of no use where nothing can break, and beyond all numbers.
    taken = (health > 0) & (health < UNBREAKABLE) & (share > 0)
    return jnp.where(taken, share * jnp.where(taken, health, 0), 0)
