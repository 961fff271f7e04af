"""What a scene lacks leaves no operation in its program.

Programs are traced, not compiled, and counted before anything could be optimised away.
Every mark that must be absent from a lean program is present in a rich one.
"""

import jax
import jax.numpy as jnp
import pytest

from blastjax import chunks, damage, fracture, stress, world
from blastjax.author import shapes
from blastjax.core import Damage
from blastjax.rigid import build
from tests.operations import trace

PLAIN = shapes.grid((2, 1, 1))
HALF = jnp.full(1, 0.5)

RICH = shapes.grid((2, 1, 1), anchor=("x-",), root=True, pieces=(2, 1, 1))
ARM = """
<mujoco>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body pos="0 0 9">
      <joint name="hinge" limited="true" range="-1 1"/>
      <geom size="0.1"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


def hurt(asset, state, **parts):
    """Trace a round trip."""

    def step(state, parts):
        state, events = fracture.step(asset, state, Damage(**parts))
        return state, events, chunks.visible(asset, state)

    return trace(step, state, parts)


def whole(asset, **healths):
    state = fracture.init(asset, **healths)
    return state, {"bond": state.bond_health}, {"chunk": state.chunk_health}


def test_a_missing_part_of_the_asset_costs_nothing():
    state, bond, chunk = whole(PLAIN)
    lean = hurt(PLAIN, state, **bond, **chunk).operations
    for option in (
        {"root": True},
        {"pieces": (2, 1, 1)},
        {"anchor": ("x-",)},
    ):
        asset = shapes.grid((2, 1, 1), **option)
        state, bond, chunk = whole(asset)
        assert hurt(asset, state, **bond, **chunk).operations > lean, option


def test_masks_of_the_unbreakable_cost_nothing_where_all_can_break():
    state, bond, chunk = whole(PLAIN)
    lean = hurt(PLAIN, state, **bond, **chunk).operations
    masked, bond, chunk = whole(PLAIN, bond_health=HALF)
    assert masked.chunk_unbreakable is None
    assert hurt(PLAIN, masked, **bond, **chunk).operations > lean


def test_damage_of_one_kind_leaves_the_other_out():
    state, bond, chunk = whole(PLAIN)
    both = hurt(PLAIN, state, **bond, **chunk)
    on_bonds, on_chunks = hurt(PLAIN, state, **bond), hurt(PLAIN, state, **chunk)
    bonds, pieces = "fracture._apply_to_bonds", "fracture._apply_to_chunks"
    assert {bonds, pieces} <= both.sources
    assert pieces not in on_bonds.sources and bonds not in on_chunks.sources
    assert on_bonds.operations < both.operations > on_chunks.operations
    assert "chunks.several" in both.sources - on_bonds.sources


def test_asset_without_bonds_has_no_islands():
    asset = shapes.grid((1, 1, 1))
    state, bond, chunk = whole(asset)
    lean = hurt(asset, state, **bond, **chunk)
    state, bond, chunk = whole(PLAIN)
    full = hurt(PLAIN, state, **bond, **chunk)
    assert "graph._hook_and_jump" in full.sources
    assert "graph._hook_and_jump" not in lean.sources
    assert lean.operations < full.operations


def test_a_step_of_all_actors_keeps_no_account_of_dirty_nodes():
    state = fracture.init(PLAIN)

    def apart(state):
        state, events = fracture.apply(PLAIN, state, Damage(bond=HALF))
        return fracture.split(PLAIN, state), events

    two = trace(apart, state)
    one = trace(lambda s: fracture.step(PLAIN, s, Damage(bond=HALF)), state)
    assert "fracture._dirty" in two.sources and "fracture._dirty" not in one.sources
    assert one.operations < two.operations


@pytest.mark.parametrize("program", [damage.falloff, damage.cutter])
def test_damage_to_all_actors_is_not_restricted(program):
    state, point = fracture.init(PLAIN), jnp.zeros(3)
    every = jnp.ones(2, bool)
    lean = trace(lambda s: program(PLAIN, s, point, 1.0, 1.0, 2.0), state)
    full = trace(lambda s: program(PLAIN, s, point, 1.0, 1.0, 2.0, actors=every), state)
    assert "damage.restrict" in full.sources - lean.sources
    assert lean.operations < full.operations


@pytest.fixture(scope="module")
def worlds():
    """Programs of world steps, from nothing but flight to everything."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        lean = build(PLAIN, model="<mujoco/>", slots=2, chunk_contacts=False)
        rich = build(RICH, model=ARM, slots=2)
        start, crowd = (jax.eval_shape(lambda x=x: world.init(x)) for x in (lean, rich))
        hit = Damage(bond=HALF)
        strong = stress.Limits(*[1e6] * 6)
        load = world.Stress(stress.structure(rich.asset), strong)
        everything = {
            "impact": world.Impact(),
            "stress": load,
            "remove_dead": True,
        }
        return {
            "flight": trace(lambda w: world.step(lean, w), start),
            "breaking": trace(lambda w: world.step(lean, w, damage=hit), start),
            "debris": trace(
                lambda w: world.step(lean, w, damage=hit, remove_dead=True), start
            ),
            "all": trace(lambda w: world.step(rich, w, **everything), crowd),
        }


CONTACT = {"contact._meets", "engine.contact_frame", "rows._pyramids", "solver.solve"}
CHUNK_CONTACT = {"box.box_box", "contact._excuse_overlap"}
GRACE = {"bodies._pass_on", "bodies.settle"}
USER = {"engine.user_rows", "engine.accelerate", "rows._user_jacobian"}
WATCHED = {"bodies._axes", "bodies._motion"}
STRESS = {"stress", "failure.judge", "world.bear", "world.contact_load"}
IMPACT = {"world.impact_damage", "damage._radial"}
CHUNK_DAMAGE = {"fracture._apply_to_chunks"}
DEBRIS = {"fracture.deactivate", "world._swept"}
REMOVAL = {"world._dead"}
CROWD = {"bodies.outcasts"}
HELD = {"world.held_weight"}
FRACTURE = {"fracture.split", "fracture._apply_to_bonds", "bodies.reassign"}

LACKS = CONTACT | CHUNK_CONTACT | GRACE | USER | STRESS | IMPACT | CHUNK_DAMAGE
LACKS = LACKS | CROWD | HELD | WATCHED


@pytest.mark.parametrize(
    ("name", "absent"),
    [
        ("flight", LACKS | DEBRIS | REMOVAL | FRACTURE),
        ("breaking", LACKS | DEBRIS | REMOVAL),
        ("debris", LACKS),
    ],
)
def test_world_program_is_free_of_what_the_scene_lacks(worlds, name, absent):
    assert absent <= worlds["all"].sources, absent - worlds["all"].sources
    assert not absent & worlds[name].sources


def test_world_programs_grow_with_what_scenes_have(worlds):
    assert FRACTURE <= worlds["breaking"].sources
    assert DEBRIS | REMOVAL <= worlds["debris"].sources
    counts = [worlds[k].operations for k in ("flight", "breaking", "debris", "all")]
    assert counts == sorted(set(counts))
