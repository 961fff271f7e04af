"""Noise that roughens cut faces: a smooth random displacement of space."""

import dataclasses

import numpy as np

WAVES = 16
"""Plane waves in an octave."""
STEPS = 4
"""Vertices in the shortest wavelength."""
MAX_STRAIN = 0.9
"""Above a strain of 1 the displacement could fold space onto itself."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Displacement by octaves of random plane waves, each half as strong and long.

    Because it moves space itself, pieces on both sides of a cut still fit.
    """

    amplitude: float
    """Greatest displacement, m."""
    wavelength: float
    """Of the first octave, m."""
    octaves: int = 1
    """How many octaves."""
    seed: int = 0
    """Of the waves."""

    def __post_init__(self) -> None:
        if not (self.amplitude > 0 and self.wavelength > 0 and self.octaves >= 1):
            raise ValueError(
                f"noise {self} needs an amplitude and a wavelength above 0, in m, and "
                "at least one octave"
            )
        strain = 2 * np.pi * self.amplitude * self.octaves / self.wavelength
        strain /= 2 - 0.5 ** (self.octaves - 1)
        if not strain < MAX_STRAIN:
            raise ValueError(
                f"noise of amplitude {self.amplitude} m at wavelength "
                f"{self.wavelength} m in {self.octaves} octaves may fold the cut onto "
                f"itself; an amplitude up to {self.amplitude * MAX_STRAIN / strain:.3g}"
                " m is safe"
            )

    @property
    def step(self) -> float:
        """Longest edge of a rough face, m."""
        return self.wavelength / 2 ** (self.octaves - 1) / STEPS

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the displacement of points (P, 3), m."""
        rng = np.random.default_rng(self.seed)
        total = np.zeros_like(points)
        for octave in range(self.octaves):
            wave, way = (
                x / np.linalg.norm(x, axis=1, keepdims=True)
                for x in rng.normal(size=(2, WAVES, 3))
            )
            phase = rng.uniform(0, 2 * np.pi, WAVES)
            turns = points @ wave.T * (2 * np.pi * 2**octave / self.wavelength)
            total += np.cos(turns + phase) @ way / (WAVES * 2**octave)
        return total * (self.amplitude / (2 - 0.5 ** (self.octaves - 1)))
