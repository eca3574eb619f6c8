"""The two kinds of bundle adjustment jobs: of a local window, and of a whole map."""

from dataclasses import dataclass, field, replace

from kiteline_basestation.config import InertialScaleConfig
from kiteline_basestation.inertial.chain import Segment
from kiteline_basestation.inertial.map_scale import in_metres
from kiteline_basestation.jobs import JobKind
from kiteline_core.optimisation.bundle import BundleConfig, BundleProblem, BundleResult, bundle

_STEP_OPS = 90_000  # of an inertial step: 0.09 ms, as timed


@dataclass(frozen=True, slots=True)
class BundleInputs:
    """A bundle adjustment problem and how to solve it. chain: scales the result, from camera `held` on."""

    problem: BundleProblem
    config: BundleConfig
    chain: tuple[Segment, ...] = ()
    held: int = 0
    inertial_scale: InertialScaleConfig = field(default_factory=InertialScaleConfig)


def _run(inputs: BundleInputs) -> BundleResult:
    result = bundle(inputs.problem, inputs.config)
    if not inputs.chain:
        return result
    steps = sum(len(segment.steps.dt_s) for segment in inputs.chain)
    result = replace(result, cost_ops=result.cost_ops + _STEP_OPS * steps)
    return in_metres(result, inputs.problem, inputs.chain, inputs.held, inputs.inertial_scale)


def _cost_ops(inputs: BundleInputs, result: BundleResult) -> int:
    return result.cost_ops


LOCAL_BUNDLE = JobKind("bundle", _run, _cost_ops)
FULL_BUNDLE = JobKind("full", _run, _cost_ops, rank=2)
