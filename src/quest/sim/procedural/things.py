"""Things that are carried about or worn: eyeglasses, staplers, buckets, pots, laptops, trunks; and a room's door."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from quest.sim.procedural.handles import HandleStyle, handle_part, sample_style
from quest.sim.procedural.model import Dice, Link, ObjectModel, Part
from quest.sim.procedural.shapes import Mesh, box, boxes, centred_box, copies, join, lathe, prism_between, tube, walls


def laptop(rng: Dice) -> ObjectModel:
    """A laptop: a base with keys, and a lid with a screen, closed at 0. It has no handle; its rim is followed."""
    width, depth = rng.real(0.28, 0.38), rng.real(0.19, 0.26)
    base, lid = rng.real(0.009, 0.018), rng.real(0.004, 0.008)
    keys = [
        centred_box((x, y, base + 0.0006), (0.74 * 0.85 * width / 12, 0.72 * 0.4 * depth / 5, 0.0012))
        for x in 0.85 * width * ((np.arange(12) + 0.5) / 12 - 0.5)
        for y in depth * (0.46 + 0.4 * (np.arange(5) + 0.5) / 5)
    ]
    pad = centred_box((0, 0.24 * depth, base + 0.0002), (0.3 * width, 0.26 * depth, 0.0005))
    body = (
        Part("base_frame", box((-width / 2, 0, 0), (width / 2, depth, base)), "metal"),
        Part("keyboard", join(keys), "dark"),
        Part("touchpad", pad, "dark"),
    )
    # The lid in its joint's frame: the axis lies along x at the back, the screen looks down when closed.
    gap, bezel = 0.002, 0.012
    shell = box((-width / 2, -depth, gap), (width / 2, 0.0, gap + lid))
    screen = box((-width / 2 + bezel, -depth + bezel, gap - 0.0006), (width / 2 - bezel, -2 * bezel, gap + 0.0005))
    parts = (Part("lid", shell, "metal"), Part("screen", screen, "dark"))
    link = Link(parts, "revolute", (0.0, depth, base), (-1.0, 0.0, 0.0), rng.angle(95, 130))
    return ObjectModel("Laptop", body, (link,))


def trunk(rng: Dice) -> ObjectModel:
    """An open box with a lid hinged at the back, with or without a handle at the lid's front."""
    width, depth, height = rng.real(0.4, 1.0), rng.real(0.3, 0.5), rng.real(0.25, 0.5)
    wall = rng.real(0.01, 0.02)
    case = walls((-width / 2, 0, 0), (width / 2, depth, height), wall, "-x +x -y +y -z")
    over, thick, skirt = 0.008, rng.real(0.012, 0.03), rng.real(0.03, 0.08)
    front = -depth - over
    lid = boxes(
        ((-width / 2 - over, front, 0.001), (width / 2 + over, 0.0, thick)),
        ((-width / 2 - over, front, -skirt), (width / 2 + over, front + over - 0.001, 0.001)),
    )
    parts = [Part("lid", lid, "front")]
    if rng.chance(0.7):
        style = sample_style(rng)
        middle = (thick - skirt) / 2
        parts.append(handle_part(style, at=(0, front, middle), vertical=False, room_m=(0.6 * width, thick + skirt)))
    link = Link(tuple(parts), "revolute", (0.0, depth, height), (-1.0, 0.0, 0.0), rng.angle(80, 110))
    return ObjectModel("Box", (Part("box_body", case, "body"),), (link,))


def eyeglasses(rng: Dice) -> ObjectModel:
    """Eyeglasses with unfolded temples, which fold inwards; the rim of a temple is its tip."""
    lens_w, lens_h = rng.real(0.046, 0.056), rng.real(0.034, 0.05)
    bridge, frame, thick = rng.real(0.014, 0.022), rng.real(0.002, 0.005), rng.real(0.002, 0.004)
    power = rng.real(2.0, 4.5)  # 2 is an ellipse, more is squarer
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    cos, sin = np.cos(angle), np.sin(angle)
    shape = np.stack([np.sign(cos) * np.abs(cos) ** (2 / power), np.sign(sin) * np.abs(sin) ** (2 / power)], axis=1)
    inner = shape * [lens_w / 2, lens_h / 2]
    outer = shape * [lens_w / 2 + frame, lens_h / 2 + frame]
    middle = (bridge + lens_w) / 2 + frame
    ring = prism_between(outer, inner, 0.0, thick, closed=True).turned("front")
    pane = prism_between(inner, 0.02 * inner, 0.4 * thick, 0.6 * thick, closed=True).turned("front")
    half = middle + lens_w / 2 + frame
    hinge_z = 0.22 * lens_h
    x = np.linspace(-bridge / 2 - frame, bridge / 2 + frame, 5)
    nose = tube(np.stack([x, 0 * x - 0.5 * thick], axis=1), radius_m=0.45 * thick, flatness=rng.real(1.0, 1.6))
    lugs = boxes(*(
        ((low, -thick, hinge_z - 0.004), (high, 0.006, hinge_z + 0.004))
        for low, high in ((-half - 0.006, -half), (half, half + 0.006))
    ))  # fmt: skip
    rings, panes = (copies(each, [(side * middle, 0, 0) for side in (-1, 1)]) for each in (ring, pane))
    front = join([rings, nose.moved((0, 0, 0.15 * lens_h)), lugs])
    body = (Part("frame", front, "dark"), Part("glass", panes, "glass"))
    length, drop = rng.real(0.125, 0.145), rng.real(0.015, 0.032)
    along = np.linspace(0, 1, 15)
    path = np.stack([length * along, -drop * np.clip((along - 0.68) / 0.32, 0, 1) ** 1.6], axis=1)
    temple = tube(path, radius_m=rng.real(0.0014, 0.003), flatness=rng.real(0.5, 1.0)).turned("side")
    links = []
    for side in (-1.0, 1.0):
        origin = (side * (half + 0.003), 0.0065, hinge_z)
        fold = rng.angle(80, 90)
        leg = Part("leg", temple, "dark" if rng.chance(0.7) else "metal")
        links.append(Link((leg,), "revolute", origin, (0.0, 0.0, side), fold))
    ground = min(float(mesh.bounds[0, 2]) for mesh in (front, panes, temple.moved((0, 0, hinge_z))))
    return ObjectModel("Eyeglasses", body, tuple(links)).moved((0.0, -length / 2, -ground))


def sunglasses(rng: Dice) -> ObjectModel:
    """Eyeglasses one does not see through: a shield or two dark lenses, and flat temples as wide as a finger."""
    half, height = rng.real(0.062, 0.074), rng.real(0.034, 0.056)
    wrap = rng.real(0.0, 0.035)  # how far the ends of the front go back
    thick = rng.real(0.002, 0.005)
    gap = 0.0 if rng.chance(0.4) else rng.real(0.006, 0.011)
    one_colour = rng.chance(0.6)
    brow = rng.real(0.004, 0.009)

    def wall(x: np.ndarray, low: float, high: float) -> Mesh:
        front = np.stack([x, wrap * (x / half) ** 2], axis=1)
        return prism_between(front, front + np.array([0.0, thick]), low, high)

    ends = ((gap, half - 0.004), (-half + 0.004, -gap))
    lenses = join([wall(np.linspace(*each, 9), 0.0, height - brow) for each in ends])
    body = (
        Part("lens", lenses, "front" if one_colour else "glass"),
        Part("frame", wall(np.linspace(-half, half, 17), height - brow, height), "front"),
    )
    length, wide, tip = rng.real(0.11, 0.15), rng.real(0.008, 0.016), rng.real(0.004, 0.009)
    along = np.linspace(0.0, 1.0, 13)
    bend = -rng.real(0.005, 0.03) * np.clip((along - 0.7) / 0.3, 0.0, 1.0) ** 1.5
    tall = wide + (tip - wide) * np.clip(along / rng.real(0.3, 0.9), 0.0, 1.0)
    lower, upper = (np.stack([length * along, bend + side * tall / 2], axis=1) for side in (-1, 1))
    board = rng.real(0.0025, 0.006)
    temple = prism_between(lower, upper, -board / 2, board / 2).turned("side")
    hinge_z = height - wide / 2
    links = []
    for side in (-1.0, 1.0):
        origin = (side * (half + board / 2 - 0.002), wrap + thick + 0.001, hinge_z)
        fold = rng.angle(75, 90)
        part = Part("leg", temple, "front" if one_colour or rng.chance(0.5) else "dark")
        links.append(Link((part,), "revolute", origin, (0.0, 0.0, side), fold))
    ground = min(0.0, hinge_z + float(temple.bounds[0, 2]))
    return ObjectModel("Eyeglasses", body, tuple(links)).moved((0.0, -length / 2, -ground))


def stapler(rng: Dice) -> ObjectModel:
    """A stapler: a base, a magazine and an arm that turn about one hinge at the back."""
    length, width = rng.real(0.11, 0.17), rng.real(0.026, 0.042)
    base_h, mag_h, arm_h = rng.real(0.006, 0.011), rng.real(0.008, 0.012), rng.real(0.012, 0.02)
    z = base_h + 0.004
    tower = box((-0.35 * width, length - 0.02, base_h), (0.35 * width, length, z + mag_h + 0.3 * arm_h))
    body = (
        Part("base_frame", join([box((-width / 2, 0, 0), (width / 2, length, base_h)), tower]), "dark"),
        Part("anvil", box((-0.3 * width, 0.012, base_h), (0.3 * width, 0.03, base_h + 0.0012)), "metal"),
    )
    inside = 0.6 * width
    magazine = box((-inside / 2, -length + 0.006, 0.0), (inside / 2, -0.022, mag_h))
    # The arm as a wall between an upper and a lower line, seen from its side; y runs from the hinge to the front.
    along = np.linspace(0, 1, 9)
    bulge = rng.real(0.1, 0.6)
    y, rise = 0.008 - (length + 0.004) * along, 0.55 + bulge * np.sin(np.pi * along) * 0.8 + 0.25 * along
    upper, lower = (np.stack([y, z], axis=1) for z in (mag_h + arm_h * rise, np.full(9, mag_h + 0.001)))
    arm = prism_between(upper, lower, -width / 2, width / 2).turned("side")
    turn, hinge = rng.angle(85, 110), (0.0, length - 0.008, z)
    links = tuple(
        Link((part,), "revolute", hinge, (-1.0, 0.0, 0.0), by)
        for part, by in ((Part("lid", arm, "front"), turn), (Part("magazine", magazine, "metal"), 0.75 * turn))
    )
    return ObjectModel("Stapler", body, links).moved((0.0, -length / 2, 0.0))


def bucket(rng: Dice) -> ObjectModel:
    """A bucket whose bail lies on its front edge and turns up."""
    height, radius = rng.real(0.22, 0.34), rng.real(0.11, 0.16)
    foot, wall = radius * rng.real(0.65, 0.9), 0.004
    lip = rng.real(0.004, 0.01)
    profile = [
        (0.0, 0.0), (foot, 0.0), (radius, height - 0.012), (radius + lip, height - 0.012), (radius + lip, height),
        (radius - wall, height), (foot - wall, 0.01), (0.0, 0.01),
    ]  # fmt: skip
    shell = lathe(profile, sides=40).turned("up")
    ear_z = height - rng.real(0.02, 0.04)
    span = radius + lip + 0.004
    ears = boxes(*(
        ((x - 0.007, -0.012, ear_z - 0.012), (x + 0.007, 0.012, ear_z + 0.012)) for x in (-span, span)
    ))  # fmt: skip
    surfaces = ("metal", "metal") if rng.chance(0.5) else ("front", "dark")
    body = (Part("base_body", shell, surfaces[0]), Part("ear", ears, surfaces[1]))
    # The bail's hoop in the x-y plane, towards -y, then tilted so that it lies on the lip.
    wide = span + 0.004
    angle = np.linspace(0, np.pi, 33)
    bow = rng.real(1.0, 1.15)
    hoop = tube(np.stack([-wide * np.cos(angle), -bow * wide * np.sin(angle)], axis=1), radius_m=0.0028)
    x = np.linspace(-0.05, 0.05, 9)
    grip = tube(np.stack([x, -bow * np.sqrt(wide**2 - x**2)], axis=1), radius_m=rng.real(0.008, 0.012))
    tilt = -rng.angle(0, 12)  # a little above the horizontal, clear of the lip
    parts = [Part("handle", hoop.tilted(tilt), "metal")]
    if rng.chance(0.75):
        parts.append(Part("handle", grip.tilted(tilt), rng.pick(["dark", "white", "front"])))
    bail = Link(tuple(parts), "revolute", (0.0, 0.0, ear_z), (-1.0, 0.0, 0.0), rng.angle(88, 110))
    return ObjectModel("Bucket", body, (bail,))


def pot(rng: Dice) -> ObjectModel:
    """A pot or a kettle: a belly with a handle at its side, often a spout, and a lid with a knob that lifts off."""
    radius, height = rng.real(0.07, 0.1), rng.real(0.1, 0.16)
    mouth, wall = radius * rng.real(0.5, 0.8), 0.004
    share = np.linspace(0, 1, 11)
    belly = mouth + (radius - mouth) * np.sin(np.pi * (0.25 + 0.75 * share)) ** rng.real(0.5, 1.2)
    belly[-1] = mouth
    outer = np.stack([belly, share * height], axis=1)
    inner = np.stack([belly - wall, share * (height - wall) + wall], axis=1)[::-1]
    shell = lathe(np.concatenate([[[0.0, 0.0]], outer, inner, [[0.0, wall]]]), sides=36).turned("up")
    body = [Part("base_body", shell, "metal" if rng.chance(0.5) else "front")]
    # The handle at the right, the spout at the left of someone who stands before it.
    style = HandleStyle("d_pull", 0.6 * height, rng.real(0.01, 0.016), rng.real(0.04, 0.06), 1.0, "dark")
    at_side = float(belly[5]) - 0.006
    held = handle_part(style, at=(0, 0, 0), vertical=True, room_m=(height, height))
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # from -y to +x
    body.append(Part("handle", held.mesh.rotated(quarter).moved((at_side, 0, 0.5 * height)), "dark"))
    if rng.chance(0.7):
        path = np.array([[0.0, 0.0], [-0.03, 0.012], [-0.055, 0.04], [-0.08, 0.06]])
        spout = tube(path, radius_m=rng.real(0.01, 0.014)).turned("front")
        body.append(Part("spout", spout.moved((-float(belly[5]) + 0.01, 0, 0.45 * height)), body[0].surface))
    dome = rng.real(0.008, 0.025)
    rim, angle = mouth + 0.002, np.linspace(0.2, 1.4, 6)
    lid = [(rim, 0.0), (rim, 0.003), *((rim * np.cos(a), 0.003 + dome * np.sin(a)) for a in angle)]
    # A knob without a stem: its outside is the nearest to its middle.
    shapes = [[(0.85, -0.1), (1.0, 0.35), (0.95, 0.7), (0.55, 1.0)], [(0.9, -0.1), (1.0, 0.9), (0.9, 1.0)]]
    wide, tall = rng.real(0.011, 0.017), rng.real(0.014, 0.024)
    knob = lathe(np.array(shapes[0 if rng.chance(0.5) else 1]) * [wide, tall], sides=24).turned("up")
    turned = Part("knob", knob.moved((0, 0, 0.003 + 0.97 * dome)), "dark")
    parts = (Part("lid", lathe(lid, sides=36).turned("up"), body[0].surface), turned)
    link = Link(parts, "prismatic", (0.0, 0.0, height + 0.001), (0.0, 0.0, 1.0), rng.real(0.05, 0.1))
    return ObjectModel("Kettle", tuple(body), (link,))


def room_door(rng: Dice) -> ObjectModel:
    """A door of a room: a frame, and a leaf with levers or knobs on both faces, hinged at either side."""
    width, height, thick = rng.real(0.7, 0.95), rng.real(1.9, 2.1), rng.real(0.035, 0.05)
    post, deep = rng.real(0.05, 0.1), rng.real(0.1, 0.16)
    left = rng.chance(0.5)
    sign = -1.0 if left else 1.0
    frame = boxes(
        ((-width / 2 - post, -0.004, 0), (-width / 2 - 0.003, deep, height + post)),
        ((width / 2 + 0.003, -0.004, 0), (width / 2 + post, deep, height + post)),
        ((-width / 2 - 0.003, -0.004, height + 0.003), (width / 2 + 0.003, deep, height + post)),
    )
    # The leaf from the hinge's edge at x = 0, its outer face at y = 0.
    parts = [replace(p, mesh=p.mesh.moved((0.0 if left else -width, 0, 0))) for p in _leaf(rng, width, height, thick)]
    knob = rng.chance(0.3)
    style = HandleStyle(
        "knob" if knob else rng.pick(("lever", "lever", "d_pull", "bar")),
        rng.real(0.11, 0.15) if not knob else 0.1,
        rng.real(0.024, 0.03) if knob else rng.real(0.014, 0.022),
        rng.real(0.05, 0.065), rng.real(0.7, 1.2), sample_style(rng).surface,
    )  # fmt: skip
    upright = style.kind in ("d_pull", "bar")
    if upright:
        style = replace(style, length_m=rng.real(0.2, 0.5))
    z, edge = rng.real(0.95, 1.08), rng.real(0.055, 0.07)
    grip = handle_part(style, at=(0, 0, 0), vertical=upright, room_m=(0.9, 0.9))
    if style.kind == "lever":  # its foot is at the left end; at the free edge it points to the hinge
        grip = replace(grip, mesh=grip.mesh.moved((style.length_m / 2 - 0.01, 0, 0)))
        if left:
            grip = replace(grip, mesh=_half_turn(grip.mesh))
    x = -sign * (width - edge)
    parts.append(replace(grip, mesh=grip.mesh.moved((x, 0, z))))
    behind = np.diag([-1.0, -1.0, 1.0])
    mirrored = _half_turn(grip.mesh) if style.kind == "lever" else grip.mesh
    parts.append(replace(grip, mesh=mirrored.rotated(behind).moved((x, thick, z))))
    hinge = (sign * (width / 2), -0.005, 0.006)
    link = Link(tuple(parts), "revolute", hinge, (0.0, 0.0, sign), rng.angle(80, 110))
    return ObjectModel("Door", (Part("frame", frame, "body"),), (link,)).moved((0.0, -deep / 2, 0.0))


def _half_turn(mesh: Mesh) -> Mesh:
    """Half a turn in the plane of the front: what pointed right points left."""
    return mesh.rotated(np.diag([-1.0, 1.0, -1.0]))


def _leaf(rng: Dice, width: float, height: float, thick: float) -> list[Part]:
    high, kind = height - 0.008, rng.whole(0, 4)
    if kind == 0:
        return [Part("door_panel", box((0, 0, 0), (width, thick, high)), "front")]
    stile, rail = rng.real(0.1, 0.13), rng.real(0.12, 0.2)
    rows = 1 if kind == 1 else rng.whole(2, 5)
    columns = 1 if kind == 1 else rng.whole(1, 3)
    x_edges = np.linspace(stile, width - stile, columns + 1)
    z_edges = np.linspace(rail, high - 0.12, rows + 1)
    half = 0.03
    bars = [walls((0, 0, 0), (width, thick, high), (stile, stile, rail, 0.12), "-x +x -z +z")]
    bars += [box((stile, 0, z - half), (width - stile, thick, z + half)) for z in z_edges[1:-1]]
    for low, top in pairwise(z_edges):
        lo, hi = low + (half if low > rail else 0), top - (half if top < high - 0.121 else 0)
        bars += [box((x - half, 0, lo), (x + half, thick, hi)) for x in x_edges[1:-1]]
    fill = box((stile, 0.3 * thick, rail), (width - stile, 0.7 * thick, high - 0.12))
    names = ("glass", "glass") if kind == 1 or rng.chance(0.25) else ("panel", "front")
    return [Part("door_panel", join(bars), "front"), Part(names[0], fill, names[1])]
