"""The filter's noise parameters: each has a unit, and rates are per second."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Noise:
    """How far each kind of evidence is off. Pixels are those of pictures with a longer side of 480 or more."""

    chain_px2_s: float = 4.0
    """Variance that a patch gathers which is followed from frame to frame, pixels squared per second."""
    blind_px2_s: float = 400.0
    """The same while the patch is not found."""
    anchor_px: float = 3.0
    """Error of the anchor's patch found again under another view, pixels."""
    like_anchor: float = 0.7
    """Normalised cross-correlation with the anchor's patch below which a place found by it does not count."""
    moved_px: float = 60.0
    """How far from there an entity that moves is seen, pixels."""
    look_wide: float = 3.28
    """Weight of the likeness of descriptors."""
    look_near: float = 0.76
    """Weight of the likeness of the grey values close by."""
    look_bias: float = -5.52
    """Log-odds of a place where an entity is followed, were it as unlike its anchor as can be."""
    jump_log_odds: float = -2.52
    """The same elsewhere, less :attr:`look_bias`."""
    hidden_s: float = 1.0
    """For how long an entity stays occluded where it is, seconds."""
    correlated_s: float = 0.3
    """For how long evidence repeats itself, seconds."""
    rests_log_odds: float = 3.0
    """That an entity rests, before anything is seen."""
    depth: float = 0.01
    """Error of a depth, as a share of it."""
    depth_m: float = 0.015
    """Its least error, metres."""
    depth_grows: float = 0.0
    """How much more it errs by chance, for the square of the depth, 1/m: measured on every stream."""
    relief_m: float = 0.04
    """How far the surface around an entity stands out or falls back, metres."""
    speed_m_s: float = 1.0
    """How fast an entity comes nearer, metres per second."""
    depths_m: float = 0.5
    """Over how wide a range the depth of another surface is spread, metres."""
    stray: float = 0.05
    """Share of what is measured that is of something else: depths at edges and thin handles, patches that slipped."""
    point_px: float = 0.7
    """Least error of a landmark that is followed, besides what its patch says, pixels."""
    points_s: float = 0.1
    """For how long the evidence repeats itself that a body carries a landmark, seconds."""
    turn_rad_s: float = 2.0
    """How fast a body turns, radians per second."""
    stops_s: float = 0.3
    """For how long a body keeps its velocity, seconds."""
    surface: float = 0.1
    """How much of a surface point's evidence is new: depths beside each other err alike."""
    joint_m: float = 0.01
    """How far off its joint's screw a body is, metres."""
    arm_m: float = 0.3
    """Lever at which a turn counts as much as a shift, metres."""
