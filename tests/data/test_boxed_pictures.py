"""Labelled pictures in the forms that people have them in."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from quest.data.boxed_pictures import kind_of, may_choose, read_boxed_pictures
from quest.errors import InputError

BOX = (10.0, 20.0, 50.0, 40.0)


def make_picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.zeros((80, 100, 3), np.uint8)).save(path)


def make_coco(folder: Path) -> Path:
    make_picture(folder / "images" / "a.png")
    make_picture(folder / "images" / "b.png")
    raw = {
        "images": [{"id": 7, "file_name": "a.png", "license": 1}, {"id": 8, "file_name": "b.png"}],
        "licenses": [{"id": 1, "name": "CC BY 4.0"}],
        "categories": [{"id": 3, "name": "Handle"}],
        "annotations": [{"image_id": 7, "category_id": 3, "bbox": [10, 20, 40, 20]}],
    }
    (folder / "labels.json").write_text(json.dumps(raw))
    return folder / "labels.json"


def make_yolo(folder: Path) -> Path:
    make_picture(folder / "images" / "train" / "a.png")
    make_picture(folder / "images" / "train" / "b.png")
    (folder / "labels" / "train").mkdir(parents=True)
    (folder / "labels" / "train" / "a.txt").write_text("1 0.3 0.375 0.4 0.25\n1 0.1 0.25 0.5 0.25 0.5 0.5 0.1 0.5\n")
    (folder / "data.yaml").write_text("names: {0: drawer, 1: Handle}\n")
    return folder


def make_table(folder: Path) -> Path:
    make_picture(folder / "pictures" / "a.png")
    make_picture(folder / "pictures" / "b.png")
    (folder / "labels.csv").write_text(
        "file,class,x0,y0,x1,y1,licence\na.png,Handle,10,20,50,40,CC BY 4.0\nb.png,,,,,,unknown\n"
    )
    return folder


@pytest.mark.parametrize("make", [make_coco, make_yolo, make_table])
def test_every_form_reads_alike(make, tmp_path: Path) -> None:
    a, b = read_boxed_pictures(make(tmp_path))
    assert (a.path.name, b.path.name) == ("a.png", "b.png")
    assert set(a.names) == {"Handle"}
    for box in a.box_px:
        np.testing.assert_allclose(box, BOX)
    assert len(b.box_px) == 0
    assert (a.licence, b.licence) == {
        make_coco: ("CC BY 4.0", ""), make_yolo: ("", ""), make_table: ("CC BY 4.0", "unknown"),
    }[make]  # fmt: skip
    assert kind_of(a.names[0]) == ("grip", False)


def test_what_cannot_be_understood_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="COCO"):
        read_boxed_pictures(tmp_path)
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(InputError, match="images, annotations and categories"):
        read_boxed_pictures(tmp_path / "broken.json")
    folder = make_yolo(tmp_path / "yolo")
    (folder / "labels" / "train" / "b.txt").write_text("9 0.5 0.5 0.1 0.1\n")
    with pytest.raises(InputError, match=r"b\.txt"):
        read_boxed_pictures(folder)
    (folder / "labels" / "train" / "b.txt").unlink()
    (folder / "images" / "train" / "b.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"b\.png"):
        read_boxed_pictures(folder)
    table = make_table(tmp_path / "table")
    (table / "pictures" / "b.png").unlink()
    with pytest.raises(InputError, match="expected a picture"):
        read_boxed_pictures(table)
    (table / "labels.csv").write_text("file,x0,y0,x1,y1\na.png,10,20,50,40\n")
    with pytest.raises(InputError, match="none named class"):
        read_boxed_pictures(table)
    (table / "labels.csv").write_text("file,class,x0,y0,x1,y1\na.png,handle,50,20,10,40\n")
    with pytest.raises(InputError, match="in order"):
        read_boxed_pictures(table)


def test_pictures_that_are_to_be_turned_have_boxes_as_they_are_seen(tmp_path: Path) -> None:
    folder = make_yolo(tmp_path)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(np.zeros((100, 80, 3), np.uint8)).save(folder / "images" / "train" / "a.png", exif=exif)
    np.testing.assert_allclose(read_boxed_pictures(folder)[0].box_px[0], BOX)


def test_a_fifth_chooses() -> None:
    share = np.mean([may_choose(f"{i}.jpg") for i in range(2000)])
    assert 0.17 < share < 0.23
