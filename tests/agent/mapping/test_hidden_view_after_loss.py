"""What landmarks have to cover after a loss: as much as usual, less a part, for a second."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.keyframes.reference import ReferenceKeyframe
from kiteline_agent.mapping.loss_stage import LossStage

SECOND = 1_000_000_000


class Submaps:
    """None begins; `asked` holds what each would have to cover."""

    def __init__(self) -> None:
        self.asked: list[float] = []

    def open(self, _ctx: object, least_cover: float) -> None:
        self.asked.append(least_cover)

    def may_open(self, _failed_searches: int) -> bool:
        return True

    def take_warnings(self) -> list[str]:
        return []

    def note_tracked(self) -> None:
        pass


def stage(submaps: Any, usual_cover: float, *, has_map: bool = True) -> LossStage:
    camera: Any = SimpleNamespace(
        submaps=SimpleNamespace(any=has_map, active=0), dead_reckon=lambda _ctx: False,
        reference=SimpleNamespace(usual_cover=usual_cover, keyframe=0), pose=SimpleNamespace(T_o_m=np.eye(4)),
    )  # fmt: skip
    relocaliser: Any = SimpleNamespace(relocalise=lambda _ctx, _keyframe: None, has_texture=True)
    governor: Any = SimpleNamespace(may=lambda _extra: True)
    keyframes: Any = None
    return LossStage(camera, keyframes, submaps, relocaliser, governor, monocular=False)


def lost_at(loss: LossStage, seconds: float) -> None:
    ctx: Any = SimpleNamespace(t_ns=round(seconds * SECOND))
    loss.handle(ctx, stuck=False, was_lost=False)


def test_after_a_second_what_is_left_of_the_view_is_enough() -> None:
    submaps = Submaps()
    loss = stage(submaps, 0.5)
    for seconds in (5.0, 5.5, 5.95, 6.0, 7.0):
        lost_at(loss, seconds)
    assert submaps.asked == pytest.approx([0.3, 0.3, 0.3, 0.0, 0.0])
    loss.end()
    lost_at(loss, 7.1)  # the next loss
    assert submaps.asked[-1] == pytest.approx(0.3)


def test_a_first_map_begins_with_what_there_is() -> None:
    submaps = Submaps()
    lost_at(stage(submaps, 0.0, has_map=False), 0.0)
    assert submaps.asked == [0.0]


def test_the_usual_cover_follows_within_seconds_and_no_single_frame() -> None:
    local_map: Any = None
    reference = ReferenceKeyframe(local_map)
    covers = []
    for k, cover in enumerate([0.9] * 20 + [0.1] * 8 + [0.9] * 10 + [0.3] * 200):
        reference._note_cover(cover, k * SECOND // 20)
        covers.append(reference.usual_cover)
    assert covers[0] == 0.9 and min(covers[20:38]) > 0.7  # 0.4 s hidden
    np.testing.assert_allclose(covers[-1], 0.3, atol=0.01)
    reference._note_cover(0.9, 60 * SECOND)  # after a long loss
    assert reference.usual_cover < 0.45
