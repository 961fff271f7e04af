"""Materials: what a square metre of bond bears, and how heavy a piece is.

Area is geometry, strength is material. With bond healths that are areas, limits in
pascal break bonds where stress in pascal says so:

    state = fracture.init(asset, materials.area_health(asset))
    limits = stress.Limits(**materials.limits(materials.GLASS))

The presets are typical values of published ranges; strengths of brittle materials vary
from piece to piece by a half and more, and with size, rate and surface.
"""

import dataclasses

import jax
import jax.numpy as jnp

from blastjax.core import Asset


@dataclasses.dataclass(frozen=True)
class Material:
    """A material, at room temperature and slow loading unless it says otherwise."""

    name: str
    density: float
    """kg/m^3."""
    youngs_modulus: float
    """Pa."""
    compression: float
    """Strength under pressure, Pa."""
    tension: float
    """Strength under pull, Pa."""
    shear: float
    """Strength across, Pa."""
    source: str
    """Where the values come from."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, (int, float)) and not 0 < value < float("inf"):
                raise ValueError(
                    f"{self.name}: {field.name} is {value}; it must be above 0"
                )


GLASS = Material(
    "soda-lime glass, annealed",
    density=2500.0,
    youngs_modulus=70e9,
    compression=800e6,
    tension=45e6,
    shear=35e6,
    source="EN 572-1:2012 (density, modulus, characteristic bending strength 45 MPa); "
    "compression: order of magnitude given by glass makers; shear: estimate",
)
CONCRETE = Material(
    "concrete C25/30",
    density=2400.0,
    youngs_modulus=31e9,
    compression=33e6,
    tension=2.6e6,
    shear=4e6,
    source="EN 1992-1-1:2004 table 3.1 (f_cm, f_ctm, E_cm of C25/30); "
    "shear: cohesion without pressure, estimate between tension and compression",
)
BRICK_AND_MORTAR = Material(
    "clay brick in general purpose mortar: the joint",
    density=1800.0,
    youngs_modulus=5e9,
    compression=5e6,
    tension=0.1e6,
    shear=0.2e6,
    source="EN 1996-1-1:2005 section 3.6 (initial shear strength 0.2 MPa of clay units "
    "in M2.5-M9 mortar, bending across bed joints 0.1 MPa; "
    "compression and modulus of 1000 f_k: mid range)",
)
WOOD = Material(
    "spruce C24, along the grain",
    density=420.0,
    youngs_modulus=11e9,
    compression=21e6,
    tension=14.5e6,
    shear=4e6,
    source="EN 338:2016 strength class C24 (characteristic values, mean density)",
)
ICE = Material(
    "fresh-water ice, -10 degrees Celsius",
    density=917.0,
    youngs_modulus=9.3e9,
    compression=10e6,
    tension=1.4e6,
    shear=1e6,
    source="Petrovic 2003, J. Materials Science 38 (mean tension 1.43 MPa, "
    "compression 5-25 MPa); Schulson 1999, JOM 51, 21-27; shear: estimate",
)
CERAMIC = Material(
    "alumina, 99.5 per cent",
    density=3900.0,
    youngs_modulus=370e9,
    compression=2600e6,
    tension=260e6,
    shear=330e6,
    source="data sheets of alumina makers (for instance CoorsTek AD-995); "
    "shear: estimate",
)
PRESETS = {
    "glass": GLASS,
    "concrete": CONCRETE,
    "brick_and_mortar": BRICK_AND_MORTAR,
    "wood": WOOD,
    "ice": ICE,
    "ceramic": CERAMIC,
}
"""All of them, by name."""


def area_health(asset: Asset) -> jax.Array:
    """Return healths that are the bonds' areas, (B,) m^2, as stress wants them."""
    return asset.bond_area


def force_health(
    asset: Asset, material: Material, *, mode: str = "tension"
) -> jax.Array:
    """Return the force that breaks each bond, (B,) N, as its health.

    For damage that is a force: what pulls, presses or shears a bond.

    Args:
      asset: the asset.
      material: its material.
      mode: the strength that counts, "tension", "compression" or "shear".

    Raises:
      ValueError: there is no such strength.
    """
    if mode not in ("tension", "compression", "shear"):
        raise ValueError(f"mode is {mode!r}; use 'tension', 'compression' or 'shear'")
    strength = jnp.asarray(getattr(material, mode), asset.bond_area.dtype)
    return asset.bond_area * strength


def limits(material: Material, *, elastic: float = 0.9) -> dict[str, float]:
    """Return the fields of `stress.Limits`, Pa.

    Args:
      material: the material; its strengths are the fatal limits.
      elastic: part of the strength from which bonds take damage, above 0 to 1.

    Raises:
      ValueError: the part is out of range.
    """
    if not 0 < elastic <= 1:
        raise ValueError(f"elastic is {elastic}; it must be above 0 and at most 1")
    found = {}
    for mode in ("compression", "tension", "shear"):
        strength = getattr(material, mode)
        found[f"{mode}_elastic"] = elastic * strength
        found[f"{mode}_fatal"] = strength
    return found
