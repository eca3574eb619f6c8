"""Who is served over UDP, TCP that comes and goes, and poses, IMU and tunnel on one serial line."""

import contextlib
import os
import socket
import threading
import time

import numpy as np
import pytest

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.connect import shared_tunnel
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import Heartbeat, VehicleImu
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink, SinkOptions
from kiteline_hw.mavlink.transport import sockets
from kiteline_hw.mavlink.transport.connection import MavlinkConnection
from kiteline_hw.mavlink.transport.url import parse_mavlink_url
from kiteline_hw.mavlink.tunnel.tunnel_end import AGENT_END, BASE_END, TunnelEnd
from kiteline_hw.ports import LinkError, PoseSample, SourceReport
from kiteline_hw.sim.flight_controller import FlightController
from kiteline_hw.sim.links.serial_pair import SerialPair
from kiteline_hw.system.clock import MonotonicClock
from tests.hw.mavlink.pushed_poses import push_while
from tests.hw.processes import free_port

CLOCK, FLU = MonotonicClock(), mounting("flu")


def heard(s: socket.socket) -> int:
    """How many datagrams have come."""
    s.setblocking(False)
    n = 0
    try:
        while s.recv(2048):
            n += 1
    except BlockingIOError:
        return n
    return n


def test_a_stranger_gets_nothing_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "_SILENT_S", 0.5)
    port = free_port(socket.SOCK_DGRAM)
    autopilot = MavlinkCodec(1, 1).encode(Heartbeat(2, 3))
    with (
        MavlinkPoseSink(f"udpin:127.0.0.1:{port}", FLU, CLOCK) as sink,
        socket.socket(type=socket.SOCK_DGRAM) as controller,
        socket.socket(type=socket.SOCK_DGRAM) as stranger,
    ):
        to = ("127.0.0.1", port)
        for data in (b"x", os.urandom(200), MavlinkCodec(255, 190).encode(Heartbeat(6, 8))):
            stranger.sendto(data, to)
        push_while(sink, lambda: sink.refused < 20)
        assert heard(stranger) == 0 and sink.autopilot() is None
        controller.sendto(autopilot, to)
        push_while(sink, lambda: sink.autopilot() is None)
        for _ in range(20):
            stranger.sendto(b"x", to)
            stranger.sendto(MavlinkCodec(1, 1).encode(Heartbeat(2, 12)), to)  # even one that speaks MAVLink
            controller.sendto(autopilot, to)
            time.sleep(0.02)
            now_ns = CLOCK.now_ns()
            sink.push(PoseSample(now_ns, np.eye(4), True, 90), now_ns)
        assert heard(stranger) == 0 and heard(controller) > 5
        found = sink.autopilot()
        assert found.autopilot == 3
        time.sleep(0.6)  # the controller's program ends, and another one begins on its host
        stranger.sendto(autopilot, to)
        push_while(sink, lambda: heard(stranger) == 0)


def test_udp_out_hears_its_target_alone() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as controller, socket.socket(type=socket.SOCK_DGRAM) as stranger:
        controller.bind(("127.0.0.1", 0))
        with MavlinkPoseSink(f"udp:127.0.0.1:{controller.getsockname()[1]}", FLU, CLOCK) as sink:
            controller.settimeout(5.0)
            _, agent = controller.recvfrom(2048)
            stranger.sendto(MavlinkCodec(1, 1).encode(Heartbeat(2, 12)), agent)
            time.sleep(0.2)
            assert sink.autopilot() is None
            controller.sendto(MavlinkCodec(1, 1).encode(Heartbeat(2, 3)), agent)
            push_while(sink, lambda: sink.autopilot() is None)


def serve_once(server: socket.socket, model: FlightController, done: threading.Event) -> None:
    """Speak as a controller to one client until told to stop, then hang up."""
    client, _ = server.accept()
    with client:
        client.settimeout(0.02)
        while not done.is_set():
            now_ns = time.monotonic_ns()
            try:
                data = client.recv(4096)
            except TimeoutError:
                data = b""
            answers = model.receive_stream(data, now_ns) if data else []
            for message in answers + model.poll(now_ns):
                client.sendall(message)


def test_a_fault_in_a_callback_does_not_end_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    taken: list[bytes] = []
    ticks: list[int] = []

    def on_data(data: bytes, datagram: bool, adopt: object) -> None:
        taken.append(data)
        raise KeyError("a fault")

    def on_tick() -> None:
        ticks.append(len(ticks))
        raise RuntimeError("can't start new thread")

    port = free_port(socket.SOCK_DGRAM)
    url = parse_mavlink_url(f"udpin:127.0.0.1:{port}")
    connection = MavlinkConnection(url, "mavlink", on_data, on_tick, 0.01, 0, required=True)
    connection.start()
    with contextlib.closing(connection), socket.socket(type=socket.SOCK_DGRAM) as controller:
        end_s = time.monotonic() + 5.0
        while len(taken) < 3 or len(ticks) < 3:
            assert time.monotonic() < end_s
            controller.sendto(b"x", ("127.0.0.1", port))
            time.sleep(0.01)
    assert connection.callback_errors >= 6 and capsys.readouterr().err.count("Traceback") == 1


def test_tcp_and_again_after_the_controller_was_restarted() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        with MavlinkPoseSink(url, FLU, CLOCK) as sink:
            for _ in range(2):
                model, done = FlightController("ardupilot"), threading.Event()
                thread = threading.Thread(target=serve_once, args=(server, model, done))
                thread.start()
                try:
                    push_while(sink, lambda model=model: len(model.accepted) < 10)  # type: ignore[misc]
                finally:
                    done.set()
                    thread.join()
                assert not model.dropped and model.codec.bad == 0
                assert sink.autopilot() is not None


def test_tcp_without_anybody() -> None:
    url = f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with pytest.raises(LinkError, match="Does the flight controller listen there"):
        MavlinkPoseSink(url, FLU, CLOCK)
    with MavlinkPoseSink(url, FLU, CLOCK, required=False) as sink:
        began = time.monotonic()
        for i in range(200):
            sink.push(PoseSample(i * 50_000_000, np.eye(4), True, 90), i * 50_000_000)
        assert time.monotonic() - began < 1.0 and sink.refused > 100
        began = time.monotonic()
    assert time.monotonic() - began < 1.2


def test_a_tcp_peer_that_does_not_read_blocks_nothing() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        MavlinkPoseSink(f"tcp:127.0.0.1:{server.getsockname()[1]}", FLU, CLOCK) as sink,
    ):
        began = time.monotonic()
        for _ in range(40_000):
            sink._send([bytes(300)])
            if sink.refused:
                break
        assert sink.refused and time.monotonic() - began < 5.0


def test_poses_imu_and_tunnel_on_one_serial_line() -> None:
    model, base = FlightController("ardupilot", system=3), TunnelEnd(BASE_END)
    imu = ControllerImu(np.ascontiguousarray(FLU[:3, :3]), 200.0, SourceReport())
    samples, up, down = 0, [], []
    with SerialPair() as pair:
        url = f"serial:{pair.a}:921600"
        options = SinkOptions(tunnel=shared_tunnel(url, f"mavlink:{url}"))
        assert options.tunnel == AGENT_END
        with MavlinkPoseSink(url, FLU, CLOCK, imu=imu, options=options) as sink:
            fd = os.open(pair.b, os.O_RDWR | os.O_NOCTTY)
            os.set_blocking(fd, False)
            done = threading.Event()

            def controller() -> None:
                """The flight controller, which forwards between its ports."""
                next_imu_ns = 0
                while not done.is_set():
                    now_ns = time.monotonic_ns()
                    try:
                        data = os.read(fd, 4096)
                    except BlockingIOError:
                        data = b""
                        time.sleep(0.001)
                    out = model.receive_stream(data, now_ns) + model.poll(now_ns)
                    up.extend(base.receive(data))
                    base.send(b"down" * 20)
                    out += base.poll(now_ns)
                    if now_ns >= next_imu_ns:
                        next_imu_ns = now_ns + 5_000_000
                        out.append(model.codec.encode(VehicleImu(now_ns // 1000, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0))))
                    for message in out:
                        with contextlib.suppress(BlockingIOError):  # a full line loses what comes
                            os.write(fd, message)

            thread = threading.Thread(target=controller)
            thread.start()
            try:

                def waiting() -> bool:
                    nonlocal samples
                    batch = sink.take_imu(CLOCK.now_ns())
                    samples += 0 if batch is None else len(batch.t_ns)
                    link = sink.tunnel_link()
                    link.send(b"up" * 50)
                    down.extend(link.receive())
                    return len(model.accepted) < 20 or samples < 100 or len(up) < 3 or len(down) < 3

                push_while(sink, waiting)
            finally:
                done.set()
                thread.join()
                os.close(fd)
    assert not model.dropped and set(up) == {b"up" * 50} and set(down) == {b"down" * 20}
    assert sink._session.codec.system == 3  # that of the vehicle


def test_which_tunnel_is_on_the_controllers_port() -> None:
    ours = "serial:/dev/ttyAMA0:921600"
    assert shared_tunnel(ours, f"mavlink:{ours}") == AGENT_END
    assert shared_tunnel(ours, "mavlink:serial:/dev/ttyUSB0:57600") is None
    assert shared_tunnel(ours, "zenoh:tcp/10.0.0.1:7447") is None and shared_tunnel(ours, "none") is None
    assert shared_tunnel("", f"mavlink:{ours}") is None
    with pytest.raises(LinkError, match="one baud rate"):
        shared_tunnel(ours, "mavlink:serial:/dev/ttyAMA0:57600")
    with pytest.raises(LinkError, match=f"expected --link mavlink:{ours}"):
        shared_tunnel(ours, "serial:/dev/ttyAMA0:921600")
