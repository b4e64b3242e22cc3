"""Files of trained networks: one safetensors file with tensors, configuration and settings."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import ModelCard, PyTorchModelHubMixin
from torch import nn

from quest.errors import ConfigError, WeightsError
from quest.model.encoder import read_into
from quest.model.finder import FinderConfig, FinderNetwork
from quest.model.hub import FILE, LIBRARY, TAGS, HubId, download, explained, model_card
from quest.model.tensor_file import fetch_shared, read_tensors, save_half

FORMAT = "quest-finder-5"

DEFAULTS = {"quest-s16": "quest-s16-apache"}
"""Names that leave the licence open, and which of the weights that ship they stand for."""

FOLDER_FILES = (FILE, "weights.safetensors")
"""What a folder is searched for: what ``save_pretrained`` writes, then what ``quest train`` writes."""


@dataclass(frozen=True)
class LoadedNetwork(PyTorchModelHubMixin, library_name=LIBRARY, tags=list(TAGS), pipeline_tag="robotics"):
    """A network read from a file, with everything else that the file holds.

    It saves itself to folders and to the Hugging Face hub: ``from_pretrained``, ``save_pretrained`` and
    ``push_to_hub`` are those of :class:`huggingface_hub.PyTorchModelHubMixin`. The folder or repository gets the one
    file ``model.safetensors``, which loses nothing, a model card, and a ``config.json`` for people, which is not read.
    """

    name: str
    """Name, path or hub id that it was asked for by."""
    path: Path
    """File that it came from."""
    network: FinderNetwork
    """In evaluation mode, on the CPU."""
    settings: str
    """Settings of the tracker that were chosen with these weights, as JSON text."""
    about: str
    """Where the weights come from."""
    sha256: str
    """Of the file."""
    licence: str = ""
    """Under which the weights may be used; empty if the file does not say."""
    version: str = ""
    """Of the weights; empty if the file does not say."""

    # The mixin would set one from the arguments, but this class is frozen and its files carry their own.
    _hub_mixin_config = {"format": FORMAT}  # noqa: RUF012

    def save(self, path: Path, *, beside: Path | None = None) -> None:
        """Write everything to a file, as :func:`save_network`; :func:`dataclasses.replace` changes something first."""
        save_network(
            path,
            self.network,
            settings=self.settings,
            about=self.about,
            licence=self.licence,
            version=self.version,
            beside=beside,
        )

    @classmethod
    def from_pretrained(
        cls,
        pretrained_model_name_or_path: str | Path,
        *,
        force_download: bool = False,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        revision: str | None = None,
    ) -> LoadedNetwork:
        """Read a network from a folder that ``save_pretrained`` wrote, or from the hub.

        Args:
            pretrained_model_name_or_path: a folder, or ``owner/name`` on the hub, optionally ``owner/name@revision``.
            force_download: whether to download what the cache has.
            token: of the hub; the one that ``hf auth login`` stored by default.
            cache_dir: of the hub's files.
            local_files_only: whether only the cache is looked at.
            revision: branch, tag or commit.

        Raises:
            WeightsError: neither has such weights, the hub cannot be reached and the cache has no copy, or the file is
                torn, foreign, or of another shape.
        """
        name = str(pretrained_model_name_or_path)
        if Path(name).is_dir():
            return load_network(Path(name))
        hub_id = HubId.parse(name)
        if hub_id is None:
            raise WeightsError(f"{name}: expected a folder, or owner/name on the hub, and it is neither")
        path = download(
            HubId(hub_id.repo, revision or hub_id.revision),
            force_download=force_download,
            token=token,
            cache_dir=cache_dir,
            local_files_only=local_files_only,
        )
        return read_network(path, name=name)

    def push_to_hub(self, repo_id: str, **arguments: Any) -> str:
        """Write the file, the card and the configuration to a repository, which is made if there is none.

        Args:
            repo_id: ``owner/name``.
            arguments: those of the mixin: ``private``, ``branch``, ``create_pr``, ``token``, ``commit_message``.

        Returns:
            Address of the commit.

        Raises:
            WeightsError: nobody is logged in, may not write there, or the hub cannot be reached.
        """
        arguments = {"commit_message": "Weights of QueST", "model_card_kwargs": {"repo_id": repo_id}, **arguments}
        with explained(HubId(repo_id)):
            return super().push_to_hub(repo_id, **arguments)

    def generate_model_card(self, *, repo_id: str | None = None) -> ModelCard:
        """The card: the text beside the file if there is one (the same name, ending in ``.md``), else what it holds."""
        beside = self.path.with_suffix(".md")
        return model_card(
            self._hub_mixin_info.model_card_data.to_dict(),
            text=beside.read_text(encoding="utf-8") if beside.is_file() else None,
            config=self.network.config,
            about=self.about,
            settings=self.settings,
            licence=self.licence,
            version=self.version,
            load_as=repo_id or "path/to/this/folder",
        )

    def _save_pretrained(self, save_directory: Path) -> None:
        self.save(save_directory / FILE)
        config = {"library_name": LIBRARY, "format": FORMAT, "network": asdict(self.network.config)}
        (save_directory / "config.json").write_text(json.dumps(config, indent=2, sort_keys=True) + "\n")


def save_network(
    path: Path,
    network: FinderNetwork,
    *,
    settings: str,
    about: str,
    licence: str = "",
    version: str = "",
    beside: Path | None = None,
) -> None:
    """Write a network in half precision, atomically.

    Args:
        path: file to write.
        network: the network with its encoder.
        settings: settings of the tracker, as JSON text.
        about: where the weights come from, a line for people.
        licence: under which the weights may be used, such as ``Apache-2.0``; empty to say nothing.
        version: of the weights; empty to say nothing.
        beside: file of another network that will lie in the same folder or ships; parts that both have, such as the
            encoder, are left out and read from there.

    Raises:
        WeightsError: the other network has no part in common or cannot be read, or the file cannot be written.
    """
    metadata = {"format": FORMAT, "config": network.config.to_json(), "settings": settings, "about": about}
    metadata |= {key: value for key, value in (("licence", licence), ("version", version)) if value}
    save_half(network, path, metadata=metadata, beside=beside)


def weights_digest(module: nn.Module, *, beside: str = "") -> str:
    """SHA-256 of all weights of a module, and of a text that goes with them, in hexadecimal."""
    digest = hashlib.sha256(beside.encode())
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def shipped_weights() -> dict[str, Path]:
    """Name and file of every network that comes with the package; :data:`DEFAULTS` come first."""
    folder = resources.files("quest") / "assets" / "weights"
    if not folder.is_dir():
        return {}
    found = [Path(str(entry)) for entry in folder.iterdir() if entry.name.endswith(".safetensors")]
    files = {path.stem: path for path in sorted(found)}
    return {name: files[stem] for name, stem in DEFAULTS.items() if stem in files} | files


def load_network(name: str | Path) -> LoadedNetwork:
    """Read a network by name of shipped weights, by path, or by its id on the Hugging Face hub.

    Args:
        name: a shipped name; a file; a folder that ``save_pretrained`` or ``quest train`` wrote; or ``owner/name`` of
            a model repository, optionally ``owner/name@revision``. What is there as a file or folder is not looked
            for on the hub, nor is ``runs/mine`` where there is a folder ``runs`` here, unless it names a revision.
            What was downloaded once works without a network.

    Raises:
        WeightsError: no such name, file or repository, or the file is torn, foreign, or of another shape.
    """
    return read_network(find_weights(name), name=str(name))


def find_weights(name: str | Path) -> Path:
    """The file of weights by their name, as for :func:`load_network`; fetched from the hub if it is there.

    Raises:
        WeightsError: no such name, file or repository.
    """
    path = shipped_weights().get(str(name), Path(name))
    if path.is_dir():
        path = next((path / file for file in FOLDER_FILES if (path / file).is_file()), path)
    if path.is_file():
        return path
    known = ", ".join(shipped_weights()) or "none"
    hub_id = None if isinstance(name, Path) or path.exists() else HubId.parse(name)
    if hub_id is not None and hub_id.revision is None and path.parent.is_dir():
        raise WeightsError(
            f"{name}: no such weights in the folder {path.parent}, which is here; check the spelling. If the Hugging "
            f"Face hub is meant, name a revision: {name}@main"
        )
    if hub_id is None:
        raise WeightsError(
            f"{name}: no such weights; expected a safetensors file, a folder with {' or '.join(FOLDER_FILES)}, a "
            f"shipped name ({known}), or owner/name on the Hugging Face hub"
        )
    return download(hub_id)


def read_network(path: Path, *, name: str) -> LoadedNetwork:
    """Read a network from a file that was asked for by a name.

    Raises:
        WeightsError: the file is torn, foreign, or of another shape, or shares parts with one that is not there.
    """
    metadata, state = read_tensors(path)
    if metadata.get("format") != FORMAT:
        raise WeightsError(
            f"{path}: expected a network of format {FORMAT!r}, got {metadata.get('format')!r}; "
            "make it with `quest train --stage find` (encoder weights alone are no network; the published network, "
            "preset paper, is read by `quest eval`)"
        )
    try:
        config = FinderConfig.from_json(metadata["config"])
    except (ConfigError, KeyError) as error:
        raise WeightsError(f"{path}: {error}; the file is of another version of quest") from error
    state |= fetch_shared(path, metadata, shipped_weights())
    state = {k: v.to(torch.float32) for k, v in state.items()}
    network = read_into(lambda: FinderNetwork(config), state, what=f"weights {path}")
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    settings, about, licence, version = (metadata.get(key, "") for key in ("settings", "about", "licence", "version"))
    return LoadedNetwork(name, path, network.eval(), settings or "{}", about, sha256, licence, version)
