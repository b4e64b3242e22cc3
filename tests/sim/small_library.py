"""Hand-written libraries of Sweet Home 3D: boxes, of which some are tagged as a door on a hinge."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

from PIL import Image

PROPERTIES = """
# made by hand
name=Test\\u00e9
license=CC-BY
id#1=cupboard
name#1=A | cupboard
creator#1=M\\u00fcller
category#1=Kitchen
model#1=/lib/cupboard/cupboard.obj
width#1=60
depth#1=40
height#1=80
"""
LOOKS = "newmtl wood\nKd 0.8 0.6 0.4\nmap_Kd bark oak.png\nnewmtl steel\nKd 1 1 1\n"
SIZES = "width#{0}=60\ndepth#{0}=40\nheight#{0}=80\n"


def box(name: str, low: tuple, high: tuple, first: int, material: str = "wood") -> tuple[str, int]:
    """A box as a group of a Wavefront file, in the axes of Sweet Home 3D: y up, z the front."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    lines = [f"g {name}", f"usemtl {material}", *(f"v {x} {y} {z}" for x, y, z in corners)]
    for face in ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)):
        lines.append("f " + " ".join(f"{first + i - 1}/1" for i in face))
    return "\n".join(lines), first + 8


def wavefront(*boxes: tuple) -> str:
    text, first = ["mtllib it.mtl", "vt 0 0"], 1
    for each in boxes:
        name, low, high, *material = each
        part, first = box(name, low, high, first, *material)
        text.append(part)
    return "\n".join(text) + "\n"


BODY = ("body", (0, 0, 0), (6, 8, 3.6))
CUPBOARD = wavefront(
    BODY,
    ("sweethome3d_hinge_1", (0, 0, 3.6), (0.1, 8, 3.7)),
    ("sweethome3d_opening_on_hinge_1_door", (0, 0, 3.6), (6, 8, 3.8)),
    ("sweethome3d_opening_on_hinge_1_handle", (5, 3, 3.8), (5.4, 5, 4), "steel"),
)
CHEST = wavefront(BODY, ("fronts", (0, 1, 3.6), (6, 4, 3.9)), ("knobs", (2.8, 2.4, 3.9), (3.2, 2.8, 4), "steel"))


def picture() -> bytes:
    data = io.BytesIO()
    Image.new("RGB", (4, 4), (200, 100, 50)).save(data, "PNG")
    return data.getvalue()


def write_library(path: Path, models: dict[str, str], properties: str = PROPERTIES, **more: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("PluginFurnitureCatalog.properties", properties.encode("latin-1"))
        for name, text in models.items():
            archive.writestr(f"lib/{name}/{name}.obj", text)
            archive.writestr(f"lib/{name}/it.mtl", LOOKS)
            archive.writestr(f"lib/{name}/bark oak.png", picture())
        for name, data in more.items():
            archive.writestr(name, data)
    return path
