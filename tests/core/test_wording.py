"""Words of texts for users."""

from kiteline_core.wording import counted


def test_one_is_singular() -> None:
    assert [counted(n, "keyframe") for n in (0, 1, 2)] == ["0 keyframes", "1 keyframe", "2 keyframes"]
