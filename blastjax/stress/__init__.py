"""Stress: loads become forces in bonds, forces become stress, stress becomes damage.

`structure` prepares an asset on the host; `solve` finds the bond forces of a state
under a `Load`; `judge` holds them against `Limits`; `collapse` goes on until nothing
more breaks. `parity` reproduces the figures of Blast's own scheme.
"""

from blastjax.stress import parity
from blastjax.stress.equilibrium import Solution, solve
from blastjax.stress.failure import (
    Collapse,
    Verdict,
    collapse,
    excess,
    judge,
    stress_damage,
)
from blastjax.stress.limits import (
    BondStress,
    Limits,
    bond_stress,
    damage,
    effective,
    overstressed,
    utilisation,
)
from blastjax.stress.loads import (
    Load,
    add,
    at_node,
    at_position,
    centrifugal,
    gravity,
    node_mass,
    node_place,
)
from blastjax.stress.structures import Structure, structure

__all__ = [
    "BondStress",
    "Collapse",
    "Limits",
    "Load",
    "Solution",
    "Structure",
    "Verdict",
    "add",
    "at_node",
    "at_position",
    "bond_stress",
    "centrifugal",
    "collapse",
    "damage",
    "effective",
    "excess",
    "gravity",
    "judge",
    "node_mass",
    "node_place",
    "overstressed",
    "parity",
    "solve",
    "stress_damage",
    "structure",
    "utilisation",
]
