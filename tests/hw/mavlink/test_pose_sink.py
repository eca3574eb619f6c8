"""Poses over real sockets and pseudo terminals, with a modelled controller at the other end."""

import contextlib
import os
import socket
import threading
import time

import numpy as np
import pytest

from kiteline_core.frame import OdometryBatch
from kiteline_hw.mavlink.controller_odometry import ControllerOdometry, OdometrySource
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import Odometry
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.mavlink.transport.url import MavlinkUrl, parse_mavlink_url
from kiteline_hw.ports import LinkError, PoseSample
from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController
from kiteline_hw.sim.links.serial_pair import SerialPair
from kiteline_hw.system.clock import MonotonicClock
from tests.hw.mavlink.pushed_poses import push_while
from tests.hw.processes import free_port

CLOCK = MonotonicClock()
FLU = mounting("flu")


def test_udp_out_to_a_controller_with_another_clock() -> None:
    model = FlightController("px4")
    offset_ns = -3_000_000_000
    with (
        UdpFlightController(model, clock_offset_ns=offset_ns) as controller,
        MavlinkPoseSink(f"udp:127.0.0.1:{controller.port}", FLU, CLOCK) as sink,
    ):
        push_while(sink, lambda: len(model.accepted) < 10 or sink.autopilot() is None or model.clock_offset_ns is None)
        assert abs(model.clock_offset_ns + offset_ns) < 50_000_000
        last = model.accepted[-1]
        # TIMESYNC was answered: the stamp means our capture, as exactly as the offset is known
        assert -50_000_000 < last.received_ns - last.t_ns < 100_000_000
        seen = sink.autopilot()
        assert seen.autopilot == 12
        assert not model.dropped and sink.counters.timesync_answers >= 1
        assert model.heartbeats[1, 197] >= 1


def test_odometry_comes_from_a_controller_with_another_clock() -> None:
    model = FlightController("px4")
    offset_ns = -3_000_000_000
    wanted = ControllerOdometry(OdometrySource.CONTROLLER, FLU)
    with (
        UdpFlightController(model, clock_offset_ns=offset_ns) as controller,
        MavlinkPoseSink(f"udp:127.0.0.1:{controller.port}", FLU, CLOCK, odometry=wanted) as sink,
    ):
        told: list[OdometryBatch] = []

        def nothing_yet() -> bool:
            t_us = (CLOCK.now_ns() + offset_ns) // 1000
            pose = Odometry(t_us, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (1.0, 2.0, 3.0), (0.0,) * 3, (0.1,) * 21,
                            (0.01,) * 21, 0, 90)  # fmt: skip
            with controller.lock:
                controller.send(model.codec.encode(pose))
            batch = sink.take_odometry(CLOCK.now_ns())
            told.extend([] if batch is None else [batch])
            return len(told) < 5

        push_while(sink, nothing_yet)
        np.testing.assert_allclose(told[-1].velocity[-1], [1.0, -2.0, -3.0], atol=1e-6)
        assert abs(CLOCK.now_ns() - int(told[-1].t_ns[-1])) < 200_000_000


def test_udp_in_answers_the_last_sender() -> None:
    port = free_port(socket.SOCK_DGRAM)
    model = FlightController("ardupilot")
    with UdpFlightController(model) as controller, MavlinkPoseSink(f"udpin:127.0.0.1:{port}", FLU, CLOCK) as sink:
        now_ns = CLOCK.now_ns()
        sink.push(PoseSample(now_ns, np.eye(4), True, 90), now_ns)  # nobody there yet
        assert sink.refused >= 1
        controller.connect("127.0.0.1", port)
        push_while(sink, lambda: len(model.accepted) < 5)
        assert not model.dropped
        with pytest.raises(LinkError, match="cannot listen on UDP"):
            MavlinkPoseSink(f"udpin:127.0.0.1:{port}", FLU, CLOCK)


def test_serial() -> None:
    model = FlightController("ardupilot")
    with SerialPair() as pair, MavlinkPoseSink(f"serial:{pair.a}:921600", FLU, CLOCK) as sink:
        fd = os.open(pair.b, os.O_RDWR | os.O_NOCTTY)
        done = threading.Event()

        def controller() -> None:
            os.set_blocking(fd, False)
            while not done.is_set():
                now_ns = time.monotonic_ns()
                try:
                    answers = model.receive(os.read(fd, 4096), now_ns)
                except BlockingIOError:
                    answers = []
                    time.sleep(0.002)
                for message in answers + model.poll(now_ns):
                    with contextlib.suppress(BlockingIOError):  # a full line loses what comes
                        os.write(fd, message)

        thread = threading.Thread(target=controller)
        thread.start()
        try:
            push_while(sink, lambda: len(model.accepted) < 10 or sink.autopilot() is None)
        finally:
            done.set()
            thread.join()
            os.close(fd)
        assert not model.dropped


def test_without_a_controller_nothing_blocks() -> None:
    with MavlinkPoseSink(f"udp:127.0.0.1:{free_port(socket.SOCK_DGRAM)}", FLU, CLOCK) as sink:
        began = time.monotonic()
        for i in range(2000):
            sink.push(PoseSample(i * 1_000_000, np.eye(4), True, 90), i * 1_000_000)
        assert time.monotonic() - began < 2.0
        assert sink.counters.odometry > 50
        began = time.monotonic()
        sink.close()
        assert time.monotonic() - began < 1.0
        sink.push(PoseSample(10**10, np.eye(4), True, 90), 10**10)  # after the end: no error


def test_datagrams_of_other_hosts_are_ignored() -> None:
    port = free_port(socket.SOCK_DGRAM)
    with MavlinkPoseSink(f"udpin:127.0.0.1:{port}", FLU, CLOCK) as sink, socket.socket(type=socket.SOCK_DGRAM) as s:
        for _ in range(200):
            s.sendto(os.urandom(300), ("127.0.0.1", port))
        time.sleep(0.05)
        assert sink.autopilot() is None
        assert sink.counters.odometry == 0


def test_urls() -> None:
    assert parse_mavlink_url("udp:127.0.0.1:14550") == MavlinkUrl("udpout", "127.0.0.1", 14550)
    assert parse_mavlink_url("udpout:fc.local:14550") == MavlinkUrl("udpout", "fc.local", 14550)
    assert parse_mavlink_url("udpin:0.0.0.0:14540") == MavlinkUrl("udpin", "0.0.0.0", 14540)
    assert parse_mavlink_url("udpin://0.0.0.0:14540") == MavlinkUrl("udpin", "0.0.0.0", 14540)
    assert parse_mavlink_url("serial:/dev/ttyAMA0:921600") == MavlinkUrl("serial", "/dev/ttyAMA0", 921600)
    for bad in (
        "",
        "udp",
        "udp:14550",
        "udp:host:",
        "udp:host:70000",
        "tcp:5760",
        "udp:h:1?x=1",
        "udp:h:1?system=0",
        "/dev/ttyAMA0:57600",
    ):
        with pytest.raises(LinkError, match="expected udp:HOST:PORT"):
            parse_mavlink_url(bad)
    with pytest.raises(LinkError, match="expected DEVICE:BAUD"):
        parse_mavlink_url("serial:/dev/ttyAMA0")
