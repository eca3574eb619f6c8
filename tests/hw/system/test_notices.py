"""Lines for the user."""

from kiteline_hw.system.notices import Notices


def test_a_line_that_a_thread_adds_while_lines_are_taken_is_not_lost() -> None:
    notices = Notices()
    notices.say("log", "log: the disk is full")
    add = notices._new.append  # as far as a thread came that says something now
    assert notices.take() == ["log: the disk is full"]
    add("rig: the disk is full")
    assert notices.take() == ["rig: the disk is full"]
    assert notices.take() == []
