"""The job that optimises the essential graph of a map."""

from kiteline_basestation.jobs import JobKind
from kiteline_basestation.merging.essential_graph import GraphInputs, GraphResult, optimise


def _cost_ops(inputs: GraphInputs, result: GraphResult) -> int:
    return result.cost_ops


POSE_GRAPH = JobKind("graph", optimise, _cost_ops, rank=1)
