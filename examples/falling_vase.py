"""A vase falls and shatters: any watertight mesh, cut, dropped and drawn.

Needs the extras: pip install 'blastjax[geometry,cli]'.
"""

import pathlib

import jax
import numpy as np
import trimesh

from blastjax import render, world
from blastjax.author import cut, hulls
from blastjax.rigid import Resting, build

# Radius and height of the wall, from the axis outside, up, and down the inside again.
OUTER = [[0, 0], [0.1, 0], [0.15, 0.14], [0.16, 0.24], [0.09, 0.4], [0.12, 0.5]]
INNER = [[0.1, 0.5], [0.07, 0.4], [0.13, 0.24], [0.12, 0.14], [0.08, 0.03], [0, 0.03]]

# Friction ten times stiffer than contacts: pieces that lean hardly creep.
FLOOR = """
<mujoco><option impratio="10"/><worldbody>
<light pos="0 0 10" dir="0 0 -1" directional="true"/>
<geom type="plane" size="0 0 .05" friction="0.6 0.005 0.0001"/></worldbody></mujoco>
"""


def main(path: str | None = None, shards: int = 24, seconds: float = 3.0) -> None:
    """Drop a vase on its rim and write an animation, if a path is given."""
    # A solid of revolution, in Voronoi cells; bonds are where cells touch.
    vase = trimesh.creation.revolve(np.array(OUTER + INNER), sections=32)
    tree = cut.solid(vase)
    tree = cut.voronoi(tree, cut.uniform(tree, shards, seed=2))
    thing = cut.destructible(tree).destructible

    # Shards collide as convex hulls; what they weigh comes from their meshes.
    shapes = hulls.fit(thing, vertices=24)
    scene = build(
        thing,
        slots=len(thing.meshes),
        collision="hull",
        hulls=shapes,
        position=(0, 0, 0.7),
        quaternion=(0.85, 0.4, 0.3, 0.1),
        density=2400.0,
        friction=0.6,
        resting=Resting(),
        model=FLOOR,
    )
    impact = world.Impact(hardness=1.0, min_radius=0.05, max_radius=0.4)
    step = jax.jit(lambda scene, now: world.step(scene, now, impact=impact)[0])
    show = jax.jit(render.pose)

    now, poses = world.init(scene), []
    timestep = float(scene.model.opt.timestep)
    for i in range(round(seconds / timestep)):
        if i % round(0.04 / timestep) == 0:
            poses.append(jax.device_get(show(scene, now)))
        now = step(scene, now)

    loose = int((now.bodies.label >= 0).sum())
    speed = float(np.abs(now.data.qvel).max())
    print(f"{len(thing.meshes)} chunks of {int(shapes.size.shape[1])} faces at most")
    print(f"{loose} pieces after {seconds} s, fastest {speed:.2f} m/s or rad/s")
    if path is not None:
        with render.Renderer(scene, width=480, height=360, zoom=0.55) as drawing:
            drawing.camera.lookat[2] = 0.4
            pictures = [drawing.draw(pose) for pose in poses]
        print("wrote", render.save(pathlib.Path(path), pictures))


if __name__ == "__main__":
    main("vase.gif")
