"""All kinds of jobs; a new kind is a file with its inputs and its `JobKind`, and its name in `KINDS`."""

from kiteline_basestation.grid.scan_job import SCAN
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.merging.graph_job import POSE_GRAPH
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE, LOCAL_BUNDLE

KINDS = {kind.name: kind for kind in (LOCAL_BUNDLE, FULL_BUNDLE, POSE_GRAPH, SCAN)}


def run_job(job: Job) -> JobDone:
    """Do a job. The same job gives the same result, bit for bit."""
    kind = KINDS[job.kind]
    result = kind.run(job.inputs)
    return JobDone(job.id, job.kind, result, kind.cost_ops(job.inputs, result))
