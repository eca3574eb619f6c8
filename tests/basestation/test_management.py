"""Commands of users on maps: list, get, name, merge, split, delete."""

import copy
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import VERBS, Answer, Command, submap_name
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.store.integrity import contradictions
from kiteline_basestation.store.state_texts import state_of, texts_of
from kiteline_codec.schema import (
    CameraIntrinsics,
    CulledLandmarks,
    KeyframeHeader,
    LivePose,
    Record,
    SubmapPlacement,
)
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, SubmapId, submap_id, submap_of_keyframe

MakeFlight = Callable[..., Any]
STEP_NS = 250_000_000
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


class Base:
    """A mapper, and whoever commands it."""

    def __init__(self, words: Any) -> None:
        self.mapper = Mapper(BaseConfig(), words)
        self.now_ns = 0
        self.published: list[Record] = []
        self._done: tuple[JobDone, ...] = ()

    def step(self, arrivals: Any = (), commands: Sequence[Command] = ()) -> tuple[Answer, ...]:
        self.now_ns += STEP_NS
        output = self.mapper.step(MapperInput(tuple(arrivals), self._done, tuple(commands)), self.now_ns)
        self._done = tuple(run_job(job) for job in output.jobs)
        for _, out in output.publish:
            self.published.extend(out)
        return output.answers

    def fly(self, flights: Sequence[Any]) -> None:
        for n in range(max(len(f.records) for f in flights) + 40):
            arrivals = []
            for flight in flights:
                records: list[Record] = [CameraIntrinsics(flight.agent, flight.camera)] if n == 0 else []
                arrivals.append((flight.agent, (*records, *(flight.records[n] if n < len(flight.records) else ()))))
            self.step(arrivals)

    def rest(self, steps: int = 60) -> None:
        for _ in range(steps):
            self.step()

    def ask(self, verb: str, **given: Any) -> dict[str, Any]:
        (answer,) = self.step(commands=[Command(7, verb, json.dumps(given))])
        assert answer.id == 7
        value: dict[str, Any] = json.loads(answer.text)
        assert ("error" not in value) == answer.ok
        assert contradictions(self.mapper) == []
        return value


def ids(value: dict[str, Any]) -> list[str]:
    return [m["id"] for m in value["maps"]]


@pytest.fixture(scope="module")
def flown_pair(make_flight: MakeFlight, words: Any) -> Base:
    """Two agents in one room, whose maps have become one."""
    base = Base(words)
    a = make_flight(keyframes=20, turns=0.6)
    b = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    base.fly([a, b])
    assert base.mapper.summary()["merges"] == 1
    return base


@pytest.fixture
def pair(flown_pair: Base) -> Base:
    """A copy of it, which a test may change."""
    return copy.deepcopy(flown_pair)


def test_list_and_get_describe_all_maps(pair: Base) -> None:
    (told,) = pair.ask("list")["maps"]
    assert told["id"] == "0.1.0"
    assert told["agents"] == [0, 1]
    assert told["placed"] is True
    assert [s["id"] for s in told["submaps"]] == ["0.1.0", "1.1.0"]
    assert told["keyframes"] == 40 == sum(s["keyframes"] for s in told["submaps"])
    assert told["points"] == len(pair.mapper.map.live_landmarks())
    got = pair.ask("get", map="1.1.0")
    assert got["id"] == "0.1.0"
    submap = got["submaps"][1]
    assert np.allclose(np.reshape(submap["T_map_m"], (4, 4)), ELSEWHERE, atol=0.05)
    pose = submap["poses"][3]
    held = pair.mapper.map.pose(KeyframeId(pose["id"]))
    assert held is not None
    assert np.array_equal(np.reshape(pose["T_m_k"], (4, 4)), held)


def test_map_can_be_addressed_by_name(pair: Base) -> None:
    assert pair.ask("name", map="1.1.0", name="hangar")["name"] == "hangar"
    assert pair.ask("get", map="hangar")["id"] == "0.1.0"
    assert "characters" in pair.ask("name", map="hangar", name="x" * 65)["error"]
    assert "taken" in pair.ask("name", map="hangar", name="3.4.5")["error"]
    assert pair.ask("name", map="hangar", name="")["name"] == ""
    assert "no map 'hangar'" in pair.ask("get", map="hangar")["error"]


def test_split_maps_are_not_merged_again(pair: Base, make_flight: MakeFlight) -> None:
    assert ids(pair.ask("split", map="1.1.0")) == ["0.1.0", "1.1.0"]
    assert ids(pair.ask("list")) == ["0.1.0", "1.1.0"]
    kept = texts_of(pair.mapper.state())  # a set, which JSON has not, ended a base with a store
    assert state_of(kept).merger.detector.kept_apart == tuple(pair.mapper.merger.detector.kept_apart)
    more = make_flight(keyframes=30, turns=0.9, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    for records in more.records[20:]:
        pair.step([(more.agent, tuple(records))])
    pair.rest()
    assert ids(pair.ask("list")) == ["0.1.0", "1.1.0"]
    assert "nothing to be undone" in pair.ask("split", map="1.1.0")["error"]


def test_replies_tell_what_the_command_made_of_the_maps(pair: Base) -> None:
    """The reply to a split called the map placed, and that to a merge told where its submaps lay before."""
    assert pair.ask("split", map="1.1.0") == pair.ask("list")
    merged = pair.ask("merge", map="1.1.0", into="0.1.0", T_into_map=ELSEWHERE.ravel().tolist())
    (told,) = pair.mapper._manager._list({}, 0)[0]["maps"]  # the next step fuses more landmarks
    assert merged == {"merged": True, **told}


def test_a_map_that_is_deleted_in_the_step_of_its_split_does_no_harm(pair: Base) -> None:
    commands = [Command(1, "split", '{"map": "1.1.0"}'), Command(2, "delete", '{"map": "1.1.0"}')]
    split, deleted = pair.step(commands=commands)
    assert split.ok and deleted.ok
    assert ids(pair.ask("list")) == ["0.1.0"]
    T = json.dumps({"map": "0.1.0", "into": "1.1.0"})
    (refused,) = pair.step(commands=[Command(3, "merge", T)])
    assert not refused.ok


def test_split_maps_are_merged_again_where_a_user_asks_for_it(pair: Base) -> None:
    """The search of `merge` passed over all that a split keeps apart, so that it never found anything."""
    pair.ask("split", map="1.1.0")
    assert pair.ask("merge", map="1.1.0", into="0.1.0") == {"merged": False, "looking": 20}
    pair.rest()
    assert ids(pair.ask("list")) == ["0.1.0"]


def test_user_merges_maps_by_a_transform(make_flight: MakeFlight, words: Any) -> None:
    base = Base(words)
    a = make_flight(keyframes=14, turns=0.3)
    b = make_flight(keyframes=14, turns=0.3, start=0.5, variant=1, agent=1, T_w_m=ELSEWHERE)
    base.fly([a, b])
    assert ids(base.ask("list")) == ["0.1.0", "1.1.0"]
    assert "rigid" in base.ask("merge", map="1.1.0", into="0.1.0", T_into_map=[1.0] * 16)["error"]
    T = ELSEWHERE.ravel().tolist()
    assert base.ask("merge", map="1.1.0", into="0.1.0", T_into_map=T)["merged"] is True
    base.rest()
    (told,) = base.ask("list")["maps"]
    assert told["keyframes"] == 28
    placed = np.reshape(told["submaps"][1]["T_w_m"], (4, 4))
    assert np.allclose(placed, ELSEWHERE, atol=0.03)
    assert "one map already" in base.ask("merge", map="1.1.0", into="0.1.0")["error"]


def test_a_map_whose_camera_never_came_is_merged_without_harm(make_flight: MakeFlight, words: Any) -> None:
    """An agent that means harm holds it back: a keyframe of another one beside its keyframes ended the base."""
    base = Base(words)
    a = make_flight(keyframes=14, turns=0.3)
    b = make_flight(keyframes=14, turns=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    for records in (b.records[:4], b.records[4:]):
        base.step([(b.agent, tuple(record for group in records for record in group))])
    base.step([(a.agent, (CameraIntrinsics(a.agent, a.camera), *a.records[0]))])
    base.rest(4)
    T = ELSEWHERE.ravel().tolist()
    assert base.ask("merge", map="1.1.0", into="0.1.0", T_into_map=T)["merged"] is True
    for records in a.records[1:]:
        base.step([(a.agent, tuple(records))])
    base.rest(10)
    assert not base.mapper.map.keypoints.usable[base.mapper.map.slots_of(b.keyframes[-1])].any()
    base.step([(b.agent, (CameraIntrinsics(b.agent, b.camera),))])
    assert base.mapper.map.keypoints.usable[base.mapper.map.slots_of(b.keyframes[-1])].any()
    base.rest(10)
    assert contradictions(base.mapper) == []


def test_user_requests_a_search_for_loops(make_flight: MakeFlight, words: Any) -> None:
    base = Base(words)
    a = make_flight(keyframes=16, turns=0.5)
    b = make_flight(keyframes=16, turns=0.5, start=0.42, variant=1, agent=1, T_w_m=ELSEWHERE)
    base.fly([a, b])
    if len(ids(base.ask("list"))) == 1:
        base.ask("split", map="1.1.0")
        base.mapper.merger.detector.kept_apart.clear()  # type: ignore[union-attr]
    assert base.ask("merge", map="1.1.0", into="0.1.0") == {"merged": False, "looking": 16}
    base.rest()
    assert ids(base.ask("list")) == ["0.1.0"]


def test_a_merge_leaves_out_keyframes_whose_parents_never_came(make_flight: MakeFlight, words: Any) -> None:
    """Of one whose frame is a keyframe in another map, too, it ended the base."""
    base = Base(words)
    a = make_flight(keyframes=8, turns=0.2)
    b = make_flight(keyframes=8, turns=0.2, seed=9, submap=1)
    (seen,) = (record for record in a.records[5] if isinstance(record, KeyframeHeader))
    (lost,) = (record for record in b.records[7] if isinstance(record, KeyframeHeader))
    b.records[6] = []  # the parent of the last one
    b.records[7] = [replace(lost, t_ns=seen.t_ns) if record is lost else record for record in b.records[7]]
    base.fly([a, b, make_flight(keyframes=8, turns=0.2, seed=4, submap=2)])
    assert base.mapper.map.pose(b.keyframes[7]) is None
    assert len(ids(base.ask("list"))) == 3
    assert base.ask("merge", map="0.1.1", into="0.1.2", T_into_map=np.eye(4).ravel().tolist())["merged"] is True
    base.rest()


def test_deleted_map_is_culled_and_later_records_ignored(make_flight: MakeFlight, words: Any) -> None:
    base = Base(words)
    a = make_flight(keyframes=12, turns=0.2)
    b = make_flight(keyframes=12, turns=0.2, seed=4, agent=1)
    base.fly([a, b])
    last = b.keyframes[-1]
    base.step([(b.agent, (LivePose(b.agent, 1, last, np.eye(4), 90),))])
    assert "flies in" in base.ask("delete", map="1.1.0")["error"]
    base.rest()
    base.published.clear()
    assert base.ask("delete", map="1.1.0") == {"deleted": ["1.1.0"]}
    culled = [
        r
        for r in base.published
        if isinstance(r, CulledLandmarks) and submap_of_keyframe(r.keyframe) == submap_id(1, 1, 0)
    ]
    assert len(culled) == 12 and all(r.keyframe_too for r in culled)
    for records in b.records:  # its agent says it all again
        base.step([(b.agent, tuple(records))])
    base.rest()
    assert ids(base.ask("list")) == ["0.1.0"]
    assert "no map" in base.ask("get", map="1.1.0")["error"]
    assert base.mapper.idle


def test_a_placement_that_waits_for_room_is_deleted_with_its_map(make_flight: MakeFlight) -> None:
    mapper, flight = Mapper(BaseConfig()), make_flight(keyframes=6)
    full = ((flight.agent, 0),)
    records = (CameraIntrinsics(flight.agent, flight.camera), *(r for group in flight.records for r in group))
    command = Command(1, "delete", '{"map": "0.1.0"}')
    output = mapper.step(MapperInput(((flight.agent, records),), room_bytes=full), STEP_NS)
    assert not any(isinstance(r, SubmapPlacement) for _, out in output.publish for r in out)
    assert mapper.placements
    assert mapper.step(MapperInput((), commands=(command,), room_bytes=full), 2 * STEP_NS).answers[0].ok
    output = mapper.step(MapperInput(()), 3 * STEP_NS)
    assert not any(isinstance(r, SubmapPlacement) for _, out in output.publish for r in out)
    assert not mapper.state().placements.unmerged


def test_a_keyframe_that_comes_as_its_map_is_deleted_is_deleted_with_it(make_flight: MakeFlight, words: Any) -> None:
    base = Base(words)
    goes, again = make_flight(keyframes=12, seed=21), make_flight(keyframes=12, agent=1, seed=21)
    late = tuple(goes.records.pop())
    base.fly([goes])
    base.rest()
    command = Command(1, "delete", '{"map": "0.1.0"}')
    assert all(answer.ok for answer in base.step([(goes.agent, late)], [command]))
    base.fly([again])  # the same place
    base.rest()
    assert ids(base.ask("list")) == ["1.1.0"]
    assert base.mapper.placements.keys().isdisjoint(base.mapper.deleted)


@pytest.mark.parametrize(
    ("verb", "text", "told"),
    [
        ("explode", "{}", "no command 'explode'; there are: list"),
        ("get", "{", "no JSON"),
        ("get", "[]", "JSON object"),
        ("get", "{}", "missing"),
        ("get", '{"map": "9.9.9"}', "no map '9.9.9'"),
        ("get", '{"map": "99.99999.0"}', "no map"),
        ("list", '{"map": "0.1.0"}', "unknown key 'map'; list takes: nothing"),
        ("merge", '{"map": "0.1.0", "into": "0.1.0"}', "gtsam"),
    ],
)
def test_refused_commands_give_a_reason(make_flight: MakeFlight, verb: str, text: str, told: str) -> None:
    base = Base(None)
    base.fly([make_flight(keyframes=3, turns=0.05)])
    (answer,) = base.step(commands=[Command(1, verb, text)])
    assert not answer.ok
    assert told in json.loads(answer.text)["error"]


def test_submap_names_and_verbs() -> None:
    assert submap_name(SubmapId(submap_id(3, 17, 4))) == "3.17.4"
    assert set(VERBS) == {"list", "get", "name", "merge", "split", "delete"}


@pytest.mark.parametrize(
    "text",
    ["[" * 1000, "[" * 100_000, '{"map":' * 1000, "1" * 400, "1" * 10_000, '{"map": "%s"}' % ("7" * 5000 + ".0.0"),
     '{"map": "\\ud800", "name": "\\ud800"}', "NaN", '{"map": 1e999}', "\ud800", '{"map": "0.0.0"}' + " " * 100_000],
)  # fmt: skip
@pytest.mark.parametrize("verb", [*VERBS, "[" * 1000])
def test_questions_that_mean_harm_are_refused(text: str, verb: str, words: Any) -> None:
    (answer,) = Base(words).step(commands=[Command(1, verb, text)])
    assert not answer.ok
    assert set(json.loads(answer.text)) == {"error"}


HUGE = [
    [10**400, *np.eye(4).ravel()[1:].tolist()],
    [1.0, 0, 0, 1e300, *np.eye(4).ravel()[4:].tolist()],
    [*np.diag([1e-12, 1e-12, 1e-12, 1.0]).ravel().tolist()],
    [*np.diag([1e12, 1e12, 1e12, 1.0]).ravel().tolist()],
    [1e308] * 16,
    ["[" * 1000] * 16,
]


@pytest.mark.parametrize("numbers", HUGE, ids=range(len(HUGE)))
def test_merges_beyond_all_numbers_are_refused(numbers: list[Any], words: Any, make_flight: MakeFlight) -> None:
    base = Base(words)
    flights = [make_flight(agent=a, keyframes=4, turns=0.05) for a in (0, 1)]
    base.fly(flights)
    text = json.dumps({"map": "1.0.0", "into": "0.0.0", "T_into_map": numbers})
    (answer,) = base.step(commands=[Command(1, "merge", text)])
    assert not answer.ok
    base.step()
