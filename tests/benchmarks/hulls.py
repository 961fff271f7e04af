"""Hulls against boxes, rest, and MuJoCo C: python -m tests.benchmarks.hulls.

Four tables. Compilation and step time of a slab of 64 Voronoi pieces as 64 distinct
hulls and as 64 boxes, in one process, interleaved. How still and how deep pieces of a
broken slab and vase lie after they fell, with and without `rigid.Resting`, and how
still MuJoCo C leaves the same hulls from 0.1 s after the break. From when on they lie
still after falls from several heights (only with --only falls). How far single pieces
end up from where MuJoCo C, with mesh geoms, leaves them. float32, unless --x64.
"""

import argparse
import itertools
import json
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from blastjax import world
from blastjax.author import cut, hulls
from blastjax.core import NONE
from blastjax.rigid import Resting, build
from tests import pieces

FLOOR = """
<mujoco><option timestep="0.004" impratio="{}"/>
<default><geom solref="0.015 1"/></default><worldbody>
<light pos="0 0 3" directional="true"/>
<geom name="floor" type="plane" size="0 0 .05" friction="{} .005 .0001"/>
</worldbody></mujoco>
"""
STILL = 1e-3
"""m/s, of the fastest piece's centre of mass."""
TUMBLING = 0.1
"""m/s, likewise: what is faster has not come to lie yet."""
TIMESTEP = 0.004
SLAB = np.array([0.5, 0.4, 0.08])
DROPS = (0.1, 0.2, 0.3, 0.45, 0.6)
"""Heights of falls, m."""


def solid(kind, sites, seed=None):
    """Return a slab of 1 m or a vase of 0.5 m, cut at the sites."""
    if kind == "slab":
        return pieces.voronoi(SLAB, sites, seed=3 if seed is None else seed)
    tree = cut.solid(pieces.vase())
    tree = cut.voronoi(tree, cut.uniform(tree, sites, seed=1 if seed is None else seed))
    return cut.destructible(tree).destructible


def timed(scene, start, repeats):
    """Return seconds to trace, to compile, and the compiled step."""
    began = time.perf_counter()
    lowered = jax.jit(world.step).lower(scene, start)
    traced = time.perf_counter()
    step = lowered.compile()
    return traced - began, time.perf_counter() - traced, step


def compilation(sites=64, slots=8, repeats=30):
    """Return rows of what 64 hulls and 64 boxes cost."""
    slab = solid("slab", sites)
    scenes = {
        "boxes": build(slab.asset, slots=slots, position=(0, 0, 0.079)),
        "hulls": build(slab, slots=slots, position=(0, 0, 0.079), collision="hull"),
    }
    rows, steps = {}, {}
    for name, scene in scenes.items():
        start = world.init(scene)
        trace, compiled, step = timed(scene, start, repeats)
        rows[name] = {"trace": trace, "compile": compiled}
        steps[name] = (step, scene, start)
    spent = {name: [] for name in scenes}
    for _ in range(repeats):
        for name, (step, scene, start) in steps.items():
            began = time.perf_counter()
            jax.block_until_ready(step(scene, start))
            spent[name].append(time.perf_counter() - began)
    for name in scenes:
        rows[name]["step_ms"] = 1e3 * float(np.median(spent[name]))
    return rows


def fallen(scene, seconds):
    """Drop a scene; return the world, and what was seen at each step.

    Numbers are top speed, depth, lowest centre, pieces and residual.
    """
    impact = world.Impact(hardness=0.3, max_radius=1.0)

    def one(state, _):
        state, events = world.step(scene, state, impact=impact)
        moved = state.data.qvel[scene.host.slot_dof]
        pose = state.data.qpos[scene.host.slot_qpos]
        used = state.bodies.label != NONE
        speed = jnp.max(jnp.where(used, jnp.linalg.norm(moved[:, :3], axis=1), 0))
        deep = -jnp.min(state.data._impl.contact.dist)
        low = jnp.min(jnp.where(used, pose[:, 2], 9))
        residual = events.solver.residual
        numbers = jnp.stack([speed, deep, low, jnp.sum(used), residual])
        return state, (numbers, pose, moved)

    return jax.lax.scan(one, world.init(scene), length=round(seconds / TIMESTEP))


def judged(track):
    """Return how still and how deep pieces lie, from the numbers of a fall."""
    last, still = track[-50:], np.flatnonzero(track[:, 0] > STILL)
    tumbled = np.flatnonzero(track[:, 0] > TUMBLING)
    broke = np.flatnonzero(np.diff(track[:, 3])) + 1
    return {
        "actors": int(last[-1, 3]),
        "speed": float(last[:, 0].max()),
        "penetration": float(last[:, 1].max()),
        "lowest_moved": float(np.ptp(last[:, 2])),
        "still_after": float((still[-1] + 1 if still.size else 0) * TIMESTEP),
        "settled_in": float((still[-1] - tumbled[-1]) * TIMESTEP),
        "broke_at": float(broke[:1].sum() * TIMESTEP),
        "last_broke_at": float(broke[-1:].sum() * TIMESTEP),
        "residual": float(last[:, 4].max()),
    }


def standing(kind, thing, table, impratio, friction, resting, drop):
    """Return the scene of a solid above the floor."""
    return build(
        thing,
        slots=len(thing.meshes),
        collision="hull",
        hulls=table,
        position=(0, 0, drop + (0.08 if kind == "slab" else 0)),
        friction=friction,
        resting=resting,
        model=FLOOR.format(impratio, friction),
    )


def rest(kind, sites, seconds=4.0, impratio=10.0, friction=1.0, resting=None, drop=0.3):
    """Drop a solid, let it break, and measure how its pieces lie in the last 0.2 s."""
    thing = solid(kind, sites)
    table = hulls.fit(thing, vertices=32)
    scene = standing(kind, thing, table, impratio, friction, resting, drop)
    end, found = jax.jit(fallen, static_argnums=1)(scene, seconds)
    track, pose, moved = map(np.asarray, found)
    broke = int(np.flatnonzero(track[:, 3] == track[-1, 3])[0])
    after = min(broke + 25, len(track) - 1)
    start, steps = (pose[after], moved[after]), len(track) - after
    peer = rest_in_c(thing, table, end.bodies, start, steps, impratio, friction)
    awake = np.flatnonzero(peer > STILL)
    c_still = after + (awake[-1] + 1 if awake.size else 0)
    return judged(track) | {
        "c_speed": float(peer[-50:].max()),
        "c_still_after": float(c_still * TIMESTEP),
        "dropped": int(end.dropped.contacts + end.dropped.pairs),
        "fit": [float(f(hulls.fit_error(thing, table))) for f in (np.min, np.max)],
    }


def falls(kind, sites, seed, drops, seconds=4.0, friction=1.0, resting=None):
    """Return how pieces lie after falls from several heights."""
    thing = solid(kind, sites, seed)
    table = hulls.fit(thing, vertices=32)
    scene = standing(kind, thing, table, 10.0, friction, resting, 0.0)
    # The same solid at another height: one compilation for all.
    place = scene.position + jnp.array([[0, 0, z] for z in drops], scene.position.dtype)

    def one(position):
        end, (track, _, _) = fallen(scene.replace(position=position), seconds)
        return track, end.dropped.contacts + end.dropped.pairs

    tracks, dropped = jax.jit(lambda x: jax.lax.map(one, x))(place)
    return [
        judged(np.asarray(track)) | {"drop": z, "seed": seed, "dropped": int(lost)}
        for z, track, lost in zip(drops, tracks, dropped, strict=True)
    ]


def rest_in_c(thing, table, bodies, start, steps, impratio, friction):
    """Return the top speed at each step of MuJoCo C, from 0.1 s after the break on."""
    spec = mujoco.MjSpec.from_string(FLOOR.format(impratio, friction))
    spec.option.iterations, spec.option.tolerance = 100, 1e-10
    asset, slot = thing.asset, np.asarray(bodies.slot)
    chunk, used = np.asarray(asset.element_chunk), np.unique(slot[slot >= 0])
    for k in used:
        body = spec.worldbody.add_body()
        body.add_freejoint()
        for c in chunk[(slot == k) & (chunk >= 0)]:
            place = np.asarray(asset.chunk_centroid[c] - bodies.center[k], float)
            for row in np.flatnonzero(np.asarray(table.chunk) == c):
                points = np.unique(np.asarray(table.vertices[row], float), axis=0)
                spec.add_mesh(name=f"m{row}", uservert=(points + place).reshape(-1))
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_MESH,
                    meshname=f"m{row}",
                    density=1000.0,
                    friction=[friction, 0.005, 0.0001],
                )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (x[used].reshape(-1) for x in start)
    speed = np.zeros(steps)
    for i in range(steps):
        mujoco.mj_step(model, data)
        moved = data.qvel.reshape(-1, 6)[:, :3]
        speed[i] = np.linalg.norm(moved, axis=1).max()
    return speed


def against_c(count=8, seconds=1.0):
    """Return how far pieces, dropped one by one, are from C's: height and way, m."""
    slab, found = solid("slab", 16), []
    for mesh in slab.meshes[:count]:
        thing = pieces.destructible([mesh])
        center = np.asarray(thing.asset.chunk_centroid, float)[0]
        drop = 0.02 - mesh.vertices[:, 2].min()
        scene = build(
            thing,
            collision="hull",
            position=(0, 0, drop),
            model=FLOOR.format(1, 1),
            tolerance=1e-10,
            iterations=50,
        )
        spec = mujoco.MjSpec.from_string(FLOOR.format(1, 1))
        spec.option.iterations, spec.option.tolerance = 100, 1e-10
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        body = spec.worldbody.add_body(pos=center + np.array([0, 0, drop]))
        body.add_freejoint()
        spec.add_mesh(name="m", uservert=(mesh.vertices - center).reshape(-1))
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname="m",
            density=1000.0,
            contype=0,
            conaffinity=1,
            friction=[1.0, 0.005, 0.0001],
        )
        model = spec.compile()
        data = mujoco.MjData(model)
        steps = round(seconds / 0.004)
        for _ in range(steps):
            mujoco.mj_step(model, data)
        one = jax.jit(lambda s, w: world.step(s, w)[0])
        state = world.init(scene)
        for _ in range(steps):
            state = one(scene, state)
        ours = np.asarray(state.data.qpos[scene.host.slot_qpos[0, :3]])
        found.append(np.abs(ours - data.qpos[:3]))
    return {
        "height": [float(f[2]) for f in found],
        "way": [float(np.linalg.norm(f[:2])) for f in found],
    }


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sites", type=int, default=64)
    parser.add_argument("--x64", action="store_true")
    parser.add_argument("--only", choices=["compile", "rest", "falls", "c"])
    parser.add_argument("--json")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.x64)
    result = {}
    if options.only in (None, "compile"):
        result["compile"] = rows = compilation(options.sites)
        print(f"{options.sites} pieces   trace s  compile s  step ms")
        for name, row in rows.items():
            print(
                f"{name:9} {row['trace']:9.1f} {row['compile']:10.1f} "
                f"{row['step_ms']:8.2f}"
            )
        both = {n: r["trace"] + r["compile"] for n, r in rows.items()}
        print(
            f"ratio hulls / boxes, trace + compile: {both['hulls'] / both['boxes']:.2f}"
        )
    if options.only in (None, "rest"):
        result["rest"] = {}
        cases = [(kind, how) for kind in ("slab", "vase") for how in (False, True)]
        for kind, resists in cases:
            found = rest(kind, 12, resting=Resting() if resists else None)
            name = f"{kind}, {'resting' if resists else 'contacts alone'}"
            result["rest"][name] = found
            print(
                f"{name}: {found['actors']} pieces, "
                f"broke at {found['broke_at']:.2f} s, "
                f"speed {found['speed']:.1e} m/s in the last 0.2 s (below 1e-3 from "
                f"{found['still_after']:.2f} s), "
                f"penetration {found['penetration'] * 1e3:.2f} mm, lowest centre "
                f"moved {found['lowest_moved']:.1e} m, dropped {found['dropped']}; "
                f"MuJoCo C: speed {found['c_speed']:.1e} m/s (below 1e-3 from "
                f"{found['c_still_after']:.2f} s)"
            )
    if options.only == "falls":
        result["falls"] = rows = []
        print(
            "solid friction seed drop m  still from s  since last break  "
            "since tumbling  depth mm  m/s"
        )
        for kind, seeds in (("slab", (3, 4)), ("vase", (1, 5))):
            for seed, friction in itertools.product(seeds, (0.5, 1.0)):
                found = falls(
                    kind, 12, seed, DROPS, friction=friction, resting=Resting()
                )
                for row in found:
                    print(
                        f"{kind:5} {friction:8.1f} {seed:4} {row['drop']:6.2f} "
                        f"{row['still_after']:12.2f} "
                        f"{row['still_after'] - row['last_broke_at']:16.2f} "
                        f"{row['settled_in']:15.2f} "
                        f"{row['penetration'] * 1e3:8.2f}  {row['speed']:.0e}",
                        flush=True,
                    )
                    rows.append(row | {"kind": kind, "friction": friction})
    if options.only in (None, "c"):
        result["c"] = found = against_c()
        for name, rows in found.items():
            print(f"from C, {name}: " + " ".join(f"{x:.1e}" for x in rows), "m")
    if options.json:
        with open(options.json, "w") as file:
            json.dump(result, file, indent=2)


if __name__ == "__main__":
    main()
