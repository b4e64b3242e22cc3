"""The description of a take on disk: what older takes lack, and what a digest covers."""

import dataclasses
import hashlib
import json

from quest.data.take_format import TakeHash, info_from_json
from tests.synthetic import make_take


def test_takes_from_before_there_were_suites_read_and_keep_their_digest() -> None:
    info = make_take(frames=2, entities=1).info
    fields = json.loads(json.dumps(dataclasses.asdict(info)))
    del fields["suite"]
    assert info_from_json(fields) == info
    assert info.suite == "standard"
    described = {name: value for name, value in fields.items() if name != "provenance"} | {"cameras": []}
    assert TakeHash(info, ()).hexdigest() == hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


def test_the_suite_is_part_of_the_description() -> None:
    info = make_take(frames=2, entities=1).info
    hard = dataclasses.replace(info, suite="occlusion")
    assert info_from_json(json.loads(json.dumps(dataclasses.asdict(hard)))) == hard
    assert TakeHash(hard, ()).hexdigest() != TakeHash(info, ()).hexdigest()
