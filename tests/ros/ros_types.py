"""Classes of ROS 2 messages as strict as those of rclpy, made of the definitions; rosbags serialises them."""

from __future__ import annotations

import array
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).parents[2] / "quest_ros"
MESSAGES = ROOT / "quest_msgs"
INTEGERS = {f"{sign}int{bits}": bits for bits in (8, 16, 32, 64) for sign in ("", "u")}
FLOATS = {"float32": np.float32, "float64": np.float64}


@cache
def types_of(distribution: str) -> Types:
    return Types(Stores[f"ROS2_{distribution.upper()}"])


class Types:
    """Gives the class of messages of a name; requests and responses are ``package/srv/Name_Request``."""

    def __init__(self, distribution: Stores) -> None:
        self.store = get_typestore(distribution)
        for path in sorted(MESSAGES.glob("msg/*.msg")):
            self.store.register(get_types_from_msg(path.read_text(), f"quest_msgs/msg/{path.stem}"))
        services = {path.stem: path.read_text() for path in MESSAGES.glob("srv/*.srv")}
        for name, text in services.items():
            for half, part in zip(("Request", "Response"), text.split("\n---\n"), strict=True):
                self.store.register(get_types_from_msg(part, f"quest_msgs/msg/{name}_{half}"))
        for half, part in (("Request", ""), ("Response", "bool success\nstring message")):
            self.store.register(get_types_from_msg(part, f"std_srvs/msg/Trigger_{half}"))
        self._classes: dict[str, Any] = {}

    def __call__(self, name: str) -> Any:
        name = name.replace("/srv/", "/msg/")  # as rosbags knows them
        if name not in self._classes:
            constants, fields = self.store.fielddefs[name]
            values = {key: bytes([int(value)]) if kind == "byte" else value for key, kind, value in constants}
            self._classes[name] = type(
                name.rpartition("/")[2], (Message,), {**values, "types_": self, "fields_": fields, "kind_": name}
            )
        return self._classes[name]

    def serialise(self, message: Message) -> bytes:
        """As it goes over the wire."""
        return bytes(self.store.serialize_cdr(self._native(message), message.kind_))

    def again(self, message: Message) -> Any:
        """What another node would receive."""
        return self.store.deserialize_cdr(self.serialise(message), message.kind_)

    def _native(self, value: Any) -> Any:
        if isinstance(value, Message):
            return self.store.types[value.kind_](
                **{name: self._native(getattr(value, name)) for name, _ in value.fields_}
            )
        if isinstance(value, list):
            return [self._native(each) for each in value]
        if isinstance(value, array.array):
            return np.array(value)
        return value[0] if isinstance(value, bytes) else value


class Message:
    """A message: its fields are keyword arguments, checked as rclpy checks them."""

    types_: Types
    fields_: list[tuple[str, Any]]
    kind_: str

    def __init__(self, **given: Any) -> None:
        for name, what in self.fields_:
            value = given.pop(name) if name in given else self._default(what)
            setattr(self, name, value)
        assert not given, f"{self.kind_} has no {', '.join(given)}"

    def __setattr__(self, name: str, value: Any) -> None:
        what = dict(self.fields_)[name]
        assert self._fits(what, value), f"{self.kind_}.{name} cannot be {value!r}"
        super().__setattr__(name, value)

    def _default(self, what: Any) -> Any:
        node, of = what
        if node == Nodetype.NAME:
            return self.types_(of)()
        if node == Nodetype.BASE:
            return {"bool": False, "string": "", "byte": b"\0", **dict.fromkeys(FLOATS, 0.0)}.get(of[0], 0)
        (inner, element), length = of
        if node == Nodetype.ARRAY and inner == Nodetype.BASE:
            return np.zeros(length, element[0])
        return [] if element[0] != "uint8" else array.array("B")

    def _fits(self, what: Any, value: Any) -> bool:
        node, of = what
        if node == Nodetype.NAME:
            return isinstance(value, Message) and value.kind_ == of
        if node == Nodetype.BASE:
            return _fits_base(of[0], value)
        (inner, element), length = of
        if inner == Nodetype.NAME:
            return isinstance(value, list) and all(self._fits((inner, element), each) for each in value)
        if node == Nodetype.ARRAY:
            return isinstance(value, np.ndarray) and value.dtype == element[0] and value.shape == (length,)
        if isinstance(value, array.array):
            return element[0] == "uint8"
        return isinstance(value, list) and all(_fits_base(element[0], each) for each in value)


def _fits_base(kind: str, value: Any) -> bool:
    if kind in INTEGERS:
        low = 0 if kind.startswith("u") else -(2 ** (INTEGERS[kind] - 1))
        return type(value) is int and low <= value < low + 2 ** INTEGERS[kind]
    if kind in FLOATS:
        return isinstance(value, float) and (not math.isfinite(value) or abs(value) <= np.finfo(FLOATS[kind]).max)
    return type(value) is {"bool": bool, "string": str, "byte": bytes}[kind] and (kind != "byte" or len(value) == 1)
