"""Steps of a kept log: its inputs, with the images that all kept logs share."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from kiteline_hw.logs.mcap_log import DEPTH, LEFT, RIGHT, LogMessage, LogReader
from kiteline_lab.replay.logged_steps import Step, steps

KEPT_DEPTH = "/kept/depth"
Images = Mapping[int, Mapping[str, LogMessage]]  # by stamp in ns, then by topic


def read_images(file: Path) -> dict[int, dict[str, LogMessage]]:
    """All images of a file. Raises SourceError."""
    found: dict[int, dict[str, LogMessage]] = {}
    with LogReader(file) as log:
        for message in log.messages((LEFT, RIGHT, KEPT_DEPTH)):
            found.setdefault(message.t_ns, {})[message.topic] = message
    return found


def agent_steps(log: LogReader, images: Images, *, right: bool, depth: bool) -> Iterator[Step]:
    """Steps of an agent's kept log, with the images that its rig has."""
    for step in steps(log):
        if (stamp := step.head["frame_ns"]) is not None:
            kept = images[stamp]
            step.messages[LEFT] = [kept[LEFT]]
            if right:
                step.messages[RIGHT] = [kept[RIGHT]]
            if depth:
                step.messages[DEPTH] = [kept[KEPT_DEPTH]]
        yield step
