"""The library against the plain-Python reference on random assets and damage."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import conformance, random_cases

pytestmark = pytest.mark.usefixtures("strict")

EXAMPLES = 120, 500
"""For padded and unpadded each: as a rule, and of a slow test: 1,000 in all."""


@pytest.mark.parametrize(
    "examples", [EXAMPLES[0], pytest.param(EXAMPLES[1], marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("padded", [True, False], ids=["padded", "unpadded"])
def test_agrees_with_reference(padded, examples):
    @settings(max_examples=examples, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from(random_cases.SIZES))
    def agrees(seed, size):
        case = random_cases.random_case(seed, size)
        replay = conformance.Replay(case, padded=padded).run()
        assert not replay.found

    agrees()


def test_cases_cover_what_they_should():
    """The generator is worth its name: things break, split and give way."""
    broken = split = gave_way = 0
    for seed in range(60):
        case = random_cases.random_case(seed, random_cases.SIZES[seed % 4])
        last = case["states"][-1]
        broken += int((last["bond_health"] == 0).sum())
        split += len(last["actors"]) > 1
        gave_way += any(not len(a["nodes"]) for a in last["actors"])
    assert broken > 100
    assert split > 20
    assert gave_way > 3
