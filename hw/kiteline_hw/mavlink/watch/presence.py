"""Says whether a flight controller is there, which one, and why not. Pure."""

from dataclasses import dataclass

from pymavlink.dialects.v20 import common

from kiteline_hw.mavlink.messages import Heartbeat
from kiteline_hw.mavlink.watch.findings import FindingLevel, FindingLog
from kiteline_hw.mavlink.watch.messages import AUTOPILOT_VERSION, REQUEST_MESSAGE, AutopilotVersion, Command

TOPIC, DEVICE_TOPIC, SIGNING_TOPIC, ANSWER_TOPIC = "controller", "device", "signing", "answers"
RETRIED = "It is tried again"  # the end of the remedy for a port that cannot be opened
_AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}


@dataclass(frozen=True, slots=True)
class LinkState:
    """What the connection has seen. device_fault: why the serial port is not open; "": it is, or there is none."""

    received: int = 0  # pieces of bytes or datagrams
    messages: int = 0  # valid ones, of anybody
    signed: int = 0
    refused: int = 0  # without the right signature
    has_key: bool = False  # we sign
    device_fault: str = ""


@dataclass(frozen=True, slots=True)
class PresenceConfig:
    """When presence and absence are said."""

    absent_ns: int = 5_000_000_000  # ns without a heartbeat; five of them
    version_ns: int = 1_000_000_000  # ns between two requests of the version
    version_requests: int = 3  # after which it counts as not told
    answer_ns: int = 6_000_000_000  # ns without any answer to what is asked


def vehicle_name(kind: int) -> str:
    """The name of a MAV_TYPE: quadrotor."""
    entry = common.enums["MAV_TYPE"].get(kind)
    return entry.name.removeprefix("MAV_TYPE_").lower().replace("_", " ") if entry is not None else f"type {kind}"


def autopilot_name(kind: int) -> str:
    """The name of a MAV_AUTOPILOT."""
    return _AUTOPILOTS.get(kind, f"autopilot {kind}")


class PresenceWatch:
    """Heartbeats and the connection's state in, findings out. url: of the connection, for messages."""

    def __init__(self, url: str, log: FindingLog) -> None:
        self.config = PresenceConfig()
        self._url, self._log = url, log
        self._start_ns: int | None = None
        self.heartbeat: Heartbeat | None = None  # the last one of the controller
        self.heard_ns: int | None = None
        self._fault_ns = 0  # when the device was last not open
        self._others: set[int] = set()  # systems that sent a heartbeat and are no flight controller
        self._version = ""
        self._requests = 0
        self._next_request_ns = 0
        self._first_request_ns: int | None = None
        self._answered = False

    @property
    def system(self) -> int | None:
        """System id of the controller; None while it has not been heard."""
        return None if self.heartbeat is None else self.heartbeat.system

    @property
    def autopilot(self) -> int:
        """MAV_AUTOPILOT of the controller; 0 while it has not been heard."""
        return 0 if self.heartbeat is None else self.heartbeat.autopilot

    def receive_heartbeat(self, m: Heartbeat, now_ns: int) -> None:
        """Add a heartbeat of anybody."""
        if not m.is_autopilot:
            self._others.add(m.system)
        elif self.heartbeat is None or m.system == self.heartbeat.system:
            self.heartbeat, self.heard_ns = m, now_ns

    def receive_version(self, m: AutopilotVersion) -> None:
        """Add the firmware's version, which was asked for."""
        if self.system in (None, m.system):
            self._version, self._answered = m.text, True

    def answered(self) -> None:
        """The controller answered something that we asked."""
        self._answered = True

    def tick(self, now_ns: int, link: LinkState) -> list[Command]:
        """Say what has changed; the requests to send."""
        if self._start_ns is None:
            self._start_ns = now_ns
        self._say_device(link)
        self._say_signing(link)
        heartbeat, heard_ns = self.heartbeat, self.heard_ns
        if heartbeat is None or heard_ns is None:
            if now_ns - self._start_ns >= self.config.absent_ns and not link.device_fault:
                self._say_absent(link)
            return []
        if link.device_fault:  # said already: its silence is no news
            self._fault_ns = now_ns
            return []
        if now_ns - max(heard_ns, self._fault_ns) >= self.config.absent_ns:
            self._log.say(
                TOPIC, "silent", FindingLevel.ERROR,
                f"flight controller: silent for {(now_ns - heard_ns) / 1e9:.0f} s", "kiteline: controller is silent",
                "Is it powered, and the cable plugged in? Poses are still sent",
            )  # fmt: skip
            return []
        if self._log.state(TOPIC) == "silent":
            self._say_found(heartbeat, "is back")
        if not self._version and self._requests < self.config.version_requests:
            if now_ns < self._next_request_ns:
                return []
            self._requests += 1
            self._first_request_ns = now_ns if self._first_request_ns is None else self._first_request_ns
            self._next_request_ns = now_ns + self.config.version_ns
            return [Command(heartbeat.system, heartbeat.component, REQUEST_MESSAGE, float(AUTOPILOT_VERSION))]
        if self._version or now_ns >= self._next_request_ns:
            self._say_found(heartbeat, "found")
        if (
            not self._answered
            and self._first_request_ns is not None
            and now_ns - self._first_request_ns >= self.config.answer_ns
        ):
            self._say_deaf(link)
        return []

    def _say_found(self, m: Heartbeat, how: str) -> None:
        firmware = f" {self._version}" if self._version else ""
        name = f"{autopilot_name(m.autopilot)}{firmware}"
        self._log.say(
            TOPIC, ("found", m.system, m.autopilot, self._version), FindingLevel.INFO,
            f"flight controller: {how}: {name}, {vehicle_name(m.type)}, system {m.system}"
            + ("" if firmware else "; its firmware does not tell its version"),
            f"kiteline: sees {name}, system {m.system}",
        )  # fmt: skip

    def _say_absent(self, link: LinkState) -> None:
        serial = self._url.startswith("serial:")
        if link.refused:
            state, why, remedy = "refused", "its messages are signed by another key, or not", "Give both the same key"
        elif self._others:
            systems = ", ".join(map(str, sorted(self._others)))
            state, why = "others", f"only others are heard (system {systems})"
            remedy = "Connect to the flight controller's own port, or let the router forward it"
        elif link.received and not link.messages:
            state, why = "garbage", "bytes come, but no MAVLink"
            remedy = (
                "Set the port's baud rate and its protocol to MAVLink 2" if serial else "Is another program sending?"
            )
        elif link.received:
            state, why, remedy = "no heartbeat", "messages come, but no heartbeat", "Does a router filter heartbeats?"
        else:
            state, why = "nothing", "nothing is heard"
            remedy = (
                "Swap RX and TX, and check the port, its baud rate and SERIALx_PROTOCOL 2 or MAV_x_CONFIG"
                if serial
                else "Check address, port and firewall, and that the controller sends here"
            )
        seconds = self.config.absent_ns / 1e9
        self._log.say(
            TOPIC, state, FindingLevel.ERROR, f"flight controller: not found in {seconds:.0f} s at {self._url}: {why}",
            "kiteline: flight controller not found", remedy,
        )  # fmt: skip

    def _say_device(self, link: LinkState) -> None:
        if link.device_fault:
            self._log.say(
                DEVICE_TOPIC, link.device_fault, FindingLevel.ERROR,
                f"flight controller: {self._url}: {link.device_fault}", "kiteline: serial port is missing",
                f"Plug it in, or end the program that uses it; this user must be in group dialout; "
                f"a USB device keeps its name in /dev/serial/by-id. {RETRIED}",
            )  # fmt: skip
        elif self._log.state(DEVICE_TOPIC) not in (None, ""):
            self._log.say(
                DEVICE_TOPIC,
                "",
                FindingLevel.INFO,
                f"flight controller: {self._url} is open",
                "kiteline: serial port is open",
            )

    def _say_signing(self, link: LinkState) -> None:
        if link.refused and link.has_key:
            self._log.say(
                SIGNING_TOPIC, "refused", FindingLevel.ERROR,
                "signing: messages came without our key's signature, and were refused", "kiteline: signature refused",
                "Set the same passphrase in the controller and for the agent",
            )  # fmt: skip
        elif link.signed and not link.has_key:
            self._log.say(
                SIGNING_TOPIC, "no key", FindingLevel.WARNING,
                "signing: the flight controller signs its messages, and will refuse ours, which are not signed",
                "kiteline: no key for signing", "Give the agent the key, or switch signing off in the ground station",
            )  # fmt: skip

    def _say_deaf(self, link: LinkState) -> None:
        remedy = (
            "It accepts signed messages only: give the agent its key"
            if link.signed and not link.has_key
            else "Check the wire from our TX to its RX, the URL's direction, and whether it wants signed messages"
        )
        self._log.say(
            ANSWER_TOPIC, "none", FindingLevel.ERROR,
            "flight controller: heard, but it answers nothing that it is asked",
            "kiteline: controller does not answer", remedy,
        )  # fmt: skip
