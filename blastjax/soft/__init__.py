"""Derivatives that see fracture, where those of `fracture` miss its jumps.

A bond is there or gone, a chunk is held or falls: the derivative of what happens to a
broken body is zero almost everywhere and says nothing. These are the ways around it:

- `margin`: how far a chunk is from coming loose. Continuous, and its sign is exact.
- `expect`: the mean of any loss when bonds are of random strength, which is smooth.
- `evolve`: damage in continuous time, with the moments of fracture as unknowns.
- `loosen`, `share_velocity`: a soft relaxation, a model of its own.
"""

from blastjax.soft.chance import (
    Expectation,
    Strength,
    expect,
    expect_by_flips,
    logistic,
    weibull,
)
from blastjax.soft.crossing import Evolution, evolve
from blastjax.soft.margins import (
    bond_margin,
    hold_loss,
    margin,
    perturbed_margin,
    release_loss,
)
from blastjax.soft.relaxation import loosen, share_velocity

__all__ = [
    "Evolution",
    "Expectation",
    "Strength",
    "bond_margin",
    "evolve",
    "expect",
    "expect_by_flips",
    "hold_loss",
    "logistic",
    "loosen",
    "margin",
    "perturbed_margin",
    "release_loss",
    "share_velocity",
    "weibull",
]
