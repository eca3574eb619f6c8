"""The owner of each value, and the memory that it takes where it is used: what an endpoint checks on arrival."""

from kiteline_codec.coding.packing import WireError
from kiteline_codec.schema import messages
from kiteline_codec.schema.agent.inertial_steps import InertialSteps
from kiteline_codec.schema.agent.keyframe_header import KeyframeHeader
from kiteline_codec.schema.record import FIRST_BASE_KIND, RECORD_TYPES, IdOf, Key
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe

KEYFRAME_BYTES = 1 << 18  # that the values of a keyframe claim at most, in the base's map and beside it
_KEYPOINT_BYTES = 120  # of a keypoint in the base's map
_STEP_BYTES = 110  # of a step between two keyframes


def of_agent(agent: AgentId, key: Key) -> bool:
    """True if this agent writes values under a key: of agents' kinds, of itself, its submaps and its keyframes."""
    if key.kind >= FIRST_BASE_KIND:
        return False
    record_type = RECORD_TYPES.get(key.kind)
    if record_type is None:
        return True  # of a newer schema; it is not decoded
    if record_type.ID is IdOf.AGENT:
        return key.id == agent
    if record_type.ID is IdOf.SUBMAP:
        return agent_of_submap(SubmapId(key.id)) == agent
    return agent_of_keyframe(KeyframeId(key.id)) == agent


def submap_of(key: Key) -> SubmapId | None:
    """The submap that a value concerns; None if it concerns no submap."""
    id_of = RECORD_TYPES[key.kind].ID if key.kind in RECORD_TYPES else None
    if id_of in (IdOf.KEYFRAME, IdOf.PASSING_KEYFRAME):
        return submap_of_keyframe(KeyframeId(key.id))
    return SubmapId(key.id) if id_of is IdOf.SUBMAP else None


def claimed_bytes(key: Key, code: bytes) -> int:
    """Memory that a value of an agent claims in the base's map beyond its code: a header names how many keypoints."""
    if key.kind not in (InertialSteps.KIND, KeyframeHeader.KIND):
        return 0
    try:
        record = messages.decode(key, code)
    except WireError:
        return 0
    if isinstance(record, InertialSteps):
        return _STEP_BYTES * len(record.dt_s)
    return _KEYPOINT_BYTES * record.keypoints if isinstance(record, KeyframeHeader) else 0
