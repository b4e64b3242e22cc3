"""The posterior of each query: which body carries it, whether it is seen there, and whether it is elsewhere.

Its places are where its own patch went, where each body brings it, and the places of the whole frame that are most
like its anchor. At each it is *seen*, as appearance and depth say, or *occluded*; or it is at none of them. What is
carried is told by how far the places are apart, by their evidence, and by what carries the points around.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from quest.filter.appearance import CELL_REACH_PX, PATCH_PX, Likeness, Places
from quest.filter.landmarks import SURE, Landmarks, ray_error
from quest.filter.layers import GATE, Layers
from quest.filter.noise import Noise
from quest.filter.picture import Picture
from quest.filter.queries import Queries
from quest.filter.readings import Weighed, read
from quest.filter.surfaces import depth_error, in_front, occluded_ratio, seen_ratio
from quest.filter.view import View, in_image, move, move_back

RIVALS = 3
"""Places elsewhere that are weighed."""
_SAME_PX = 24.0
"""Places nearer to each other than this are said to be one."""
_OCCUPIED_PX = 12.0
"""Within which of another query's place there is no room for one more."""
_TOGETHER_PX = 2.0
"""How far apart its own patch and its body's place are where both saw the same view of it."""
_CARRIES_AT_LEAST = np.array([0.1, 1e-3])
"""How probable it is that the world, or that any one of the others, carries what nothing around it is on."""
_HALF, _HARDLY = 0.5, 0.05
_MOST, _IMPOSSIBLE = 9.0, 20.0
"""Log-odds are kept within this."""


@dataclass(frozen=True)
class _Places:
    """P places where each of K queries may be: its own patch first, then where each of B = P - 1 bodies brings it."""

    uv_px: Float[np.ndarray, "K P 2"]
    depth_m: Float[np.ndarray, "K B"]
    ride_px2: Float[np.ndarray, "K B"]
    """Variance of where each body brings it, pixels squared."""
    possible: Bool[np.ndarray, "K B"]
    """Whether a body can bring it anywhere: its place is known, and in front of the camera."""
    looks: Float[np.ndarray, "K P"]
    """Log-likelihood ratio of the appearance there if it is seen there, against it being nowhere."""
    seen: Float[np.ndarray, "K P"]
    """The same of all evidence."""
    occluded: Float[np.ndarray, "K P"]
    """The same if it is there and not seen, which is as probable before anything is measured."""
    covered: Float[np.ndarray, "K P"]
    """How probable it is that something is in front of that place, or that it is out of view."""
    agrees: Bool[np.ndarray, "K P"]
    """Whether the depth is as predicted."""


def weigh(
    queries: Queries,
    landmarks: Landmarks,
    layers: Layers | None,
    picture: Picture,
    view: View,
    dt_s: float,
    noise: Noise,
) -> Queries:
    """Which hypotheses explain the frame; what is out of question begins anew at the best.

    The queries' own patches are followed into the frame already.
    """
    likeness = Likeness.of(picture, queries.descriptor, queries.patch)
    places = _places(queries, landmarks, likeness, view, dt_s, noise)
    apart = ((queries.own_px[:, None] - places.uv_px[:, 1:]) ** 2).sum(axis=-1)
    near = queries.own_variance[:, None] + places.ride_px2
    # Evidence repeats itself from frame to frame: however long it lasts, it counts once.
    new = min(dt_s / noise.correlated_s, 1.0)
    told = _carriers(queries, places, apart, near, landmarks, noise) - queries.log_odds
    log_odds = queries.log_odds + np.where(places.possible, told, 0.0) * new
    each, best = np.arange(len(queries)), log_odds.argmax(axis=1)
    rides = (log_odds[each, best] > 0) & queries.known
    here = np.where(rides, best + 1, 0)
    at_px = places.uv_px[each, here]
    judged, left = _judged(queries, places, here, layers, likeness, dt_s, noise)
    ahead_m, ride_px2 = places.depth_m[each, best], places.ride_px2[each, best]
    measured_m = np.where(rides, view.near_depth_at(at_px), np.nan)
    seen, elsewhere = places.looks[each, here] - np.log(_HALF), left - np.log(_HALF)  # against being there occluded
    judged = judged.deeper(best, ahead_m, measured_m, seen, elsewhere, new, landmarks.pose, view, noise)

    jumps = judged.rival_log_odds > 0
    far_off = (log_odds[each, best] > SURE) & (apart[each, best] > GATE * near[each, best])
    caught = rides & places.possible[each, best] & (~queries.own_found | far_off) & ~jumps
    own_px = np.where(jumps[:, None], judged.rival_px, np.where(caught[:, None], at_px, queries.own_px))
    depth_m = view.near_depth_at(own_px)
    left_all = (~queries.known | (log_odds[each, best] < -SURE)) & queries.own_found
    anew = (jumps | left_all) & np.isfinite(depth_m)
    point = np.repeat(view.lift(own_px, depth_m)[:, None], log_odds.shape[1], axis=1)
    together = queries.own_found & (apart[each, best] < _TOGETHER_PX**2)
    confirmed = rides & together & places.agrees[each, here] & (judged.seen_log_odds > 0)
    if layers is not None:
        last_px = np.where(jumps[:, None], judged.rival_px, at_px)
        judged = judged.seen_at(last_px, jumps | (judged.seen_log_odds > 0), layers)
    judged = replace(judged, anew=queries.anew | (anew & queries.known))
    told = read(judged, _weighed(queries, places, log_odds, here, left), likeness, landmarks, view, noise)
    place = np.where(anew[:, None, None], move_back(landmarks.pose, point), judged.place)
    return replace(
        _viewed(judged, confirmed, at_px, picture),
        readings=np.where((jumps | ~queries.known)[:, None], np.nan, told),
        own_px=own_px,
        own_variance=np.where(jumps, noise.anchor_px**2, np.where(caught, ride_px2, queries.own_variance)),
        own_depth=np.where(jumps, depth_m, np.where(caught, ahead_m, queries.own_depth)),
        place=place,
        named_place=np.where(judged.anew[:, None, None], queries.named_place, place),
        error=np.where(anew[:, None], ray_error(view, own_px, point[:, 0], noise), queries.error),
        told_along=np.where(anew[:, None], 0.0, judged.told_along),
        along_m=np.where(anew, 0.0, judged.along_m),
        log_odds=np.where(anew[:, None], 0.0, np.clip(log_odds, -SURE, SURE)),
        seen_log_odds=np.where(jumps, judged.rival_log_odds, judged.seen_log_odds),
        lost_log_odds=np.where(jumps, -judged.rival_log_odds, judged.lost_log_odds),
        unseen_s=np.where(jumps, 0.0, judged.unseen_s),
        rival_log_odds=np.where(jumps, -SURE, judged.rival_log_odds),
    )


def _weighed(
    queries: Queries,
    places: _Places,
    log_odds: Float[np.ndarray, "K B"],
    here: Int[np.ndarray, " K"],
    left: Float[np.ndarray, " K"],
) -> Weighed:
    """What is read off, of the most probable places."""
    each, rides, body = np.arange(len(queries)), here > 0, np.maximum(here - 1, 0)
    carried = np.where(places.possible, np.clip(log_odds, -SURE, SURE), -_IMPOSSIBLE)
    return Weighed(
        at_px=places.uv_px[each, here],
        place_px=places.uv_px,
        log_odds=np.concatenate([np.zeros((len(queries), 1)), carried], axis=1),
        rides=rides,
        body=body,
        depth_m=np.where(rides, places.depth_m[each, body], queries.own_depth),
        looks=places.looks[each, here],
        covered=places.covered[each, here],
        elsewhere=left,
    )


def _judged(
    queries: Queries,
    places: _Places,
    here: Int[np.ndarray, " K"],
    layers: Layers | None,
    likeness: Likeness,
    dt_s: float,
    noise: Noise,
) -> tuple[Queries, Float[np.ndarray, " K"]]:
    """Whether each query is seen at its most probable place, occluded there, or elsewhere, or nowhere in the frame.

    Also the log-likelihood ratio of the last two against nowhere.
    """
    each = np.arange(len(queries))
    seen, occluded, explained = (value[each, here] for value in (places.seen, places.occluded, places.covered))
    rival_px, rival, others = _elsewhere(queries, places.uv_px[each, here], layers, likeness, noise)
    # What is out of view, or behind something, is still there: then hardly anything speaks for elsewhere.
    elsewhere = np.log(_HARDLY * explained + _HALF * (1 - explained))
    rival, others = (ratio + elsewhere - np.log(_HALF) for ratio in (rival, others))
    with np.errstate(divide="ignore"):
        behind, unexplained = (occluded + np.log(p) for p in (explained, 1 - explained))
    # An occlusion that nothing explains does not last.
    hidden = np.logaddexp(behind, unexplained - queries.unseen_s / noise.hidden_s)
    stays, left = np.logaddexp(seen, hidden), np.logaddexp(np.logaddexp(rival, others), elsewhere)
    same = _same(rival_px, queries.rival_px)
    rival_log_odds = np.where(same, queries.rival_log_odds, noise.jump_log_odds)
    told = rival - np.logaddexp(stays, others) - rival_log_odds
    seen_log_odds = (seen - np.logaddexp(left, occluded)).clip(-_MOST, _MOST)
    new = min(dt_s / noise.correlated_s, 1.0)
    judged = replace(
        queries,
        seen_log_odds=seen_log_odds,
        lost_log_odds=(np.logaddexp(left, unexplained) - np.logaddexp(seen, behind)).clip(-_MOST, _MOST),
        unseen_s=(1 - explained) * (queries.unseen_s + dt_s) / (1 + np.exp(seen_log_odds)) ** new,
        rival_px=rival_px,
        rival_log_odds=rival_log_odds + told * new,
    )
    return judged, left


def _places(
    queries: Queries, landmarks: Landmarks, likeness: Likeness, view: View, dt_s: float, noise: Noise
) -> _Places:
    """What appearance and depth say at each place."""
    count, bodies = queries.log_odds.shape
    point = move(landmarks.pose, queries.place)
    ride_px, depth_m = (each.reshape(count, bodies, *each.shape[1:]) for each in view.project(point.reshape(-1, 3)))
    possible = np.asarray(np.isfinite(ride_px).all(axis=-1))
    ride_px = np.where(possible[..., None], ride_px, queries.own_px[:, None])
    uv_px = np.concatenate([queries.own_px[:, None], ride_px], axis=1)
    inside = in_image(uv_px, likeness.picture.size)
    off_m = view.near_depth_at(ride_px.reshape(-1, 2)).reshape(count, bodies) - depth_m
    # Of its own patch nothing is predicted but that it does not come nearer at once: what does is in front of it.
    own_off_m = view.near_depth_at(queries.own_px) - queries.own_depth + noise.speed_m_s * dt_s
    depth_m = np.concatenate([queries.own_depth[:, None], depth_m], axis=1)
    spread_m = depth_error(depth_m, noise)
    own_off_m = np.where(own_off_m < -3 * spread_m[:, 0], own_off_m, np.nan)
    off_m = np.concatenate([own_off_m[:, None], off_m], axis=1)
    looks = np.where(inside, likeness.at(uv_px, noise).log_odds, -np.inf)
    return _Places(
        uv_px=uv_px,
        depth_m=depth_m[:, 1:],
        ride_px2=np.nan_to_num(landmarks.ride_px2(queries.place, queries.error, view), nan=1.0),
        possible=possible,
        looks=looks,
        seen=looks + seen_ratio(off_m, spread_m, noise),
        occluded=occluded_ratio(off_m, spread_m, noise) + np.log(_HALF),
        covered=np.where(inside, in_front(off_m, spread_m, noise), 1.0),
        agrees=abs(off_m) < spread_m,
    )


def _carriers(
    queries: Queries,
    places: _Places,
    apart: Float[np.ndarray, "K B"],
    near: Float[np.ndarray, "K B"],
    landmarks: Landmarks,
    noise: Noise,
) -> Float[np.ndarray, "K B"]:
    """Log-odds of this frame that each body carries it, against that it goes with its patch."""
    far = near + noise.moved_px**2
    parted = apart / 2 * (1 / far - 1 / near) + np.log(far / near)
    # Its patch may have slipped off it, to anywhere.
    parted = np.logaddexp(np.log(1 - noise.stray) + parted, np.log(noise.stray))
    there = np.logaddexp(places.seen, places.occluded)
    share = landmarks.share(queries.rest, landmarks.rest)
    around = np.log(share + _CARRIES_AT_LEAST[np.minimum(np.arange(share.shape[1]), 1)])
    told = np.where(queries.own_found[:, None], parted, 0.0) + there[:, 1:] - there[:, :1]
    return noise.rests_log_odds + told + around


def _elsewhere(
    queries: Queries, at_px: Float[np.ndarray, "K 2"], layers: Layers | None, likeness: Likeness, noise: Noise
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """The most probable place elsewhere, its log-likelihood ratio against nowhere, and that of all other places."""
    found = likeness.elsewhere(at_px, RIVALS, noise)
    if layers is not None:
        found = _or_where_it_was(found, queries, at_px, layers, likeness, noise)
    taken = ((found.uv_px[:, :, None] - at_px) ** 2).sum(axis=-1) < _OCCUPIED_PX**2
    free = 1 - (taken / (1 + np.exp(-queries.seen_log_odds))).max(axis=-1)
    ratio = found.log_odds + np.log(free)
    each, first = np.arange(len(queries)), ratio.argmax(axis=1)
    best = ratio[each, first]
    ratio[each, first] = -np.inf
    return found.uv_px[each, first], best, np.logaddexp.reduce(ratio, axis=1)


def _or_where_it_was(
    found: Places,
    queries: Queries,
    at_px: Float[np.ndarray, "K 2"],
    layers: Layers,
    likeness: Likeness,
    noise: Noise,
) -> Places:
    """Places elsewhere, and those to which the world, and what was around it when it was seen last, brought it.

    Its patch may have gone off with what passed in front of it. So it is as probable there as the layers are to carry
    it, and not by chance alone, as anywhere else.
    """
    share = queries.seen_share + _CARRIES_AT_LEAST[np.minimum(np.arange(len(layers)), 1)]
    which = np.stack([np.zeros(len(queries), dtype=np.int64), share.argmax(axis=1)], axis=1)
    brought = np.take_along_axis(layers.brought(queries.seen_place), which[..., None], axis=1)
    prior = np.log(np.take_along_axis(share, which, axis=1)).clip(max=0.0)
    possible = in_image(brought, likeness.picture.size) & ~_same(brought, at_px[:, None])
    looked = likeness.at(np.where(possible[..., None], brought, at_px[:, None]), noise, CELL_REACH_PX)
    there = _same(found.uv_px[:, :, None], brought[:, None]) & possible[:, None]
    gain = np.where(there, prior[:, None] - noise.jump_log_odds, 0.0).max(axis=-1).clip(min=0.0)
    uv_px = np.concatenate([found.uv_px, looked.uv_px], axis=1)
    log_odds = np.concatenate([found.log_odds + gain, np.where(possible, looked.log_odds + prior, -np.inf)], axis=1)
    # One place counts once, where it looks most like it.
    better = log_odds[:, None] > log_odds[:, :, None]
    better |= (log_odds[:, None] == log_odds[:, :, None]) & np.tri(log_odds.shape[1], k=-1, dtype=bool)
    twice = (better & _same(uv_px[:, None], uv_px[:, :, None])).any(axis=2)
    return Places(uv_px, np.where(twice, -np.inf, log_odds))


def _same(one: Float[np.ndarray, "*#B 2"], other: Float[np.ndarray, "*#B 2"]) -> Bool[np.ndarray, "*B"]:
    """Whether places are so near each other that they are said to be one."""
    return np.asarray(((one - other) ** 2).sum(axis=-1) < _SAME_PX**2)


def _viewed(
    queries: Queries, confirmed: Bool[np.ndarray, " K"], at_px: Float[np.ndarray, "K 2"], picture: Picture
) -> Queries:
    """The newest view of what is seen, and where depth says that it is."""
    descriptor, patch = queries.descriptor.copy(), queries.patch.copy()
    descriptor[confirmed, 1] = picture.describe(at_px[confirmed])
    patch[confirmed, 1] = picture.patches(at_px[confirmed], PATCH_PX)
    return replace(queries, descriptor=descriptor, patch=patch)
