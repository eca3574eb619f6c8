"""Runs a survey of a flight controller over a real connection."""

import threading
import time
from pathlib import Path

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import Heartbeat, MavlinkMessage
from kiteline_hw.mavlink.transport.connection import Adopt, MavlinkConnection
from kiteline_hw.mavlink.transport.signing import Signing, StampFile, read_key
from kiteline_hw.mavlink.transport.url import parse_mavlink_url
from kiteline_hw.mavlink.watch.findings import Finding
from kiteline_hw.mavlink.watch.presence import LinkState
from kiteline_hw.mavlink.watch.survey import ControllerSurvey
from kiteline_hw.ports import Clock

_LIMIT_S = 60.0  # s that a survey takes at most
_TICK_S = 0.02  # s between two looks at what to send
_COMPONENT = 191  # MAV_COMP_ID_ONBOARD_COMPUTER; not the agent's, as stamps of signatures are counted for each
_FLUSH_S = 0.2  # s for the last messages on a serial port


class _Surveyor:
    """Connects the survey's messages with a connection's bytes."""

    def __init__(self, url: str, clock: Clock, signing: Signing | None) -> None:
        self.survey = ControllerSurvey(url)
        self._clock = clock
        self._codec = MavlinkCodec(component=_COMPONENT, signing=signing)
        self._lock = threading.Lock()
        self._received = self._messages = 0
        self.done = threading.Event()
        self.connection = MavlinkConnection(
            parse_mavlink_url(url), "survey", self._on_data, self._on_tick, _TICK_S, 0, required=False
        )

    def _send(self, messages: list[MavlinkMessage]) -> None:
        for message in messages:
            self.connection.send(self._codec.encode(message))

    def _on_data(self, data: bytes, datagram: bool, adopt: Adopt | None) -> None:
        with self._lock:
            now_ns = self._clock.now_ns()
            messages = self._codec.receive(data, datagram=datagram)
            if adopt is not None:
                if not any(isinstance(m, Heartbeat) and m.is_autopilot for m in messages):
                    return
                adopt()
            self._received += bool(data)
            for message in messages:
                self._messages += 1
                self._send(self.survey.receive(message, now_ns))

    def _on_tick(self) -> None:
        with self._lock:
            codec = self._codec
            link = LinkState(
                self._received, self._messages, codec.signed, codec.refused, codec.has_key,
                device_fault=self.connection.device_fault,
            )  # fmt: skip
            self._send(self.survey.step(self._clock.now_ns(), link))
            if self.survey.presence.system is not None:
                codec.system = self.survey.presence.system
            if self.survey.done:
                self.done.set()

    def stop(self) -> None:
        """Set the streams back."""
        with self._lock:
            self._send(self.survey.stop())


def survey_controller(url: str, clock: Clock, key: str = "") -> list[Finding]:
    """Ask the flight controller at a URL; takes seconds. Raises LinkError for a URL or key that cannot be used.

    key: a file with the key of MAVLink's signatures; "": messages are not signed.
    """
    signing = None
    if key:
        path = Path(key)
        signing = Signing(read_key(path), StampFile(path.with_name(f"{path.name}.doctor_stamp")))
    surveyor = _Surveyor(url, clock, signing)
    surveyor.connection.start()
    try:
        surveyor.done.wait(_LIMIT_S)
        surveyor.stop()
        time.sleep(_FLUSH_S)
    finally:
        surveyor.connection.close()
    return surveyor.survey.findings()
