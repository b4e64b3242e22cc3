"""Handle shapes beyond the usual ones; each lies along x, stands on y = 0 and reaches towards -y."""

from __future__ import annotations

import numpy as np

from quest.sim.procedural.model import Mesh, join
from quest.sim.procedural.shapes import box, lathe, prism_between, tube

SUNK_M = 0.001
"""How deep feet reach into the front, so that no gap shows between them."""

_TO_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Turns what is drawn in the x-y plane and extruded along z into the y-z plane, extruded along x."""


def cup(half: float, thickness: float, reach: float) -> Mesh:
    """A cup pull: a quarter of a barrel over a flange, open below."""
    wall = min(0.3 * thickness, 0.2 * reach)
    angle = np.linspace(0, np.pi / 2, 9)
    # Columns are y and z: from the front's face, above, to the lip at the outer end, below.
    quarter = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    outer = reach * quarter - np.array([0.0, 0.5 * reach])
    inner = (reach - wall) * quarter - np.array([0.0, 0.5 * reach])
    outer[0, 0] = inner[0, 0] = SUNK_M
    shell = prism_between(outer, inner, -half, half)
    core = np.tile([[SUNK_M, -0.49 * reach]], (9, 1)) + 0.02 * (outer - outer[0])
    ends = [prism_between(outer, core, side * half - wall / 2, side * half + wall / 2) for side in (-1, 1)]
    barrel = join([shell, *ends]).rotated(_TO_X)
    return join([barrel, box((-half, -0.003, 0.5 * reach), (half, SUNK_M, 0.75 * reach))])


def bow(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A bow: a flat arc between two feet."""
    radius = thickness / 2
    x = np.linspace(-1, 1, 17)
    path = np.stack([(half - radius) * x, -(reach - radius) * (1 - np.abs(x) ** 2.6), 0 * x], axis=1)
    path[[0, -1], 1] = SUNK_M
    return tube(path, radius_m=0.7 * radius, flatness=1.6 * flatness)


def d_pull(half: float, thickness: float, reach: float) -> Mesh:
    """A D: a bar whose ends are bent back to the front with round corners."""
    radius = thickness / 2
    out = reach - radius
    bend = min(0.55 * out, 0.5 * half)
    angle = np.linspace(0, np.pi / 2, 6)
    left = np.stack([-half + radius + bend * (1 - np.cos(angle)), -out + bend * (1 - np.sin(angle))], axis=1)
    right = left[::-1] * [-1, 1]
    ends = np.array([[-half + radius, SUNK_M]])
    path = np.concatenate([ends, left, right, ends * [-1, 1]])
    return tube(np.column_stack([path, np.zeros(len(path))]), radius_m=radius, sides=12)


def t_bar(half: float, thickness: float, reach: float) -> Mesh:
    """A bar on one post."""
    radius, half = 0.6 * thickness, min(half, 0.04)
    bar = tube(np.array([[x, -reach + radius, 0.0] for x in (-half, 0.0, half)]), radius_m=radius)
    post = lathe(np.array([[0.9 * radius, -SUNK_M], [0.7 * radius, 0.5 * reach], [0.7 * radius, reach - radius]]))
    return join([bar, post])


def edge_pull(half: float, thickness: float, reach: float) -> Mesh:
    """A thin angle along the front, gripped from below."""
    depth = 0.6 * reach
    return join([
        box((-half, -reach, 0.0), (half, -0.002, 0.003)),
        box((-half, -reach, -depth), (half, -reach + 0.003, 0.0)),
        box((-half, -0.002, -0.004), (half, SUNK_M, 0.004 + 0.4 * thickness)),
    ])  # fmt: skip


def loop(half: float, reach: float) -> Mesh:
    """A strap of leather that stands out in a loop, held by a stud."""
    half, thick, tall = min(half, 0.016), 0.0025, 0.6 * reach
    angle = np.linspace(0, np.pi, 13)
    outer = np.stack([-reach * np.sin(angle) ** 0.8, tall * np.cos(angle)], axis=1)
    inner = outer * [(reach - thick) / reach, (tall - thick) / tall]
    outer[[0, -1], 0] = inner[[0, -1], 0] = SUNK_M
    strap = prism_between(outer, inner, -half, half).rotated(_TO_X)
    stud = lathe(np.array([[0.006, -SUNK_M], [0.006, 0.002], [0.003, 0.004]]))
    return join([strap, stud.moved((0, 0, -tall - 0.008)), box((-half, -0.002, -tall - 0.018), (half, SUNK_M, -tall))])


def lever(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A door's lever: a rosette, a neck, and a bar to the right of it, so that the foot is at its left end."""
    radius = thickness / 2
    long, bend = 2 * half - 2 * radius, 0.4 * reach
    angle = np.linspace(0, np.pi / 2, 6)
    corner = np.stack([bend * (1 - np.cos(angle)), -reach + radius + bend * (1 - np.sin(angle))], axis=1)
    path = np.concatenate([[[0.0, SUNK_M]], corner, [[0.6 * long, -reach + radius], [long, -reach + 1.2 * radius]]])
    bar = tube(np.column_stack([path, np.zeros(len(path))]), radius_m=radius, flatness=flatness, sides=12)
    rosette = lathe(np.array([[2.4 * radius, -SUNK_M], [2.4 * radius, 0.006], [2.0 * radius, 0.009]]))
    return join([rosette, bar]).moved((-half + radius, 0, 0))
