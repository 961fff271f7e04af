"""Derivatives of the world through impact, friction and fracture, at full length."""

import argparse

import pytest

from tests.benchmarks import world_gradient


@pytest.mark.slow
def test_forty_steps_through_impact_friction_and_fracture():
    options = argparse.Namespace(steps=40, step=2e-6, pieces=False)
    found = world_gradient.check(options)
    assert found["bonds broken at step"] and found["steps with contact"] > 20
    assert found["same bonds broke in all quotients"]
    assert found["reverse - forward"] < 1e-12
    assert found["reverse - difference quotient"] < 1e-7
