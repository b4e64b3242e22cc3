"""What is known of each query, and the motion of its own patch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from quest.filter.appearance import PATCH_PX
from quest.filter.landmarks import SURE
from quest.filter.layers import GATE, Layers, with_column
from quest.filter.noise import Noise
from quest.filter.patches import GRID_PX, look, patch_motion, tile_motion, tiles
from quest.filter.picture import GreyPicture, Picture
from quest.filter.ray import ALONG_M, depths_told, most_probable
from quest.filter.surfaces import depth_error
from quest.filter.view import View, move

READINGS = (
    "lost", "seen", "rival", "unseen s", "elsewhere", "covered", "own variance", "own found", "rides", "rides on world",
    "own apart", "spread", "margin", "looks", "anchor cosine", "newest cosine", "anchor correlation",
    "newest correlation", "anchor elsewhere", "tile of own patch", "tile", "turn", "distance", "roll", "went",
    "off named", "depth off", "body seen s", "body error", "screw", "off screw", "share",
)  # fmt: skip
"""Names of what tells whether a query is lost (:mod:`quest.filter.readings`), in their order."""


@dataclass(frozen=True)
class Queries:
    """K queries, and B bodies that may carry them."""

    anchor: UInt8[np.ndarray, "K S S"]
    """What was around it when it was named."""
    descriptor: Float[np.ndarray, "K 2 D"]
    """Of the anchor, and of the newest view in which depth confirmed that it is seen where it rides."""
    patch: Float[np.ndarray, "K 2 P P"]
    """Grey values, likewise."""
    own_px: Float[np.ndarray, "K 2"]
    """Where its own patch went."""
    own_variance: Float[np.ndarray, " K"]
    """Pixels squared."""
    own_depth: Float[np.ndarray, " K"]
    """Its depth when it was seen last, metres; NaN if it never was."""
    own_found: Bool[np.ndarray, " K"]
    """Whether that patch was found in this frame, with nothing in front of it."""
    place: Float[np.ndarray, "K B 3"]
    """On each body, metres; NaN without depth."""
    named_place: Float[np.ndarray, "K B 3"]
    """The same as it was named, however often it was told anew since."""
    error: Float[np.ndarray, "K 3"]
    """Standard deviation of the place, along the ray on which it was seen, metres in the world; NaN without depth."""
    told_along: Float[np.ndarray, "K R"]
    """Log-likelihood, by the depths since, of each place along that ray (:data:`quest.filter.ray.ALONG_M`)."""
    along_m: Float[np.ndarray, " K"]
    """How far along it the place is, metres."""
    camera: Float[np.ndarray, "K B 4 4"]
    """Pose of the camera in which it was named, on each body (``cam_from_body``)."""
    anew: Bool[np.ndarray, " K"]
    """Whether the place was told anew since it was first known: how it came there is not known."""
    log_odds: Float[np.ndarray, "K B"]
    """That each body carries it, against that it goes with its patch."""
    seen_log_odds: Float[np.ndarray, " K"]
    """That it is seen where it is followed."""
    lost_log_odds: Float[np.ndarray, " K"]
    """That it is not there."""
    unseen_s: Float[np.ndarray, " K"]
    """For how long it was not seen there, and nothing explains why, seconds."""
    seen_place: Float[np.ndarray, "K L 2"]
    """Where it was seen last, on each layer of pictures without depth; NaN with depth."""
    seen_share: Float[np.ndarray, "K L"]
    """Share of each layer around there."""
    rival_px: Float[np.ndarray, "K 2"]
    """The most probable place elsewhere."""
    rival_log_odds: Float[np.ndarray, " K"]
    """That it is there."""
    readings: Float[np.ndarray, "K N"]
    """What tells in this frame whether it is lost (:data:`READINGS`); NaN where nothing does."""

    @classmethod
    def named(
        cls,
        picture: Picture,
        uv_px: Float[np.ndarray, "K 2"],
        depth_m: Float[np.ndarray, " K"],
        place: Float[np.ndarray, "K B 3"],
        error: Float[np.ndarray, "K 3"],
        layers: Layers | None,
        camera: Float[np.ndarray, "B 4 4"],
    ) -> Queries:
        """Pixels of a frame that are named in it."""
        count, bodies = place.shape[:2]
        seen_place, seen_share = _on(layers, uv_px)
        return cls(
            anchor=tiles(picture, uv_px),
            descriptor=picture.describe(uv_px)[:, None].repeat(2, axis=1),
            patch=picture.patches(uv_px, PATCH_PX)[:, None].repeat(2, axis=1),
            own_px=uv_px,
            own_variance=np.full(count, 0.5),
            own_depth=depth_m,
            own_found=np.ones(count, dtype=bool),
            place=place,
            named_place=place,
            error=error,
            told_along=np.zeros((count, len(ALONG_M))),
            along_m=np.zeros(count),
            camera=np.repeat(camera[None], count, axis=0),
            anew=np.zeros(count, dtype=bool),
            log_odds=np.zeros((count, bodies)),
            seen_log_odds=np.full(count, SURE),
            lost_log_odds=np.full(count, -SURE),
            unseen_s=np.zeros(count),
            seen_place=seen_place,
            seen_share=seen_share,
            rival_px=uv_px,
            rival_log_odds=np.full(count, -SURE),
            readings=np.full((count, len(READINGS)), np.nan),
        )

    def __len__(self) -> int:
        return len(self.anchor)

    def only(self, rows: Int[np.ndarray, " M"]) -> Queries:
        """Some of them."""
        return Queries(**{name: value[rows] for name, value in vars(self).items()})

    def join(self, other: Queries) -> Queries:
        """These and others."""
        return Queries(**{name: np.concatenate([value, getattr(other, name)]) for name, value in vars(self).items()})

    def there(self, row: int) -> Queries:
        """The same, where one of them is where it is followed without doubt."""
        at = np.arange(len(self)) == row
        return replace(
            self,
            named_place=np.where(at[:, None, None], self.place, self.named_place),
            lost_log_odds=np.where(at, -SURE, self.lost_log_odds),
            unseen_s=np.where(at, 0.0, self.unseen_s),
            rival_log_odds=np.where(at, -SURE, self.rival_log_odds),
            readings=np.where(at[:, None], np.nan, self.readings),
        )

    def seen_at(self, uv_px: Float[np.ndarray, "K 2"], which: Bool[np.ndarray, " K"], layers: Layers) -> Queries:
        """Some of them are seen at some pixels."""
        place, share = _on(layers, uv_px)
        return replace(
            self,
            seen_place=np.where(which[:, None, None], place, self.seen_place),
            seen_share=np.where(which[:, None], share, self.seen_share),
        )

    def deeper(
        self,
        body: Int[np.ndarray, " K"],
        depth_m: Float[np.ndarray, " K"],
        measured_m: Float[np.ndarray, " K"],
        seen: Float[np.ndarray, " K"],
        elsewhere: Float[np.ndarray, " K"],
        new: float,
        pose: Float[np.ndarray, "B 4 4"],
        view: View,
        noise: Noise,
    ) -> Queries:
        """With their places along their rays by one depth more, measured where a body brings them.

        ``seen`` and ``elsewhere`` are log-odds, as of :func:`quest.filter.ray.depths_told`, and ``new`` is how much of
        it is new evidence, 0 to 1.
        """
        ray = self.error / np.linalg.norm(self.error, axis=-1, keepdims=True)
        ahead = np.einsum("j,kji,ki->k", view.cam_from_world[2, :3], pose[body, :3, :3], ray)
        told = depths_told(depth_m, ahead, self.along_m, measured_m, seen, elsewhere, noise)
        sure = np.isfinite(told).all(axis=1) & np.isfinite(measured_m)
        told_along = self.told_along + np.where(sure[:, None], new * told, 0.0)
        told_along -= told_along.max(axis=1, keepdims=True)
        along_m = np.where(sure, most_probable(told_along, noise), self.along_m)
        shift = np.where(sure[:, None], (along_m - self.along_m)[:, None] * ray, 0.0)
        return replace(self, told_along=told_along, along_m=along_m, place=self.place + shift[:, None])

    @property
    def known(self) -> Bool[np.ndarray, " K"]:
        """Whether its place is."""
        return np.asarray(np.isfinite(self.place[:, 0]).all(axis=-1))

    @property
    def body(self) -> Int[np.ndarray, " K"]:
        """The most probable carrier."""
        return np.asarray(self.log_odds.argmax(axis=1))

    @property
    def rides(self) -> Bool[np.ndarray, " K"]:
        """Whether it is more probable that a body carries it than that it goes with its patch."""
        return (self.log_odds.max(axis=1) > 0) & self.known

    @property
    def rest(self) -> Float[np.ndarray, "K 3"]:
        """Where each was before its most probable body moved, metres."""
        return self.place[np.arange(len(self.body)), self.body]

    def point_world(self, pose: Float[np.ndarray, "B 4 4"]) -> Float[np.ndarray, "K 3"]:
        """Where each is on its most probable body."""
        return move(pose[self.body], self.rest)

    def meet(self, bodies: int, layers: Layers | None) -> Queries:
        """A body, or layer, that begins to move was part of the world: what rested there may ride on it."""
        new = bodies - self.place.shape[1]
        place, share = (self.seen_place, self.seen_share) if layers is not None else _on(None, self.own_px)
        if layers is not None and layers.new is not None:
            place = with_column(place, layers.new, place[:, 0])
            share = with_column(share, layers.new, np.zeros(len(self)))
        return replace(
            self,
            seen_place=place,
            seen_share=share,
            **{
                name: np.concatenate([on := getattr(self, name), np.repeat(on[:, :1], new, axis=1)], axis=1)
                for name in ("place", "named_place", "camera", "log_odds")
            },
        )


def _on(
    layers: Layers | None, uv_px: Float[np.ndarray, "K 2"]
) -> tuple[Float[np.ndarray, "K L 2"], Float[np.ndarray, "K L"]]:
    """Places of some pixels on each layer, and the share of each around them; of no layer with depth."""
    if layers is None:
        return np.full((len(uv_px), 1, 2), np.nan), np.zeros((len(uv_px), 1))
    return layers.onto(uv_px), layers.share(uv_px)


def follow_patches(
    queries: Queries,
    previous: GreyPicture,
    picture: GreyPicture,
    expected_px: Float[np.ndarray, "K 2"],
    old: View,
    view: View,
    dt_s: float,
    noise: Noise,
) -> Queries:
    """Where each query's own patch went: its motion since the previous frame, then the anchor's patch around there.

    A Kalman filter: what is followed from frame to frame gathers variance, what the anchor finds takes it away.
    """
    motion = patch_motion(previous, picture, queries.own_px, expected_px, _of_surface(queries, old, noise))
    depth_m = view.near_depth_at(queries.own_px + motion.step_px)
    # Nothing comes nearer at once: what does is in front of it.
    near_m = queries.own_depth - depth_m - noise.speed_m_s * dt_s
    found = np.isfinite(motion.variance) & ~(near_m > 3 * depth_error(queries.own_depth, noise))
    own_px = np.where(found[:, None], queries.own_px + motion.step_px, expected_px)
    gathered = np.where(found, np.where(found, motion.variance, 0) + noise.chain_px2_s * dt_s, noise.blind_px2_s * dt_s)
    variance = queries.own_variance + gathered
    anchored = tile_motion(queries.anchor, picture, own_px)
    at_px = own_px + anchored.step_px
    total = variance + noise.anchor_px**2
    alike = (look(tiles(picture, at_px)) * look(queries.anchor)).sum(axis=1)
    seen = found & np.isfinite(anchored.variance) & (alike > noise.like_anchor)
    seen &= ((at_px - own_px) ** 2).sum(axis=-1) < GATE * total
    gain = np.where(seen, variance / total, 0.0)
    return replace(
        queries,
        own_px=own_px + gain[:, None] * (at_px - own_px),
        own_variance=(1 - gain) * variance,
        own_depth=np.where(found & np.isfinite(depth_m), depth_m, queries.own_depth),
        own_found=found,
    )


def _of_surface(queries: Queries, view: View, noise: Noise) -> Float[np.ndarray, "K P"]:
    """How far the points of each patch are on the surface that is followed: as deep as it, or of unknown depth."""
    grid = (queries.own_px[:, None] + GRID_PX).reshape(-1, 2)
    depth_m = view.depth_at(grid)[0].reshape(len(queries), -1)
    off = (depth_m - queries.own_depth[:, None]) / (noise.relief_m + depth_error(queries.own_depth, noise)[:, None])
    return np.where(np.isfinite(off), np.exp(-(off**2) / 2), 1.0)
