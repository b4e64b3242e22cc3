"""The words that are understood: what each is for in a text, what it means, and how that may be said."""

from __future__ import annotations

WORDS: dict[str, dict[str, str]] = {
    "label": {
        "handle": "handle, lever, bar, pull, grip, grab bar, pull bar, pull handle",
        "knob": "knob, doorknob, round handle, round knob",
        "rim": "rim, edge, border, free edge, lip, outer edge, boundary, outline, verge",
        "front": "front, front panel, front side, front plate, face, face plate",
        "hinge": "hinge, pivot, hinge joint, axis",
        "lid": "lid, flap, cover, cap",
        "base": "base, lower half",
        "thing": "thing, something, anything, place",
        "everything": "everything, whatever",
    },
    "panel": {
        "room door": "room door, front door, house door, entrance, entrance door",
        "refrigerator": "refrigerator, fridge, freezer, icebox",
        "cabinet": "cabinet, cupboard, wardrobe, dresser, chest, closet, sideboard, buffet, storage cabinet, "
        "base cabinet, chest of drawers",
        "door": "door, gate",
        "drawer": "drawer, sliding drawer, sliding tray",
    },
    "side": {
        "top": "top, upper, uppermost, topmost, top most, highest, upmost, top to bottom",
        "bottom": "bottom, lower, lowest, bottommost, bottom most, lowermost, undermost, bottom to top",
        "left": "left, leftmost, left most, left hand, far left, left to right",
        "right": "right, rightmost, right most, right hand, far right, right to left",
        "largest": "largest, biggest, bigger, big, larger, large, huge, nearest, closest",
        "smallest": "smallest, smaller, small, little, tiny, farthest, furthest",
    },
    "nth": {
        "-1": "last", "0": "middle, central, centre, center", "1": "first, 1st", "2": "second, 2nd", "3": "third, 3rd",
        "4": "fourth, 4th", "5": "fifth, 5th", "6": "sixth, 6th", "7": "seventh, 7th", "8": "eighth, 8th",
    },
    "count": {
        "1": "one, 1, single", "2": "two, 2", "3": "three, 3", "4": "four, 4", "5": "five, 5", "6": "six, 6",
        "7": "seven, 7", "8": "eight, 8", "all": "all, all of", "both": "both, both of",
        "each": "each, every, each of, every one of, each one of",
    },
    "intent": {
        "open": "open, opens, opening, to open, pull open, pull the, pull it, slide out, pull out, unlatch",
        "lift": "lift, lifts, lifting, to lift, carry, pick up, pick it up, lift up, raise, raise up",
    },
    "of": {"of": "of, on, in, at, belonging to, for, along"},
    "from": {"from": "from, counted from, counting from, starting from, starting at"},
    "and": {"and": "and, or"},
    "": {
        "fill": "the, a, an, its, that, which, who, is, are, this, please, me, us, show, find, track, follow, take, "
        "hold, grasp, grab, use, select, choose, side, hand, number, you, can, i, we, want, it, by, with, to, ones, "
        "any, some",
        "unlike": "not, no, without, except, but, other, than, another, between, next, near, beside, behind, above, "
        "below, under, over, opposite, if, only, half, more, less, fewer, most, outside, inside, rear, back, inner, "
        "outer, long, short, high, close, closer, across, around, against, toward, towards, after, before, until, "
        "never, none, neither, nor, nothing, rest, remaining, same, different",
        "other": "colour, yellow, black, wood, steel, ceramic, seat, sofa, bed, desk, heater, toaster, "
        "kettle, plate, spoon, food, fruit, animal, cat, man, woman, clothes, shoe, rope, paper, book, picture, "
        "ceiling, carpet, house, street, vehicle, tool, screw, wire, machine, music, new, clean, dirty, soft, "
        "round, basket, curtain, tap, garden, office, box, bag",
    },
}  # fmt: skip
"""By what a word is for, and by what it means. Of the last, ``fill`` is read over. ``unlike`` would turn a sentence
around, and ``other`` is about something else: both are not understood, and what is nearest to them neither."""

IMPLIED = {"lid": ("rim", "open"), "base": ("rim", "lift")}
"""Label of what is held where no other is said, and what for."""

ANYTHING = ("thing", "everything")

AGAINST = (
    {"left", "right"}, {"top", "bottom"}, {"largest", "smallest"}, {"open", "lift"}, {"door", "drawer"},
    {"drawer", "room door"}, {"cabinet", "refrigerator"}, {"cabinet", "room door"}, {"refrigerator", "room door"},
)  # fmt: skip
"""Meanings that cannot be those of one thing."""

MEANINGS: dict[str, tuple[str, str]] = {
    " ".join(said.split()): (role, value)
    for role, values in WORDS.items()
    for value, texts in values.items()
    for said in texts.split(",")
}
"""What a word or phrase is for, and what it means."""

LONGEST = max(len(said.split()) for said in MEANINGS)
"""Words of the longest phrase."""
