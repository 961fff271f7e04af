"""Scenes: a breakable asset put into the user's own MuJoCo model, on the host.

The user's bodies, joints and actuators keep their ids and addresses: what the library
adds comes after them. It adds one mocap body `chunk<element>` for every chunk that can
collide, with one geom or as many as it has hulls, and K free bodies `slot<k>` without
geoms. To MJX a hull is a box around it, which sorts all pairs of hulls into one kind;
`hull` then collides what is inside. Sizes: K slots, A
elements, G geoms, V degrees of freedom, E elements that have a chunk.
"""

import dataclasses
import os
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from blastjax import pytree
from blastjax.author.hulls import Hulls, fit
from blastjax.author.mesh import Destructible
from blastjax.core import Asset
from blastjax.rigid import engine, tables
from blastjax.rigid.hull import Table

BOX, SPHERE, HULL = "box", "sphere", "hull"

_DEFAULT_MODEL = """
<mujoco>
  <worldbody>
    <light pos="0 0 10" dir="0 0 -1" directional="true"/>
    <geom name="floor" type="plane" size="0 0 .05"/>
  </worldbody>
</mujoco>
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Host:
    """What a scene keeps on the host, hashed by identity: never copied or compared."""

    model: mujoco.MjModel
    """The compiled model, for rendering and for MuJoCo C; chunks with meshes have them
    as geoms in it."""
    own: engine.Own
    """What the user's model is without the breakable."""
    slot_body: np.ndarray
    """(K,) body of each slot."""
    slot_qpos: np.ndarray
    """(K, 7) addresses of each slot's position and quaternion."""
    slot_dof: np.ndarray
    """(K, 6) addresses of each slot's linear and angular velocity."""
    mocap: np.ndarray
    """(E,) mocap body, by mocap id, of each chunk that can collide."""
    element: np.ndarray
    """(E,) element of each of them."""
    geom_element: np.ndarray
    """(G,) element of each geom, -1 for the user's own."""
    geom_weld: np.ndarray
    """(G,) body that carries each geom; 0 for all that cannot move."""
    chunk_sides: tuple[int, ...]
    """Sides of a contact, 0 and 1, on which a chunk can be."""
    chunk_kinds: frozenset[tuple[int, int]]
    """Types of geoms of which two chunks can collide: one pair of types or none."""
    user_meets: bool
    """Whether a geom of the user's that moves can collide."""


@pytree.dataclass
class Resting(pytree.Node):
    """How what lies comes to rest: see `rigid.resting`.

    Resistance and hold are parts of the load that a slot bears on the ground and on
    what stands on it. What slides is left to friction until it is slow enough to fall
    asleep, what flies to itself. What stands on an edge may lean by about as many
    radians and not fall over, and what moves on something that moves itself is not
    resisted by it.
    """

    resistance: jax.Array | float = 0.15
    """() against rolling, rocking and twisting: of a wheel, about the coefficient of
    rolling resistance."""
    hold: jax.Array | float = 0.3
    """() what something asleep withstands: more wakes it."""
    speed: jax.Array | float = 0.05
    """() what is slower than this for the delay falls asleep, m/s; what gains speed
    from rest counts as faster. Soft friction lets pieces creep at some cm/s."""
    delay: jax.Array | float = 0.25
    """() s. Whenever something parts, all wake."""


@pytree.dataclass
class Scene(pytree.Node):
    """A breakable asset in a MuJoCo model; made by `build`."""

    asset: Asset
    """The asset, in the floating-point type of the model."""
    model: mjx.Model
    """The model on the device."""
    position: jax.Array
    """(3,) where the asset's rest frame starts, m."""
    quaternion: jax.Array
    """(4,) how it starts, w first."""
    density: jax.Array
    """() or (C,) density, kg/m^3."""
    hulls: Table | None
    """Convex hulls of the geoms, or None where chunks are boxes or spheres."""
    resting: Resting | None
    """How what lies comes to rest, or None if by friction alone."""
    host: Host = pytree.static()
    """The compiled model and the addresses of what was added to it."""
    line_search: int = pytree.static()
    """Steps of the solver's line search."""

    @property
    def slots(self) -> int:
        """K, how many actors can move at a time."""
        return len(self.host.slot_body)

    @property
    def users(self) -> int:
        """U, degrees of freedom of the user's model, before those of the slots."""
        return self.model.nv - 6 * self.slots

    @property
    def watched(self) -> bool:
        """Whether joints of the user's, sensors or cameras ask how slots move."""
        return bool(self.users or self.model.nsensor or self.model.ncam)


def build(
    asset: Asset | Destructible,
    *,
    slots: int = 8,
    position: Any = (0.0, 0.0, 0.0),
    quaternion: Any = (1.0, 0.0, 0.0, 0.0),
    density: Any = 1000.0,
    friction: float = 1.0,
    collision: str = BOX,
    hulls: Hulls | None = None,
    chunk_contacts: bool = True,
    resting: Resting | None = None,
    model: str | os.PathLike[str] | mujoco.MjSpec | None = None,
    timestep: float | None = None,
    iterations: int = 20,
    line_search: int = 6,
    tolerance: float | None = None,
    max_pairs: int | None = None,
    max_contacts: int | None = None,
) -> Scene:
    """Put an asset into a model.

    Args:
      asset: concrete, not traced. Of a Destructible the meshes are drawn.
      slots: K, most actors that move at a time. Beyond them the lightest become debris.
        More slots than chunks are never needed and not made.
      position: (3,) of the asset's rest frame, m.
      quaternion: (4,) of the rest frame, w first; normalised here.
      density: kg/m^3, one for all or (C,).
      friction: sliding friction of the chunks.
      collision: "box", each chunk collides as a box of its half extents; "sphere", as
        the largest ball in that box: cheaper, and it rolls; "hull", as the convex hull
        of its mesh.
      hulls: of the chunks, for "hull"; by default `author.hulls.fit` of a Destructible.
      chunk_contacts: whether chunks of different actors collide. Without, no such pair
        is in the program at all.
      resting: how what lies comes to rest. By default by the contacts of MuJoCo alone,
        which creep, and nothing of it is in the program.
      model: MJCF as a string, a path or an MjSpec (left as it is). By default a floor.
        Its sensors and cameras may name chunks and slots. Wind and drag act on its own
        bodies, not on chunks.
      timestep: s; by default the model's own.
      iterations: most Newton steps of the contact solver.
      line_search: steps of each of its line searches.
      tolerance: where it stops, by default the model's own.
      max_pairs: most geom pairs of one kind that are looked at closely, the nearest
        first; planes are not counted. By default 2 for each chunk, 64 at least.
      max_contacts: most contacts that enter the solver; more are thinned out to the
        outline of each pair of actors. By default 16 for each slot and 16 more.

    Returns:
      A Scene. Caps that bite are counted in the World, never silent.

    Raises:
      ValueError: naming what is wrong, its value and the remedy.
    """
    place = _vector("position", position, 3)
    turn = _vector("quaternion", quaternion, 4)
    length = float(np.linalg.norm(turn))
    if length < 1e-6:
        raise ValueError(
            f"quaternion {tuple(turn.tolist())} has no length; "
            "(1, 0, 0, 0) is no rotation"
        )
    if slots < 1:
        raise ValueError(f"slots is {slots}; an actor needs at least 1 slot to move in")
    meshes = asset.meshes if isinstance(asset, Destructible) else None
    if collision == HULL:
        hulls = _hulls(asset, hulls)
    elif hulls is not None or collision not in (BOX, SPHERE):
        given = "with hulls" if hulls is not None else "unknown"
        raise ValueError(
            f"collision is {collision!r}, {given}; use 'hull', or 'box' or 'sphere' "
            "without hulls"
        )
    asset = asset.asset if isinstance(asset, Destructible) else asset
    _positive("friction", friction, zero=True)
    for name, cap in (("max_pairs", max_pairs), ("max_contacts", max_contacts)):
        if cap is not None and cap < 1:
            raise ValueError(f"{name} is {cap}; use 1 or more, or None for the default")
    if iterations < 1 or line_search < 1:
        raise ValueError(
            f"iterations {iterations} and line_search {line_search}: use at least 1"
        )
    if resting is not None:
        for field in dataclasses.fields(resting):
            _positive(field.name, float(getattr(resting, field.name)), zero=True)
    weight = _density(asset, density)
    elements = _check_chunks(asset)
    slots = min(slots, len(elements))

    spec = _spec(model)
    _check_model(spec)
    if timestep is not None:
        _positive("timestep", timestep)
        spec.option.timestep = timestep
    if tolerance is not None:
        _positive("tolerance", tolerance, zero=True)
        spec.option.tolerance = tolerance
    spec.option.iterations = iterations
    own = _own(spec)
    bits = (1, 1) if chunk_contacts else _bits_without_chunk_pairs(spec)
    shapes = _chunk_shapes(asset, elements, collision, hulls)
    _add_chunks(spec, asset, elements, place, turn / length, shapes, friction, bits)
    _add_slots(spec, slots)
    count = sum(len(sizes) for _, sizes in shapes.values())
    _cap(spec, "max_geom_pairs", max_pairs or max(64, 2 * count))
    _cap(spec, "max_contact_points", max_contacts or 16 * (slots + 1))
    compiled = spec.compile()
    _check_own(compiled, own)
    # MJX would factor the inertia a second time at each step to damp nothing.
    if not compiled.dof_damping.any():
        for each in (compiled, own):
            each.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)

    device = mjx.put_model(compiled, impl="jax")
    dtype = device.qpos0.dtype
    addresses = _host(compiled, engine.own(own), slots, elements)
    table = None
    if hulls is not None:
        table, reach = tables.of_geoms(compiled, addresses.geom_element, asset, hulls)
        device = device.replace(geom_rbound=jnp.asarray(reach, dtype))
    if meshes is not None or hulls is not None:
        solids = tables.solids(asset, elements, meshes, hulls)
        drawn = tables.with_meshes(spec, solids)
        drawn.opt.disableflags = compiled.opt.disableflags
        addresses = dataclasses.replace(addresses, model=drawn)

    def cast(x: Any) -> jax.Array:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return Scene(
        asset=jax.tree.map(cast, asset),
        model=device,
        position=cast(place),
        quaternion=cast(turn / length),
        density=cast(weight),
        hulls=jax.tree.map(cast, table),
        resting=jax.tree.map(cast, resting),
        host=addresses,
        line_search=line_search,
    )


def _hulls(asset: Asset | Destructible, hulls: Hulls | None) -> Hulls:
    if hulls is None:
        if isinstance(asset, Destructible):
            return fit(asset)
        raise ValueError(
            "collision is 'hull', and an asset alone has no shapes: pass a "
            "Destructible, or hulls"
        )
    asset = asset.asset if isinstance(asset, Destructible) else asset
    chunk = np.asarray(asset.element_chunk)
    bare = np.setdiff1d(chunk[chunk >= 0], hulls.chunk)
    if bare.size:
        raise ValueError(f"chunk {bare[0]} has no hull; fit hulls to this asset")
    return hulls


def _vector(name: str, value: Any, size: int) -> np.ndarray:
    vector = np.asarray(value, dtype=float)
    if vector.shape != (size,):
        raise ValueError(f"{name} has shape {vector.shape}; it needs ({size},)")
    if not np.isfinite(vector).all():
        raise ValueError(f"{name} {tuple(vector.tolist())} is not finite")
    return vector


def _positive(name: str, value: float, zero: bool = False) -> None:
    if not np.isfinite(value) or value < 0 or (value == 0 and not zero):
        least = "0 or more" if zero else "above 0"
        raise ValueError(f"{name} is {value}; it must be finite and {least}")


def _density(asset: Asset, density: Any) -> np.ndarray:
    chunks = asset.chunk_volume.shape[0]
    weight = np.asarray(density, dtype=float)
    if weight.shape not in ((), (chunks,)):
        raise ValueError(
            f"density has shape {weight.shape}; give one number or ({chunks},), "
            "one for each chunk"
        )
    bad = np.flatnonzero(~(np.isfinite(weight) & (weight > 0)))
    if bad.size:
        where = f" of chunk {bad[0]}" if weight.ndim else ""
        value = weight.reshape(-1)[bad[0]]
        raise ValueError(f"density{where} is {value} kg/m^3; it must be above 0")
    return weight


def _check_chunks(asset: Asset) -> np.ndarray:
    """Return the elements that have a chunk, once their chunks can move and collide."""
    chunk = np.asarray(asset.element_chunk)
    elements = np.flatnonzero(chunk >= 0)
    if not elements.size:
        raise ValueError("the asset has no chunk; add one at least")
    size = np.asarray(asset.chunk_size)
    volume = np.asarray(asset.chunk_volume)
    center = np.asarray(asset.chunk_centroid)
    inertia = np.asarray(asset.chunk_inertia)
    for element in elements:
        c = int(chunk[element])
        name = f"element {element} (chunk {c})"
        if not np.isfinite(center[c]).all():
            raise ValueError(f"{name} has centroid {center[c].tolist()}; not finite")
        if not (np.isfinite(size[c]).all() and (size[c] > 0).all()):
            raise ValueError(
                f"{name} has half extents {size[c].tolist()}; "
                "a chunk that collides needs all three above 0"
            )
        if not (np.isfinite(volume[c]) and volume[c] > 0):
            raise ValueError(
                f"{name} has volume {volume[c]}; a chunk that moves needs one above 0"
            )
        if not (np.linalg.eigvalsh(inertia[c].astype(float)) > 0).all():
            raise ValueError(
                f"{name} has an inertia that is not positive definite; "
                "use the second moments of its volume"
            )
    return elements


def _spec(model: str | os.PathLike[str] | mujoco.MjSpec | None) -> mujoco.MjSpec:
    if model is None:
        return mujoco.MjSpec.from_string(_DEFAULT_MODEL)
    if isinstance(model, mujoco.MjSpec):
        return model.copy()
    if isinstance(model, str) and "<" in model:
        return mujoco.MjSpec.from_string(model)
    if not os.path.exists(model):
        raise ValueError(f"model {os.fspath(model)!r} is neither MJCF nor a file")
    return mujoco.MjSpec.from_file(os.fspath(model))


def _check_model(spec: mujoco.MjSpec) -> None:
    if spec.option.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        raise ValueError(
            "the model asks for elliptic friction cones; set <option cone='pyramidal'/>"
        )
    known = (
        mujoco.mjtIntegrator.mjINT_EULER,
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    )
    if spec.option.integrator not in known:
        raise ValueError(
            "the model asks for an integrator other than Euler and implicitfast; "
            "set <option integrator='Euler'/>"
        )
    taken = [b.name for b in spec.bodies if b.name.startswith(("chunk", "slot"))]
    numbered = [n for n in taken if n.lstrip("chunkslot").isdigit()]
    if numbered:
        raise ValueError(
            f"the model has a body {numbered[0]!r}; names of that form are taken by "
            "the breakable: rename it"
        )


def _bits_without_chunk_pairs(spec: mujoco.MjSpec) -> tuple[int, int]:
    """Return contype and conaffinity that meet the user's geoms but not each other."""
    geoms = [g for g in spec.geoms if (g.contype | g.conaffinity) & 1]
    if all(g.contype & 1 for g in geoms):
        return 0, 1
    if all(g.conaffinity & 1 for g in geoms):
        return 1, 0
    one = next(g for g in geoms if not g.contype & 1)
    raise ValueError(
        f"geom {one.name!r} has contype {one.contype} and others have conaffinity "
        "without bit 1: chunks cannot meet both and not each other; give all geoms "
        "that chunks may touch contype 1, or allow chunk_contacts"
    )


def _chunk_shapes(
    asset: Asset, elements: np.ndarray, collision: str, hulls: Hulls | None
) -> dict[int, tuple[int, np.ndarray]]:
    """Return type and sizes (geoms, 3) of each element's geoms, as MJX sees them."""
    chunk = np.asarray(asset.element_chunk)
    size = np.asarray(asset.chunk_size, dtype=float)
    box, sphere = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
    if hulls is not None:
        reach = np.abs(hulls.vertices).max(axis=1)
        return {e: (box, reach[hulls.chunk == chunk[e]]) for e in elements}
    if collision == SPHERE:
        return {e: (sphere, np.full((1, 3), size[chunk[e]].min())) for e in elements}
    return {e: (box, size[chunk[e]][None]) for e in elements}


def _add_chunks(
    spec: mujoco.MjSpec,
    asset: Asset,
    elements: np.ndarray,
    place: np.ndarray,
    turn: np.ndarray,
    shapes: dict[int, tuple[int, np.ndarray]],
    friction: float,
    bits: tuple[int, int],
) -> None:
    center = np.asarray(asset.chunk_centroid, dtype=float)
    center = center[np.asarray(asset.element_chunk)]
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, turn)
    for element in elements:
        body = spec.worldbody.add_body(
            name=f"chunk{element}",
            mocap=True,
            pos=place + matrix.reshape(3, 3) @ center[element],
            quat=turn,
        )
        kind, sizes = shapes[element]
        for i, size in enumerate(sizes):
            body.add_geom(
                name=f"chunk{element}" + (f".{i}" if i else ""),
                type=kind,
                size=size,
                friction=[friction, 0.005, 0.0001],
                contype=bits[0],
                conaffinity=bits[1],
                condim=3,
            )


def _add_slots(spec: mujoco.MjSpec, slots: int) -> None:
    for k in range(slots):
        body = spec.worldbody.add_body(
            name=f"slot{k}",
            mass=1.0,
            inertia=[1.0, 1.0, 1.0],
            ipos=[0.0, 0.0, 0.0],
            explicitinertial=True,
        )
        body.add_freejoint(name=f"slot{k}")


def _cap(spec: mujoco.MjSpec, name: str, value: int) -> None:
    # MJX sizes its data by the same two numbers, so they must stand in the model.
    mine = [n for n in spec.numerics if n.name == name]
    if mine:
        mine[0].data = [value]
    else:
        spec.add_numeric(name=name, data=[value])


def _own(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile the user's model before anything is added to it."""
    # A copy leaves out what names bodies to come, silently, but for cameras.
    spec = spec.copy()
    for camera in spec.cameras:
        spec.delete(camera)
    return spec.compile()


def _check_own(model: mujoco.MjModel, own: mujoco.MjModel) -> None:
    """Refuse what binds the user's bodies to the breakable: no step would see it."""
    for name, what in (
        ("neq", "an equality constraint"),
        ("ntendon", "a tendon"),
        ("nu", "an actuator"),
    ):
        if getattr(own, name) != getattr(model, name):
            raise ValueError(
                f"{what} of the model is on a chunk or a slot; of all that is in it, "
                "only sensors, cameras and contacts may name them"
            )


def _host(
    model: mujoco.MjModel, own: engine.Own, slots: int, elements: np.ndarray
) -> Host:
    def body(name: str) -> int:
        return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)

    slot_body = np.array([body(f"slot{k}") for k in range(slots)])
    joint = model.body_jntadr[slot_body]
    chunk_body = np.array([body(f"chunk{e}") for e in elements])
    body_element = np.full(model.nbody, -1)
    body_element[chunk_body] = elements
    geom_element = body_element[model.geom_bodyid]
    pairs = engine.geom_pairs(model)
    weld = model.body_weldid[model.geom_bodyid]
    return Host(
        model=model,
        own=own,
        slot_body=slot_body,
        slot_qpos=model.jnt_qposadr[joint][:, None] + np.arange(7),
        slot_dof=model.jnt_dofadr[joint][:, None] + np.arange(6),
        mocap=model.body_mocapid[chunk_body],
        element=elements,
        geom_element=geom_element,
        geom_weld=weld,
        chunk_sides=tuple(
            side for side in (0, 1) if (geom_element[pairs[:, side]] >= 0).any()
        ),
        chunk_kinds=frozenset(
            (int(model.geom_type[a]), int(model.geom_type[b]))
            for a, b in pairs[(geom_element[pairs] >= 0).all(axis=1)]
        ),
        user_meets=bool(((geom_element[pairs] < 0) & (weld[pairs] > 0)).any()),
    )
