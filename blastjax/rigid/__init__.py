"""Breaking bodies in MJX: an actor is one free body, its chunks are geoms it borrows.

MJX fixes the tree of bodies when a model is compiled; a thing that breaks has no fixed
tree. So a scene holds K *slots*, free bodies without geoms, and one mocap body with
one geom for every chunk. Which slot carries which chunk is data: at each step the
chunks of an actor are placed by its slot, and a contact on a chunk acts on that slot's
six degrees of freedom. What the world holds acts on the world itself. Rigidity is
therefore exact, and the constraint solver sees 6 K unknowns however many chunks there
are.

| module | job |
|---|---|
| `scene` | host: MJCF from an asset and the user's own model, with all validation |
| `bodies` | which actor rides in which slot, and where that puts its chunks |
| `contact` | pairs, manifolds and caps; forces and impulses on the chunks |
| `rows` | what contacts and the user's constraints ask of the solver |
| `resting` | how what lies comes to rest, where a scene asks for it |
| `box` | boxes against boxes, all pairs side by side |
| `hull` | convex hulls that differ, by one collider for all pairs |
| `tables` | host: which hull each geom has, and the meshes that are drawn |
| `solver` | the contact problem, by Newton's method with an implicit derivative |
| `engine` | the only tie to MJX's private functions; a canary test watches it |
"""

from blastjax.rigid import (
    bodies,
    box,
    contact,
    engine,
    hull,
    resting,
    rows,
    scene,
    solver,
)
from blastjax.rigid.scene import Resting, Scene, build

__all__ = [
    "Resting",
    "Scene",
    "bodies",
    "box",
    "build",
    "contact",
    "engine",
    "hull",
    "resting",
    "rows",
    "scene",
    "solver",
]
