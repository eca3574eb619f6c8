"""What the status page is told: pure functions."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.grid.grid_view import CodedTile, GridView, differences
from kiteline_basestation.grid.tile_store import Place
from kiteline_basestation.web import messages
from kiteline_basestation.web.snapshot import AgentStatus, PageSnapshot
from kiteline_codec.schema import GridTile
from kiteline_codec.schema import messages as codec_messages
from kiteline_codec.schema.base.grid_tile import UNKNOWN
from kiteline_core.ids import AgentId

S = 1_000_000_000


def agent(number: int = 0, **changes: object) -> AgentStatus:
    plain = AgentStatus(AgentId(number), 99 * S, 80, np.eye(4), np.zeros((3, 3)), 3, 40, 1, 1000, 500)
    return replace(plain, **changes)  # type: ignore[arg-type]


def grid(*tiles: tuple[int, int], value: int = 0) -> GridView:
    cells = np.full((64, 64), value, np.int8)
    cells[0, 0] = UNKNOWN
    coded = {
        Place(0, row, column): CodedTile(codec_messages.encode(GridTile(column, row, 0, 0.5, cells)), 4095)
        for column, row in tiles
    }
    return GridView(0.5, 1, 0, coded)


def snapshot(*agents: AgentStatus, **changes: object) -> PageSnapshot:
    plain = PageSnapshot(100 * S, 40 * S, agents, np.zeros((5, 3)), np.zeros(5, np.uint8), grid((0, 0)), 7)
    return replace(plain, **changes)  # type: ignore[arg-type]


def test_status_says_what_the_snapshot_holds_in_json() -> None:
    turned = np.eye(4)
    turned[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]  # level, looking along y
    turned[:3, 3] = [1.23456, -2.0, -0.0]
    out = messages.status(snapshot(agent(0, T_w_c=turned), agent(3, T_w_c=None, last_packet_ns=None, quality=-1)))
    assert json.loads(json.dumps(out, allow_nan=False)) == out
    assert out["up_s"] == 60.0
    totals = {n["label"]: (n["value"], n["unit"]) for n in out["totals"]}
    assert totals["Keyframes"] == (6, "") and totals["Landmarks"] == (80, "")
    assert totals["Mapped"] == (round(4095 * 0.25, 1), "m²")
    first, second = out["agents"]
    assert first["position"] == [1.235, -2.0, 0.0] and first["heading_deg"] == 90.0
    assert (first["link"], first["silent_s"], first["rate_up"]) == ("live", 1.0, None)
    assert second["position"] is None and second["heading_deg"] is None
    assert (second["agent"], second["link"], second["silent_s"]) == (3, "never", None)


def test_the_quality_of_an_agent_that_was_not_heard_for_long_is_not_shown() -> None:
    """The page showed 100 % beside "no link for 2 min"."""
    old = agent(quality=100, last_packet_ns=100 * S - 120 * S)
    quiet = agent(1, quality=100, last_packet_ns=97 * S)
    first, second = messages.status(snapshot(old, quiet))["agents"]
    assert (first["link"], first["quality"]) == ("lost", None)
    assert (second["link"], second["quality"]) == ("quiet", 100)


def test_a_pose_that_is_not_finite_is_no_pose() -> None:
    assert messages.status(snapshot(agent(T_w_c=np.full((4, 4), np.nan))))["agents"][0]["position"] is None


@pytest.mark.parametrize(
    ("silent_s", "state"), [(None, "never"), (0.0, "live"), (1.4, "live"), (2.0, "quiet"), (11.0, "lost")]
)
def test_link_states(silent_s: float | None, state: str) -> None:
    assert messages.link_state(silent_s) == state


def test_rates_come_from_two_snapshots() -> None:
    before = snapshot(agent(0), now_ns=98 * S)
    now = snapshot(agent(0, bytes_up=5000, bytes_down=700), agent(1))
    out = messages.status(now, before)["agents"]
    assert (out[0]["rate_up"], out[0]["rate_down"]) == (2000, 100)
    assert out[1]["rate_up"] is None  # it was not there before


def header(message: bytes) -> tuple[int, int, int, float]:
    kind, number, zero, n, scale, rest = struct.unpack_from("<BBHIfI", message)
    assert zero == rest == 0
    return kind, number, n, scale


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 5000.0), st.integers(0, 50))
def test_points_survive_within_half_a_step(seed: int, size: float, n: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-size, size, (n, 3))
    labels = rng.integers(0, 3, n).astype(np.uint8)
    message = messages.points_message(points, labels)
    kind, _, count, scale = header(message)
    assert (kind, count, len(message)) == (messages.POINTS, n, 16 + 7 * n)
    back = np.frombuffer(message, "<i2", 3 * n, 16).reshape(n, 3) * scale
    np.testing.assert_allclose(back, points, atol=0.5001 * scale + 1e-9)
    assert scale <= max(size, 1.0) / 32766 * 1.001
    assert np.array_equal(np.frombuffer(message, np.uint8, n, 16 + 6 * n), labels)


def test_many_points_are_thinned_and_bad_ones_left_out() -> None:
    points = np.zeros((3 * messages.MAX_POINTS, 3))
    points[::2] = np.nan
    assert header(messages.points_message(points, np.zeros(len(points), np.uint8)))[2] == messages.MAX_POINTS
    assert header(messages.points_message(points[:5], np.zeros(5, np.uint8)))[2] == 2
    assert header(messages.path_message(4, np.zeros((10**5, 3))))[:3] == (messages.PATH, 4, messages.MAX_PATH)


def tiles(message: bytes) -> dict[tuple[int, int], np.ndarray]:
    _, _, n, _ = header(message)
    places = np.frombuffer(message, "<i4", 2 * n, 16).reshape(n, 2)
    cells = np.frombuffer(message, np.int8, n * 4096, 16 + 8 * n).reshape(n, 64, 64)
    return {(int(c), int(r)): cells[i] for i, (c, r) in enumerate(places)}


def test_a_viewer_gets_the_tiles_that_it_does_not_hold() -> None:
    old = grid((0, 0), (1, -1))
    new = replace(old, tiles={**old.tiles, **grid((5, 2), value=3).tiles})
    gone = Place(0, -1, 1)
    new = replace(new, tiles={p: t for p, t in new.tiles.items() if p != gone})
    maps = messages.map_messages(snapshot(agent(2)))
    assert [header(m)[0] for m in maps] == [messages.PATH, messages.POINTS] and header(maps[0])[1] == 2
    first = messages.tiles_message(old, differences(GridView(1.0), old))
    assert header(first)[0] == messages.TILES and header(first)[3] == 0.5
    assert set(tiles(first)) == {(0, 0), (1, -1)}
    second = tiles(messages.tiles_message(new, differences(old, new)))
    assert set(second) == {(1, -1), (5, 2)}
    assert (second[1, -1] == UNKNOWN).all()
    assert (second[5, 2][1:] == 3).all() and second[5, 2][0, 0] == UNKNOWN
    assert not differences(new, new)


def test_a_path_is_interrupted_between_submaps_also_where_it_is_thinned() -> None:
    path = np.arange(15.0).reshape(5, 3)
    path[2] = np.nan
    message = messages.path_message(0, path)
    codes = np.frombuffer(message, "<i2", 15, 16).reshape(5, 3)
    assert (codes[2] == -32768).all() and (codes[[0, 1, 3, 4]] != -32768).all()
    long = np.zeros((3 * messages.MAX_PATH, 3))
    long[[100, 101 + messages.MAX_PATH]] = np.nan
    message = messages.path_message(0, long)
    n = header(message)[2]
    assert n <= messages.MAX_PATH + 2
    assert np.count_nonzero(np.frombuffer(message, "<i2", 3 * n, 16).reshape(n, 3)[:, 0] == -32768) == 2


def test_units_and_troubles_are_told() -> None:
    out = messages.status(snapshot(agent(0, own_unit=True), agent(1), troubles=("store: not written",)))
    assert [a["unit"] for a in out["agents"]] == ["own", "metre"]
    assert (out["unit"], out["troubles"]) == ("metre", ["store: not written"])
    assert messages.status(snapshot(own_unit=True))["unit"] == "own"
