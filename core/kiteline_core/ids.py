"""Ids that carry their origin: (agent, boot, submap, sequence[, keypoint]) packed into one non-negative int64.

Bit layout of a landmark id, most significant first: agent 8 | boot 18 | submap 10 | sequence 16 | keypoint 11.
A keyframe id is a landmark id without the keypoint bits; a submap id is a keyframe id without the sequence bits. A
landmark is named by the keyframe and keypoint at which it was new, so its id costs no bytes beyond its keypoint. The
first boot of an agent is drawn at random: numbers of a lost or a cloned card are most likely others.
"""

from typing import NewType

AgentId = NewType("AgentId", int)
SubmapId = NewType("SubmapId", int)
KeyframeId = NewType("KeyframeId", int)
LandmarkId = NewType("LandmarkId", int)

BOOT_BITS = 18
SUBMAP_BITS = 10
SEQUENCE_BITS = 16
KEYPOINT_BITS = 11

MAX_AGENTS = 1 << 8
MAX_BOOTS = 1 << BOOT_BITS
MAX_SUBMAPS = 1 << SUBMAP_BITS
MAX_KEYFRAMES = 1 << SEQUENCE_BITS
MAX_KEYPOINTS = 1 << KEYPOINT_BITS

NO_KEYFRAME = KeyframeId(-1)
NO_LANDMARK = LandmarkId(-1)


def submap_id(agent: int, boot: int, submap: int) -> SubmapId:
    """Pack a submap id. Raises ValueError when a part does not fit its bits."""
    if not (0 <= agent < MAX_AGENTS and 0 <= boot < MAX_BOOTS and 0 <= submap < MAX_SUBMAPS):
        raise ValueError(f"submap id out of range: agent {agent}, boot {boot}, submap {submap}")
    return SubmapId((agent << BOOT_BITS | boot) << SUBMAP_BITS | submap)


def keyframe_id(submap: SubmapId, sequence: int) -> KeyframeId:
    """Pack a keyframe id. Raises ValueError when the sequence does not fit its bits."""
    if not 0 <= sequence < MAX_KEYFRAMES:
        raise ValueError(f"keyframe sequence out of range: {sequence}")
    return KeyframeId(submap << SEQUENCE_BITS | sequence)


def point_id(keyframe: KeyframeId, keypoint: int) -> LandmarkId:
    """Pack the id of the landmark that is new at `keypoint` of `keyframe`. Raises ValueError for an index too large."""
    if not 0 <= keypoint < MAX_KEYPOINTS:
        raise ValueError(f"keypoint index out of range: {keypoint}")
    return LandmarkId(keyframe << KEYPOINT_BITS | keypoint)


def submap_of_keyframe(keyframe: KeyframeId) -> SubmapId:
    """The submap of a keyframe."""
    return SubmapId(keyframe >> SEQUENCE_BITS)


def agent_of_submap(submap: SubmapId) -> AgentId:
    """The agent that opened a submap."""
    return AgentId(submap >> (SUBMAP_BITS + BOOT_BITS))


def boot_of_submap(submap: SubmapId) -> int:
    """Boot that a submap belongs to, within its agent."""
    return submap >> SUBMAP_BITS & MAX_BOOTS - 1


def agent_of_keyframe(keyframe: KeyframeId) -> AgentId:
    """The agent that made a keyframe."""
    return agent_of_submap(submap_of_keyframe(keyframe))
