"""Networks as ONNX: what is in the folder, what they compute, and the tracker that runs them."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import jaxtyping
import numpy as np
import pytest
import torch

import quest
from quest.errors import ConfigError, InputError, MissingExtraError, WeightsError
from quest.model import efficientnet, finder, onnx_export
from quest.model.encoder import EncoderConfig
from quest.model.onnx_export import MANIFEST, TOLERANCE
from quest.model.weights import LoadedNetwork, load_network, save_network
from quest.model.xfeat import XFeat
from quest.track import engine
from quest.track.settings import TrackerConfig
from tests.tiny import FINDER, make_finder

DOCUMENT = Path(__file__).parents[2] / "docs" / "export.md"
SETTINGS = TrackerConfig(size_px=160, threshold=0.55)
pytest.importorskip("onnxruntime")

pytestmark = pytest.mark.xdist_group("onnx")
"""Tracing takes its time, and is done once."""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LoadedNetwork]:
    """A finder with one block where there are many, because tracing takes its time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(efficientnet, "_STAGES", tuple((*stage[:4], 1) for stage in efficientnet._STAGES))
        for name, one in (("CONTEXT_BLOCKS", (0,)), ("_STEPS", (1,)), ("_MIDDLE_STEPS", (1,))):
            patch.setattr(finder, name, one)
        encoder = EncoderConfig(image_size=64, patch_size=16, width=24, depth=1, heads=2)
        path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
        network = make_finder(replace(FINDER, encoder=encoder))
        save_network(path, network, settings=SETTINGS.to_json(), about="a test", licence="Apache-2.0")
        yield load_network(path)


@pytest.fixture(scope="module")
def folder(loaded: LoadedNetwork, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "tiny"
    checked = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        differences = engine.export(loaded, out)
    finally:
        jaxtyping.config.update("jaxtyping_disable", checked)
    assert {(each.network, each.size) for each in differences} == {
        *(("finder", (160, 128)), ("finder", (96, 96))),
        *(("features", (160, 128)), ("features", (96, 96))),
    }
    assert 0 < max(each.largest for each in differences) < TOLERANCE
    return out


@pytest.fixture
def quick(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Export without tracing again."""
    made = {"rgb": "finder.onnx", "grey": "features.onnx"}
    monkeypatch.setattr(onnx_export, "to_onnx", lambda _, inputs, __: (folder / made[inputs[0].name]).read_bytes())


@pytest.fixture(scope="module")
def clip() -> quest.Clip:
    whole = quest.read("sample")
    assert whole.depth_m is not None
    return replace(
        whole, rgb=whole.rgb[:4], depth_m=whole.depth_m[:4], cam_from_world=whole.cam_from_world[:4],
        stamp_s=whole.stamp_s[:4], notes=(),
    )  # fmt: skip


@pytest.mark.slow
def test_the_folder_says_what_is_in_it(folder: Path, loaded: LoadedNetwork):
    import onnx

    manifest = json.loads((folder / MANIFEST).read_text())
    assert sorted(path.name for path in folder.iterdir()) == ["features.onnx", "finder.onnx", "manifest.json"]
    assert manifest["quest"] == quest.__version__
    assert manifest["settings"] == json.loads(SETTINGS.to_json())
    assert (manifest["finder"]["weights_sha256"], manifest["finder"]["licence"]) == (loaded.sha256, "Apache-2.0")
    for name in ("finder", "features"):
        graph = onnx.load(folder / f"{name}.onnx")
        onnx.checker.check_model(graph, full_check=True)
        assert [(each.domain, each.version) for each in graph.opset_import] == [("", manifest["opset"])]
        assert not {node.op_type for node in graph.graph.node} & {"GridSample", "InstanceNormalization"}
        for values, infos in ((graph.graph.input, "inputs"), (graph.graph.output, "outputs")):
            assert [(v.name, [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim]) for v in values] == [
                (info["name"], info["shape"]) for info in manifest[name][infos]
            ]
        assert str(Path(torch.__file__).parent).encode() not in (folder / f"{name}.onnx").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(32, 32), (32, 96), (224, 64), (64, 288)])
def test_pictures_of_any_size_in_steps(folder: Path, loaded: LoadedNetwork, size: tuple[int, int]):
    rgb = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        for name, network, seen in (
            ("finder", onnx_export._Maps(loaded.network), rgb),
            ("features", XFeat.from_package(), rgb.mean(dim=1, keepdim=True)),
        ):
            run = onnx_export.session((folder / f"{name}.onnx").read_bytes())
            for ours, theirs in zip(network(seen), run(seen), strict=True):
                torch.testing.assert_close(theirs, ours, atol=1e-4, rtol=1e-4)


@pytest.mark.slow
def test_the_tracker_answers_the_same(folder: Path, loaded: LoadedNetwork, clip: quest.Clip):
    queries = [quest.Query.point(0, 450, 228), quest.Query.semantic("handle")]
    by_torch = quest.load(loaded.path, monitor=False)
    expected = by_torch.track(clip, queries)
    tracker = quest.load(loaded.path, engine=folder, monitor=False)
    assert isinstance(tracker, quest.Tracker)
    tracks = tracker.track(clip, queries)
    np.testing.assert_allclose(tracks.uv_px, expected.uv_px, atol=0.01)
    assert (tracks.state == expected.state).all()
    assert isinstance(by_torch, quest.Tracker)
    stream = by_torch.stream(clip.camera, queries)
    frame = clip.frame(0)
    stream.step(frame.rgb, frame.depth_m, frame.stamp_s)
    restored = tracker.restore(by_torch.save(stream))  # saved streams belong to weights, not to an engine
    assert restored.frame == 1


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_what_differs_is_not_written(loaded: LoadedNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(onnx_export, "TOLERANCE", 0.0)
    with pytest.raises(WeightsError, match=r"differs from PyTorch by .* nothing was written"):
        engine.export(loaded, tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_engine_onnx_exports_once(loaded: LoadedNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog):
    def cache(subfolder: str, **_: str) -> Path:
        (tmp_path / subfolder).mkdir(exist_ok=True)
        return tmp_path / subfolder

    monkeypatch.setattr(engine, "cached_assets_path", cache)
    quest.load(loaded.path, engine="onnx", monitor=False)
    assert "once" in caplog.text
    (made,) = tmp_path.iterdir()
    stamp = (made / MANIFEST).stat().st_mtime_ns
    quest.load(loaded.path, engine="onnx", monitor=False)
    assert [path.name for path in tmp_path.iterdir()] == [made.name]
    assert (made / MANIFEST).stat().st_mtime_ns == stamp


@pytest.mark.slow
def test_a_wrong_folder_is_refused(folder: Path, loaded: LoadedNetwork, tmp_path: Path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    other = tmp_path / "other.safetensors"
    save_network(other, loaded.network, settings="{}", about="another")
    with pytest.raises(WeightsError, match=r"expected networks of the weights .*other"):
        quest.load(other, engine=copy)
    with (copy / "features.onnx").open("ab") as file:
        file.write(b"more")
    with pytest.raises(WeightsError, match=r"features\.onnx: it was changed"):
        quest.load(loaded.path, engine=copy)
    manifest = json.loads((copy / MANIFEST).read_text())
    for wrong in ({"format": "quest-onnx-0"}, {"finder": 3}, {"finder": {**manifest["finder"], "file": "../x"}}):
        (copy / MANIFEST).write_text(json.dumps({**manifest, **wrong}))
        with pytest.raises(WeightsError, match="quest export"):
            quest.load(loaded.path, engine=copy)


@pytest.mark.slow
def test_the_documented_program_finds_it_too(folder: Path, loaded: LoadedNetwork, tmp_path: Path, monkeypatch, capsys):
    rgb = quest.read("sample").rgb[0]
    cv2.imwrite(str(tmp_path / "kitchen.png"), rgb[..., ::-1])
    shutil.copytree(folder, tmp_path / "exported")
    monkeypatch.chdir(tmp_path)
    program = re.search(r"```python\n(import json.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert program is not None
    exec(compile(program[1], str(DOCUMENT), "exec"), {})
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    places = np.array([[float(x), float(y)] for _, _, x, y in lines])
    tracker = quest.load(loaded.path, monitor=False)
    assert isinstance(tracker, quest.Tracker)
    found = tracker.find(rgb)
    found = found.select(found.p > SETTINGS.threshold)
    assert len(found)
    for uv_px in found.uv_px:  # the program gives the middles of cells
        assert np.abs(places - uv_px).max(axis=1).min() < 2 * 4 * 640 / SETTINGS.size_px


def test_without_the_extra_it_is_named(loaded: LoadedNetwork, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r"onnxruntime is not installed.*\[export\]"):
        quest.load(loaded.path, engine=tmp_path)


def test_what_no_engine_can_run(loaded: LoadedNetwork, tmp_path: Path):
    with pytest.raises(WeightsError, match="expected a folder of `quest export`, or torch, bfloat16 or onnx"):
        quest.load(loaded.path, engine="tensorrt")
    with pytest.raises(ConfigError, match="ONNX Runtime runs on the processor"):
        quest.load(loaded.path, engine=tmp_path, device="cuda")
    (tmp_path / "there").write_text("something")
    with pytest.raises(InputError, match="not an empty folder"):
        engine.export(loaded, tmp_path)
