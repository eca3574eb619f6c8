"""Lengths by the images that accelerations contradict are said once, and never where they tell nothing."""

import pytest

from kiteline_agent.inertial.calibration.lengths_check import LengthsCheck

_PRIOR = 0.015


@pytest.mark.parametrize(("true", "word"), [(0.9, "10 % too long"), (1.1, "10 % too short")])
def test_what_accelerations_alone_tell_is_said_once(true: float, word: str) -> None:
    check, own = LengthsCheck(_PRIOR), 0.02  # deviation of the accelerations alone
    share = _PRIOR**2 / (_PRIOR**2 + own**2)
    sigma = (_PRIOR**-2 + own**-2) ** -0.5
    said = check.note(1.0 + share * (true - 1.0), sigma)
    assert len(said) == 1
    assert word in said[0]
    assert "(deviation 2.0 %)" in said[0]
    assert check.note(1.0 + share * (true - 1.0), sigma) == []


@pytest.mark.parametrize(("scale", "sigma"), [
    (1.0, 0.001),
    (0.97, 0.001),  # a worn rig that sees far
    (0.985, 0.0125),  # 5 % by accelerations that know it to 2 %
    (0.5, 0.0149),  # hardly anything is known
    (0.5, 0.02),  # less than before
])  # fmt: skip
def test_what_may_be_chance_or_wear_is_not_said(scale: float, sigma: float) -> None:
    assert LengthsCheck(_PRIOR).note(scale, sigma) == []
