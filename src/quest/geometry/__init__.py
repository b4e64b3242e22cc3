"""Projection, lifting and rigid motion: pure functions on tensors."""

from quest.geometry.camera import lift, lift_depth, project, scale_camera
from quest.geometry.se3 import exact_product, invert, transform

__all__ = ["exact_product", "invert", "lift", "lift_depth", "project", "scale_camera", "transform"]
