"""Projection, lifting and rigid motion: pure functions on tensors."""

from quest.geometry.camera import lift, lift_depth, project, scale_camera
from quest.geometry.se3 import invert, transform

__all__ = ["invert", "lift", "lift_depth", "project", "scale_camera", "transform"]
