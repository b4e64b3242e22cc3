"""Weights on the Hugging Face hub: one file of a model repository, its card, and the errors on the way."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from huggingface_hub import (
    ModelCard,
    ModelCardData,
    constants,
    get_hf_file_metadata,
    hf_hub_download,
    hf_hub_url,
)
from huggingface_hub.errors import (
    GatedRepoError,
    HfHubHTTPError,
    HFValidationError,
    LocalEntryNotFoundError,
    LocalTokenNotFoundError,
    RemoteEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.errors import HTTPError as TransportError  # pyright: ignore[reportPrivateImportUsage]

from quest.errors import WeightsError
from quest.extras import DISTRIBUTION
from quest.model.finder import FinderConfig

FILE = "model.safetensors"
"""The file of a repository that holds the network."""

LIBRARY = DISTRIBUTION
"""What the hub calls this library."""

_ID = re.compile(r"(?P<repo>[\w.-]+/[\w.-]+?)(@(?P<revision>[^@\s]+))?")


@dataclass(frozen=True)
class HubId:
    """A model repository at a revision."""

    repo: str
    """``owner/name``."""
    revision: str | None = None
    """Branch, tag or commit; None for the newest."""

    @classmethod
    def parse(cls, text: str) -> HubId | None:
        """``owner/name`` or ``owner/name@revision``; None if the text is neither, such as the path of a file."""
        match = _ID.fullmatch(text)
        if match is None or match["repo"].endswith(".safetensors") or match["repo"].startswith("."):
            return None
        return cls(match["repo"], match["revision"])

    @property
    def page(self) -> str:
        """Address of the repository's page."""
        return f"{constants.ENDPOINT}/{self.repo}"

    def __str__(self) -> str:
        return self.repo if self.revision is None else f"{self.repo}@{self.revision}"


def download(
    hub_id: HubId,
    *,
    force_download: bool = False,
    token: str | bool | None = None,
    cache_dir: str | Path | None = None,
    local_files_only: bool = False,
) -> Path:
    """The weights of a repository as a file of the hub's cache; a file that is there needs no network.

    Args:
        hub_id: the repository.
        force_download: whether to download files that the cache has.
        token: of the hub; the one that ``hf auth login`` stored by default.
        cache_dir: of the hub's files.
        local_files_only: whether only the cache is looked at.

    Raises:
        WeightsError: there is no such repository, revision or file, it is not open to this user, or the hub cannot be
            reached and the cache has no copy.
    """
    with explained(hub_id):
        path = hf_hub_download(
            hub_id.repo,
            FILE,
            revision=hub_id.revision,
            library_name=LIBRARY,
            force_download=force_download,
            token=token,
            cache_dir=cache_dir,
            local_files_only=local_files_only or not _answers(hub_id, token),
        )
    return Path(path)


def _answers(hub_id: HubId, token: str | bool | None) -> bool:
    """Whether the hub can be reached, asked once: the library would ask six times and complain each time."""
    url = hf_hub_url(hub_id.repo, FILE, revision=hub_id.revision)
    try:
        get_hf_file_metadata(url, timeout=constants.HF_HUB_ETAG_TIMEOUT, token=token)
    except HfHubHTTPError:
        return True  # with a refusal, which the download explains
    except (OSError, TransportError):
        return False
    return True


_HERE = "(and no file or folder here is called so)"
_EXPLAINED: tuple[tuple[type[Exception], str], ...] = (  # the first that fits: the second is the parent of the first
    (GatedRepoError, "the repository is gated; accept the terms on {page}, then log in with `hf auth login`"),
    (
        RepositoryNotFoundError,
        f"{{hub}} has no such model repository, or it is private {_HERE}; check the spelling, or log in with "
        "`hf auth login`",
    ),
    (RevisionNotFoundError, "the repository has no such branch, tag or commit; see {page}"),
    (
        RemoteEntryNotFoundError,
        f"expected a repository with {FILE}, it has none; other formats (pickles above all) are not loaded; write it "
        "with `quest weights push`",
    ),
    (
        LocalEntryNotFoundError,
        f"{{hub}} cannot be reached, and the cache ({{cache}}) has no copy {_HERE}; connect once, or pass the path of "
        "a file",
    ),
    (HFValidationError, "not an id of the hub ({said}); expected owner/name"),
    (LocalTokenNotFoundError, "nobody is logged in; log in with `hf auth login`"),
    (HfHubHTTPError, "the hub answered with status {status} ({said}); {advice}"),
    # The connection broke on the way, or the disk is full.
    (OSError, "cannot be fetched or sent ({said}); connect and try again"),
    (TransportError, "cannot be fetched or sent ({said}); connect and try again"),
)


@contextmanager
def explained(hub_id: HubId) -> Iterator[None]:
    """Turn errors of the hub about a repository into ours, which say what to do."""
    try:
        yield
    except tuple(kind for kind, _ in _EXPLAINED) as error:
        words = next(words for kind, words in _EXPLAINED if isinstance(error, kind))
        status = error.response.status_code if isinstance(error, HfHubHTTPError) else 0
        advice = "log in with `hf auth login` as someone who may" if status in (401, 403) else "try again later"
        said = (str(error).strip().splitlines() or [type(error).__name__])[0]
        told = {"page": hub_id.page, "hub": constants.ENDPOINT, "cache": constants.HF_HUB_CACHE}
        raise WeightsError(f"{hub_id}: {words.format(**told, said=said, status=status, advice=advice)}") from error


TAGS = ("articulated-objects", "object-tracking", "point-tracking", "rgb-d", "robotics")
"""What the hub finds the weights by."""

HUB_LICENCES = frozenset({"apache-2.0", "mit", "bsd-2-clause", "bsd-3-clause", "cc-by-4.0", "cc-by-nc-4.0", "cc0-1.0"})
"""Licences that the hub knows by these words; every other one is called ``other`` there, with its name."""


def model_card(
    data: Mapping[str, Any],
    *,
    text: str | None,
    config: FinderConfig,
    about: str,
    settings: str,
    licence: str,
    version: str,
    load_as: str,
) -> ModelCard:
    """A card of weights, with what the hub is told beside the licence.

    Its text is made from the rest if None; ``load_as`` is what to pass to ``quest.load``.
    """
    header = ModelCardData(**{**data, **_licence(licence)}, ignore_metadata_errors=True)
    if text is None:
        rows = [
            ("network", f"finder, pyramid of width {config.width}"),
            ("encoder", f"ViT of depth {config.encoder.depth} and width {config.encoder.width}, EfficientNet-Lite0"),
            ("training", about or "not said"),
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
        "The file is safetensors: tensors in half precision, with configuration and tracker settings in its metadata. "
        "No pickle is needed or loaded.\n"
    )
    return ModelCard(f"---\n{header.to_yaml()}\n---\n\n{text.rstrip()}\n\n{use}", ignore_metadata_errors=True)


def _licence(licence: str) -> dict[str, str]:
    """The licence as the hub wants it told."""
    if not licence:
        return {}
    if licence.lower() in HUB_LICENCES:
        return {"license": licence.lower()}
    return {"license": "other", "license_name": re.sub(r"[^a-z0-9.]+", "-", licence.lower()).strip("-")}
