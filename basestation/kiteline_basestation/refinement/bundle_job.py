"""The two kinds of bundle adjustment jobs: of a local window, and of a whole map."""

from __future__ import annotations

from dataclasses import dataclass

from kiteline_basestation.jobs import JobKind
from kiteline_core.optimisation.bundle import BundleConfig, BundleProblem, BundleResult, bundle


@dataclass(frozen=True, slots=True)
class BundleInputs:
    """A bundle adjustment problem and how to solve it."""

    problem: BundleProblem
    config: BundleConfig


def _run(inputs: BundleInputs) -> BundleResult:
    return bundle(inputs.problem, inputs.config)


def _cost_ops(inputs: BundleInputs, result: BundleResult) -> int:
    return result.cost_ops


LOCAL_BUNDLE = JobKind("bundle", _run, _cost_ops)
FULL_BUNDLE = JobKind("full", _run, _cost_ops)
