"""What a text such as "the lever of the left door" means."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from quest.errors import InputError
from quest.text.encoder import nearest
from quest.text.words import AGAINST, ANYTHING, IMPLIED, LONGEST, MEANINGS, WORDS

_SUPERLATIVE = {"top": "topmost", "bottom": "lowest", "left": "leftmost", "right": "rightmost"}


@dataclass(frozen=True)
class Which:
    """Which ones of several."""

    nouns: tuple[str, ...] = ()
    """Labels, of which it has one, or kinds of panels, all of which it is; empty for anything."""
    sides: tuple[str, ...] = ()
    """Where it is among them, such as ``left``, or what it is, ``largest``; one after the other."""
    nth: int | None = None
    """Its place: 1 for the first, 0 for the middle one, -1 for the last."""
    origin: str | None = None
    """The side from which places are counted."""
    count: str = "1"
    """How many: a number, ``all``, ``both``, or ``each`` for one after the other."""

    @property
    def plain(self) -> bool:
        """Whether any one will do."""
        return self.count == "1" and self.nth is None and not self.sides

    def noun(self, *, several: bool) -> str:
        """What it is, in words."""
        if not self.nouns:
            return "places to hold" if several else "place to hold"
        if self.nouns[0] in WORDS["panel"]:
            return " ".join(self.nouns) + "s" * several
        return " or ".join(noun + "s" * several for noun in self.nouns)

    def __str__(self) -> str:
        place = "" if self.nth is None else WORDS["nth"][str(self.nth)].split(",")[0]
        count = "" if self.count == "1" else self.count
        sides = " ".join(_SUPERLATIVE.get(side, side) if self.count == "1" else side for side in self.sides)
        words = (place, count, "" if place else sides, self.noun(several=self.count not in ("1", "each")))
        counted = f" from the {self.origin}" if place else ""
        return " ".join(filter(None, words)) + counted + f" among the {sides}" * bool(place and sides)

    @property
    def named(self) -> str:
        """The same with its article."""
        return ("a " if self.plain else "the " if self.count == "1" else "") + str(self)


@dataclass(frozen=True)
class Meaning:
    """What a text means; as a string it says how the text was understood."""

    thing: Which
    """What is taken hold of."""
    panel: Which | None = None
    """The doors or drawers that it is on; None where none are said."""
    intent: str | None = None
    """One of :data:`quest.types.INTENTS`, or None for either."""
    likened: tuple[tuple[str, str], ...] = ()
    """Words that are in no table, and what they were taken to mean."""

    @property
    def by_panel(self) -> bool:
        """Whether one is meant on every one of several doors or drawers."""
        return self.panel is not None and self.panel.count != "1" and self.thing.count == "1"

    @property
    def single(self) -> bool:
        """Whether it means one thing."""
        return self.thing.count == "1" and not self.by_panel

    def __str__(self) -> str:
        text = str(self.thing) + (f", to {self.intent}" if self.intent else "")
        text += f", on {self.panel.named}" if self.panel is not None else ""
        return text + "".join(f" ({word!r} read as {value})" for word, value in self.likened)


@dataclass(frozen=True)
class _Said:
    """A word or phrase of a text."""

    word: str
    role: str
    value: str
    plural: bool = False
    likened: bool = False


@lru_cache(maxsize=256)
def understand(text: str) -> Meaning:
    """What a text means.

    Modifiers belong to the noun that follows, or to the one in front of them where "of", "on" or the end follows. In
    "top drawer handles" they are the drawer's; numbers and "all" are the handles'.

    Args:
        text: such as "the lever of the left door"; the words are those of :data:`quest.text.words.WORDS`, and with the
            extra ``text`` words that are near to one of them.

    Raises:
        InputError: a word is not understood, or the words contradict each other or name nothing.
        MissingExtraError: a word is in no table, and the extra is not installed.
    """
    try:
        return _meaning(list(_read(text)))
    except InputError as error:
        raise InputError(f"text {text!r}: {error}") from error


def _read(text: str) -> Iterator[_Said]:
    """Words and phrases, without those that say nothing; numbers after a noun and sides after "from" count places."""
    plain = unicodedata.normalize("NFKD", text.casefold().replace("’", "'"))
    words = re.findall(r"[a-z0-9]+|'s?(?![a-z])", "".join(c for c in plain if not unicodedata.combining(c)))
    before, counting = "", False
    while words:
        said = _first(words)
        words = words[len(said.word.split()) :]
        if said.value == "fill":
            continue
        if not said.role:
            raise InputError(f"does not understand {said.word!r}")
        if said.role == "side" and counting:
            said = replace(said, role="origin")
        elif said.role == "count" and said.value.isdigit() and before in ("label", "panel"):
            said = replace(said, role="nth")
        counting, before = said.role in ("from", "origin"), said.role
        yield said


def _first(words: Sequence[str]) -> _Said:
    """The longest phrase that is known at the beginning, or what is nearest to the first word."""
    if words[0].startswith("'"):
        return _Said(words[0], "of", "of")
    for length in range(LONGEST, 0, -1):
        phrase = " ".join(words[:length])
        for known in (phrase, phrase.removesuffix("s"), phrase.removesuffix("es")):
            role, value = MEANINGS.get(known, ("", ""))
            if value and (known == phrase or role in ("label", "panel")):
                return _Said(phrase, role, value, plural=known != phrase)
    word = words[0]
    return _Said(word, *nearest(word), plural=word.endswith("s") and not word.endswith("ss"), likened=True)


def _meaning(sentence: Sequence[_Said]) -> Meaning:
    """The meaning of words."""
    clauses: dict[str, list[_Said]] = {"label": [], "panel": []}
    held: list[_Said] = []  # whose noun has not come
    last, before, one_of, intents = None, "", False, []
    for said in sentence:
        if "and" in (said.role, before) and "label" not in (said.role, before):
            raise InputError('"and" joins handles, knobs and the like only; ask for each by itself')
        if said.role == "intent":
            intents.append(said.value)
        elif said.role == "of":
            if last is not None:
                clauses[last] += held
                held = []
            elif held and all(h.role != "count" or h.value == "1" for h in held):
                one_of = True  # "the left of the two doors"
        elif said.role in clauses:
            if one_of:
                held, said, one_of = [h for h in held if h.role != "count"], replace(said, plural=False), False
            last = said.role
            later = [h for h in held if h.role == "count" and last == "panel"]
            clauses[last] += [*(h for h in held if h not in later), said]
            held = later
        elif said.role not in ("and", "from"):
            numbered = said.role == "nth" and before in clauses  # "drawer 3"
            (clauses[before] if numbered else held).append(said)
        before = said.role
    clauses[last or "label"] += held
    named = [s.value for s in clauses["label"] if s.role == "label" and s.value not in (*IMPLIED, *ANYTHING)]
    if len(named) > 1 + sum(said.role == "and" for said in sentence):
        raise InputError(f"{named[0]} and {named[-1]} are two things; ask for each by itself")
    if not clauses["label"] and not clauses["panel"]:
        raise InputError("names nothing to take hold of; such as 'handle of the left door'")
    labels, panels = _values(clauses["label"], "label"), _values(clauses["panel"], "panel")
    implied = [IMPLIED[label] for label in labels if label in IMPLIED]
    labels = [x for x in labels if x not in (*IMPLIED, *ANYTHING)] or [label for label, _ in implied]
    intents += [intent for _, intent in implied]
    _check_agree(intents)
    return Meaning(
        _which(clauses["label"], labels),
        _which(clauses["panel"], panels) if panels else None,
        intents[0] if intents else None,
        tuple((said.word, said.value) for said in sentence if said.likened),
    )


def _values(clause: Sequence[_Said], role: str) -> list[str]:
    """What was said of a kind, each once, in the order of the table."""
    said = {s.value for s in clause if s.role == role}
    return [value for value in WORDS["side" if role == "origin" else role] if value in said]


def _which(clause: Sequence[_Said], nouns: list[str]) -> Which:
    """All that was said about a noun."""
    sides, nth, origin, counts = (_values(clause, role) for role in ("side", "nth", "origin", "count"))
    _check_agree(nouns, sides)
    several = any(said.plural or said.value == "everything" for said in clause)
    origin = origin or [side for side in sides if nth and side not in _SUPERLATIVE]  # "second largest"
    sides = [side for side in sides if side not in origin or side in _SUPERLATIVE]
    count = counts[-1] if counts else "all" if several and not nth else "1"
    number = count.isdigit() and count != "1"
    if (
        max(len(nth), len(origin), len(counts)) > 1
        or (origin and not nth)
        or (number and nth not in ([], ["1"], ["-1"]))
    ):
        words = " ".join(said.word for said in clause)
        raise InputError(f"{words!r} does not say which; such as 'the second from the left', 'the last two'")
    beside = set(sides) & {"top", "bottom"} if sides else "drawer" not in nouns
    counted_from = (origin or ["left" if beside else "top"])[0] if nth else None
    return Which(tuple(nouns), tuple(sides), int(nth[0]) if nth else None, counted_from, count)


def _check_agree(*said: Sequence[str]) -> None:
    for values in said:
        for pair in AGAINST:
            if pair <= set(values):
                raise InputError(f"{' and '.join(sorted(pair))} is not of one thing; ask for each by itself")
