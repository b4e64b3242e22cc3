"""What no ordinary take has: light that changes, odd materials, a camera that is hit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from quest.sim.appearance import Appearance, Distractor, ObjectLook
from quest.sim.motion import HOLD_FRAMES
from quest.sim.surfaces import Surface, triple
from quest.sim.textures import Texture, TextureKind

Disturbance = Literal["none", "light", "texture", "bump"]
DISTURBANCES: tuple[Disturbance, ...] = get_args(Disturbance)

_FADE_FRAMES = (1, 12)
_AMBIENT = (0.35, 1.8)
_LAMPS = (0.15, 1.6)
_ODD_KINDS: tuple[TextureKind, ...] = ("checker", "stripes", "tiles", "speckle", "noise")


def disturbed_at(frames: int, rng: np.random.Generator) -> int:
    """A frame in the middle of a script, after its hold, at which something happens."""
    return max(HOLD_FRAMES, int(frames * rng.uniform(0.25, 0.65)))


@dataclass(frozen=True)
class LightChange:
    """Lamps and daylight that change their strength and colour once, within a few frames; a prop.

    Attributes:
        ambient: factors of the light from everywhere, linear red, green, blue, at every frame of the script.
        lamps: factors of all other lights likewise.
    """

    ambient: Float[np.ndarray, "S 3"]
    lamps: Float[np.ndarray, "S 3"]

    def add(self, scene: Any) -> Any:
        """Finds the lights of a ``sapien.Scene``; returns them with their colours, and the scene."""
        import sapien

        found = [c for entity in scene.entities for c in entity.components]
        lamps = [c for c in found if isinstance(c, sapien.render.RenderLightComponent)]
        return scene, np.asarray(scene.ambient_light), [(lamp, np.asarray(lamp.color)) for lamp in lamps]

    def place(self, actors: Any, frame: int) -> None:
        """Light as it is at a frame of the script."""
        scene, ambient, lamps = actors
        scene.set_ambient_light((ambient * self.ambient[frame]).tolist())
        for lamp, colour in lamps:
            lamp.set_color((colour * self.lamps[frame]).tolist())

    def pose(self, frame: int) -> Float[np.ndarray, "2 3"]:
        """The factors at a frame."""
        return np.stack((self.ambient[frame], self.lamps[frame]))


def change_light(frames: int, rng: np.random.Generator) -> LightChange:
    """Draw how the light changes in a script of some frames: a lamp goes out, a blind opens, the white shifts."""
    start, fade = disturbed_at(frames, rng), int(rng.integers(_FADE_FRAMES[0], _FADE_FRAMES[1] + 1))
    share = np.clip((np.arange(frames) - start + 1) / fade, 0.0, 1.0)[:, None]
    factors = []
    for low, high in (_AMBIENT, _LAMPS):
        # Away from 1, either darker or brighter, so that every take of this kind does change.
        strength = rng.uniform(low, 0.6) if rng.random() < 0.6 else rng.uniform(1.35, high)
        tint = np.exp(rng.normal(0.0, 0.15, 3))
        factors.append(1 + share * (strength * tint / tint.mean() - 1))
    return LightChange(*factors)


def odd_appearance(appearance: Appearance, rng: np.random.Generator) -> Appearance:
    """The same scene in materials that no room has: strong colours, coarse patterns, on everything, the object too."""
    distractors: tuple[Distractor, ...] = tuple(replace(d, surface=_odd(rng)) for d in appearance.distractors)
    look = ObjectLook(True, tuple(_odd(rng) for _ in range(3)), _odd(rng), bool(rng.random() < 0.5), 0)
    wall = None if appearance.wall is None else _odd(rng)
    return replace(appearance, floor=_odd(rng), wall=wall, distractors=distractors, look=look)


def _odd(rng: np.random.Generator) -> Surface:
    first = triple(rng.uniform(0.0, 1.0, 3) ** 0.5)
    second = triple(rng.uniform(0.0, 1.0, 3) ** 2)
    kind = _ODD_KINDS[int(rng.integers(len(_ODD_KINDS)))]
    texture = Texture(kind, first, second, int(rng.integers(1, 5)), int(rng.integers(2**31)))
    return Surface(first, float(rng.uniform(0.2, 1.0)), 0.0, float(rng.uniform(0.0, 0.6)), texture)
