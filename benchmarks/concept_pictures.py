"""Draw the pictures of docs/concepts.md: query and anchor, bodies, joints, and the alarm of a packaged clip.

    python benchmarks/concept_pictures.py

They have a light ground of their own, so that they read on dark pages too. The alarm's curve is tracked.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import quest

IMAGES = Path(__file__).parents[1] / "docs" / "images"

STYLE = (
    ".l{fill:none;stroke:#456;stroke-width:1.5} .w{fill:#f2f0ea;stroke:#456;stroke-width:1.5}"
    ".d{fill:#cfe3f7;stroke:#1f5f99;stroke-width:1.5} .r{fill:#fbe0c3;stroke:#a85b00;stroke-width:1.5}"
    ".g{fill:#789} .gd{fill:#1f5f99} .gr{fill:#a85b00} .t{font-weight:bold} .s{fill:#345;font-size:12.5px}"
    ".q{fill:none;stroke:#c0182b;stroke-width:2.5} .qf{fill:#c0182b} .h{fill:#5a4632}"
    ".x{fill:none;stroke:#1f5f99;stroke-width:1.5;stroke-dasharray:6 4} .a{marker-end:url(#h)}"
)
ARROW = (
    '<defs><marker id="h" markerWidth="9" markerHeight="9" refX="8" refY="4.5" orient="auto">'
    '<path d="M0,0 L9,4.5 L0,9 z" fill="#456"/></marker></defs>'
)


def svg(width: int, height: int, title: str, *parts: str) -> str:
    """A picture with a light ground."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="14">'
    )
    ground = f'<rect width="{width}" height="{height}" rx="8" fill="#fff"/>'
    return "\n".join([head, f"<title>{title}</title><style>{STYLE}</style>{ARROW}{ground}", *parts, "</svg>"]) + "\n"


def text(x: float, y: float, words: str, style: str = "s", anchor: str = "middle") -> str:
    return f'<text class="{style}" x="{x}" y="{y}" text-anchor="{anchor}">{words}</text>'


def shape(style: str, *points: tuple[float, float]) -> str:
    return f'<polygon class="{style}" points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in points)}"/>'


def path(style: str, d: str) -> str:
    return f'<path class="{style}" d="{d}"/>'


def box(style: str, x: float, y: float, width: float, height: float) -> str:
    return f'<rect class="{style}" x="{x}" y="{y}" width="{width}" height="{height}"/>'


def dots(style: str, *points: tuple[float, float]) -> str:
    return "".join(f'<circle class="{style}" cx="{x}" cy="{y}" r="3"/>' for x, y in points)


def cabinet(x: float, y: float) -> str:
    """A cabinet 180 wide with a door on the left and two drawers on the right, all closed."""
    doors = box("d", x + 10, y + 10, 76, 160) + box("r", x + 94, y + 10, 76, 76) + box("r", x + 94, y + 94, 76, 76)
    handles = box("h", x + 72, y + 70, 6, 40) + box("h", x + 112, y + 44, 40, 6) + box("h", x + 112, y + 128, 40, 6)
    return box("w", x, y, 180, 180) + doors + handles


def query() -> str:
    """What can be asked, and what an anchor keeps."""
    asks = [
        (80, "a pixel: Query.point(0, 139, 171)"),
        (116, "a label: Query.semantic(&quot;handle&quot;)"),
        (152, "words: Query.text(&quot;handle of the left door&quot;)"),
        (188, "nothing: all that is found"),
    ]
    said = [box("l", 300, y - 21, 330, 30) + text(312, y - 1, words, "s", "start") for y, words in asks]
    patch = box("w", 700, 84, 100, 100) + box("d", 700, 84, 78, 100) + box("h", 732, 84, 18, 86)
    return svg(
        *(860, 270, "Query and anchor"),
        *(cabinet(60, 50), '<circle class="q" cx="135" cy="140" r="13"/><circle class="qf" cx="135" cy="140" r="3"/>'),
        *(text(150, 28, "first frame", "t"), text(465, 28, "query: what to follow", "t"), *said),
        *(text(750, 28, "anchor: what it was then", "t"), patch, box("q", 700, 84, 100, 100)),
        *(path("l a", "M152,140 C210,140 240,112 296,112"), path("l a", "M632,132 L694,132")),
        *(text(750, 206, "its look and its place;"), text(750, 224, "it never changes")),
    )


def bodies() -> str:
    """Points are carried by what moves as one."""
    still = ((52, 56), (222, 56), (52, 222), (222, 222), (137, 56), (137, 222), (146, 135))
    door, low, high = ((75, 75), (75, 205), (112, 85), (112, 195)), ((160, 160), (205, 208)), ((160, 76), (205, 122))
    opened = shape("d", (420, 60), (352, 92), (352, 252), (420, 220))
    front = box("w", 410, 50, 180, 180) + box("l", 420, 60, 76, 160) + box("r", 504, 60, 76, 76)
    pulled = shape("r", (504, 144), (504, 220), (532, 256), (532, 180)) + box("r", 532, 180, 84, 76)
    moved = ((362, 108), (362, 232), (403, 84), (403, 212))
    right = tuple((x + 360, y) for x, y in still if (x, y) not in {(146, 135), (222, 222)})
    return svg(
        *(860, 290, "Bodies"),
        *(cabinet(50, 50), dots("g", *still), dots("gd", *door), dots("gr", *low, *high)),
        *(front, opened, pulled, box("h", 555, 214, 40, 6), box("h", 524, 94, 40, 6), dots("g", *right)),
        *(dots("gd", *moved), dots("gr", (545, 192), (603, 244), (514, 72), (568, 124))),
        *(text(140, 28, "earlier", "t"), text(500, 28, "later", "t"), path("l a", "M255,140 L335,140")),
        '<circle class="q" cx="366" cy="160" r="11" stroke-dasharray="4 3"/>',
        *(dots("g", (640, 84)), text(654, 88, "still world", "s", "start")),
        *(dots("gd", (640, 114)), text(654, 118, "a body: the door", "s", "start")),
        *(dots("gr", (640, 144)), text(654, 148, "bodies: the drawers", "s", "start")),
        '<circle class="q" cx="642" cy="176" r="8" stroke-dasharray="4 3"/>',
        *(text(658, 173, "the handle is behind its door:", "s", "start"),),
        *(text(658, 191, "it rides on the door&#39;s body", "s", "start"),),
    )


def joints() -> str:
    """Axis, origin and coordinate, from above."""
    pivot, radius, angle = np.array([120.0, 80.0]), 170.0, np.radians(50)
    tip = pivot + radius * np.array([np.cos(angle), np.sin(angle)])
    arc = f"M{pivot[0] + radius},{pivot[1]} A{radius},{radius} 0 0 1 {tip[0]:.1f},{tip[1]:.1f}"
    door = f"M{pivot[0]},{pivot[1]} L{tip[0]:.1f},{tip[1]:.1f}"
    return svg(
        *(860, 280, "Joints"),
        *(text(210, 28, "revolute, from above", "t"), box("w", 100, 44, 210, 36), path("x", "M120,80 L290,80")),
        *(f'<path d="{door}" stroke="#1f5f99" stroke-width="6"/>', path("l a", arc)),
        *('<circle class="gd" cx="120" cy="80" r="6"/>', text(124, 112, "origin, on the axis", "s", "end")),
        *(f'<circle class="qf" cx="{tip[0]:.1f}" cy="{tip[1]:.1f}" r="6"/>', text(tip[0] + 12, tip[1] + 20, "entity")),
        *(text(300, 150, "q, radians", "s", "start"), text(300, 98, "q = 0: where it was", "s", "start")),
        *(text(210, 262, "the axis points out of the page or into it, so that q grows"),),
        *(text(640, 28, "prismatic, from above", "t"), box("w", 560, 44, 160, 36)),
        *(box("r", 572, 150, 136, 14), path("x", "M572,80 L572,150 M708,80 L708,150")),
        *(path("l a", "M640,80 L640,144"), '<circle class="qf" cx="640" cy="157" r="6"/>'),
        *(text(726, 116, "q, metres", "s", "start"), text(726, 162, "entity", "s", "start")),
        *(text(726, 84, "q = 0", "s", "start"), path("l a", "M520,90 L520,140"), text(520, 160, "axis")),
        *(text(640, 262, "the axis points where it went, so that q grows"),),
    )


def alarm() -> str:
    """P(lost) of the query of the second packaged clip that raises an alarm."""
    tracks = quest.load().track("sample-alarm")
    assert tracks.alarm is not None, "the shipped weights have a monitor"
    assert tracks.lost_p is not None, "the shipped weights have a monitor"
    if not tracks.alarm.any():
        raise SystemExit("expected an alarm in sample-alarm; there is none")
    k = int(tracks.alarm.any(axis=0).argmax())
    left, top, width, height = 70, 60, 640, 150
    seconds = tracks.stamp_s - tracks.stamp_s[0]
    x = left + width * seconds / seconds[-1]
    y = top + height * (1 - tracks.lost_p[:, k])
    open_rows = np.flatnonzero(tracks.alarm[:, k])
    unseen = np.flatnonzero(~tracks.visible[:-1, k])
    hidden = [box("g", x[t].round(1), top + height + 8, (x[t + 1] - x[t]).round(1) + 0.2, 8) for t in unseen]
    known = np.isfinite(y)
    curve = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[known], y[known], strict=True))
    ticks = [text(left + width * s / seconds[-1], top + height + 36, f"{s} s") for s in range(int(seconds[-1]) + 1)]
    begin, end = x[open_rows[0]], x[open_rows[-1]]
    return svg(
        *(860, 290, "An alarm"),
        text(left, 28, f"P(lost) of {tracks.names[k]} in the clip sample-alarm", "t", "start"),
        f'<rect x="{begin:.1f}" y="{top}" width="{end - begin:.1f}" height="{height}" fill="#fbd5d5"/>',
        *(path("l", f"M{left},{top} L{left},{top + height} L{left + width},{top + height}"),),
        f'<polyline class="q" points="{curve}"/>',
        *(*hidden, *ticks),
        *(text(left - 10, top + 5, "1", "s", "end"), text(left - 10, top + height + 4, "0", "s", "end")),
        *(text(left + width + 14, top + 40, "the alarm is open", "s", "start"),),
        *(text(left + width + 14, top + height + 16, "not visible", "s", "start"),),
        f'<rect x="{left + width + 14}" y="{top + 8}" width="18" height="14" fill="#fbd5d5"/>',
        f'<rect x="{left + width + 14}" y="{top + height - 8}" width="18" height="8" fill="#789"/>',
    )


@dataclass(frozen=True)
class ConceptPictures:
    """Write the pictures."""

    out: Path = IMAGES

    def run(self) -> None:
        """Draw each into a file of its name."""
        for draw in (query, bodies, joints, alarm):
            (self.out / f"{draw.__name__}.svg").write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(ConceptPictures).run()
