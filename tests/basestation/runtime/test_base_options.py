"""Options of a base: what is wrong is told at the start."""

import pytest

from kiteline_basestation.runtime.options import BaseOptions, coded_channels
from kiteline_codec.sync.config import BudgetError
from kiteline_hw.links.kinds import link_traits

LINK = "serial:/dev/ttyUSB0:57600"


def test_a_budget_that_is_too_small_is_told_before_an_agent_comes() -> None:
    with pytest.raises(BudgetError, match=r"10 B/s .* at least"):
        coded_channels(BaseOptions(folder="", agents=(), link=LINK, down_bytes_s=10), link_traits(LINK))
