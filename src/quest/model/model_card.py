"""The card of a network's repository: what the file holds, in the form that the Hugging Face hub reads."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from huggingface_hub import ModelCard, ModelCardData

from quest.extras import DISTRIBUTION
from quest.model.config import NetworkConfig

TAGS = ("articulated-objects", "object-tracking", "point-tracking", "rgb-d", "robotics")
"""What the hub finds the weights by."""

HUB_LICENCES = frozenset({"apache-2.0", "mit", "bsd-2-clause", "bsd-3-clause", "cc-by-4.0", "cc-by-nc-4.0", "cc0-1.0"})
"""Licences that the hub knows by these words; every other one is called ``other`` there, with its name."""


def model_card(
    data: Mapping[str, Any],
    *,
    text: str | None,
    config: NetworkConfig,
    about: str,
    settings: str,
    monitor: str | None,
    licence: str,
    version: str,
    load_as: str,
) -> ModelCard:
    """Make the card.

    Args:
        data: what the hub is told beside the licence.
        text: the card's text; None to say what the file holds.
        config: of the network.
        about: where the weights come from.
        settings: of the tracker, as JSON text.
        monitor: calibration of the monitor, as JSON text; None without.
        licence: of the weights; empty if unknown.
        version: of the weights; empty if unknown.
        load_as: what to pass to ``quest.load``.
    """
    header = ModelCardData(**{**data, **_licence(licence)}, ignore_metadata_errors=True)
    if text is None:
        rows = [
            ("network", f"preset `{config.preset}`, {config.decoder_layers} layers of width {config.width}"),
            ("encoder", f"ViT of depth {config.encoder.depth}, {config.encoder.image_size} px input"),
            ("window", f"{config.window} frames"),
            ("training", about or "not said"),
            ("monitor", _monitor(monitor)),
            ("licence", licence or "not said"),
            ("version", version or "not said"),
        ]
        table = "\n".join(f"| {name} | {value.replace('|', '/')} |" for name, value in rows)
        text = (
            "# Weights of QueST\n\nFollows handles, knobs, rims and fronts of articulated objects in RGB-D video.\n\n"
            f"| | |\n|---|---|\n{table}\n\nSettings of the tracker: `{settings}`\n"
        )
    use = (
        f"## Use\n\n```sh\npip install {DISTRIBUTION}\nquest track path/to/recording --weights {load_as} "
        f'--out outputs\n```\n\n```python\nimport quest\n\ntracker = quest.load("{load_as}")\n```\n\n'
        "The file is safetensors: tensors in half precision, with configuration, tracker settings and the monitor's "
        "calibration in its metadata. No pickle is needed or loaded.\n"
    )
    return ModelCard(f"---\n{header.to_yaml()}\n---\n\n{text.rstrip()}\n\n{use}", ignore_metadata_errors=True)


def _licence(licence: str) -> dict[str, str]:
    """The licence as the hub wants it told."""
    if not licence:
        return {}
    if licence.lower() in HUB_LICENCES:
        return {"license": licence.lower()}
    return {"license": "other", "license_name": re.sub(r"[^a-z0-9.]+", "-", licence.lower()).strip("-")}


def _monitor(monitor: str | None) -> str:
    return json.loads(monitor).get("about", "calibrated") if monitor else "not calibrated: no alarms"
