"""Each source against a real other end on this machine, within bounded time."""

from __future__ import annotations

import importlib.util
import os
import socket
from collections.abc import Callable
from threading import Thread
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from factories.joints import joint
from factories.recordings import matches
from jaximp.live import lsl, ros, sockets, sources
from jaximp.live.clock import Batch
from jaximp.live.sockets import TcpSource, UdpSource
from jaximp.live.sources import Iterated, Piped, Pushed, Replay, Source

SAMPLES = np.column_stack([np.arange(400) / 1000, np.arange(400.0), -np.arange(400.0)])
LINES = [f"{t!r},{q!r},{m!r}\n".encode() for t, q, m in SAMPLES.tolist()]
LONGEST = 10.0
"""Seconds that a test waits, at most."""
PIECES = 1000
"""Of which a source may take as many to say what it has."""


def read_all(source: Source, enough: int = len(SAMPLES)) -> NDArray[np.float64]:
    """Until there are so many samples, or the end."""
    found = [np.empty((0, 3))]
    for _ in range(PIECES):
        batch = source.read(LONGEST / PIECES)
        if batch is None:
            break
        found.append(np.column_stack(batch))
        if sum(map(len, found)) >= enough:
            break
    return np.concatenate(found)


def test_a_pipe() -> None:
    end, begin = os.pipe()

    def write() -> None:
        with os.fdopen(begin, "wb") as file:
            file.writelines(LINES)

    Thread(target=write).start()
    source = Piped(end)
    np.testing.assert_array_equal(read_all(source, 10**6), SAMPLES)
    assert source.read(0.0) is None
    os.close(end)


def test_a_pipe_that_is_silent_does_not_hold_up() -> None:
    end, begin = os.pipe()
    batch = Piped(end).read(0.01)
    assert batch is not None
    assert len(batch.time) == 0
    os.close(begin)
    os.close(end)


def test_tcp_and_a_sender_that_leaves_and_returns() -> None:
    source = TcpSource(0)
    with socket.create_connection(("127.0.0.1", source.port)) as sender:
        sender.sendall(b"".join(LINES[:200]))
        first = read_all(source, 200)
    with socket.create_connection(("127.0.0.1", source.port)) as sender:
        sender.sendall(b"".join(LINES[200:]))
        second = read_all(source, 200)
    np.testing.assert_array_equal(np.concatenate([first, second]), SAMPLES)
    source.close()
    assert source.read(0.0) is None


def test_udp() -> None:
    source = UdpSource(0)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    found = []
    for k in range(0, len(LINES), 20):  # one after the other: datagrams may be lost where nobody reads
        sender.sendto(b"".join(LINES[k : k + 20]), ("127.0.0.1", source.port))
        found.append(read_all(source, 20))
    np.testing.assert_array_equal(np.concatenate(found), SAMPLES)
    sender.close()
    source.close()
    assert source.read(0.0) is None


@pytest.mark.parametrize("kind", [TcpSource, UdpSource])
def test_others_need_a_token(kind: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=matches("give a token with --token, or listen on 127.0.0.1")):
        kind(0, "0.0.0.0")
    kind(0, "0.0.0.0", token="secret").close()


@pytest.mark.parametrize(("shown", "count"), [(b"token secret\n", 400), (b"token wrong\n", 0), (b"1,2,3\n", 0)])
def test_who_does_not_know_the_token_is_not_heard(shown: bytes, count: int) -> None:
    tcp, udp = TcpSource(0, token="secret"), UdpSource(0, token="secret")
    with socket.create_connection(("127.0.0.1", tcp.port)) as sender:
        sender.sendall(shown + b"".join(LINES))
        heard = [tcp.read(0.05) for _ in range(5)] if not count else [Batch(*read_all(tcp).T)]
    assert sum(len(one.time) for one in heard if one is not None) == count
    datagram = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    datagram.sendto(shown + b"".join(LINES), ("127.0.0.1", udp.port))
    batch = udp.read(1.0)
    assert batch is not None
    assert len(batch.time) == count
    assert (tcp.unreadable, udp.unreadable) == ((0, 0) if count else (1, 1))
    for one in (datagram, tcp, udp):
        one.close()


def test_a_flood_is_cut_off_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "MOST_PER_SECOND", 100)
    source = UdpSource(0)
    source._allowance._left = 100
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.sendto(b"".join(LINES), ("127.0.0.1", source.port))
    batch = source.read(1.0)
    assert batch is not None
    assert len(batch.time) == 100
    assert source.lost == 300
    sender.close()
    source.close()


def test_a_port_that_is_taken_is_one_line() -> None:
    source = TcpSource(0)
    with pytest.raises(ValueError, match=matches("choose another port")):
        TcpSource(source.port)
    source.close()


def test_a_recording_is_replayed_at_its_speed_or_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = joint(np.arange(400) / 1000)
    wanted = np.column_stack([recording.time, recording.position, recording.torque])
    np.testing.assert_array_equal(read_all(Replay(recording, np.inf), 10**6), wanted)
    now = [100.0]
    monkeypatch.setattr(sources.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(sources.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    np.testing.assert_array_equal(read_all(Replay(recording, speed=4.0), 10**6), wanted)
    assert now[0] == pytest.approx(100 + recording.time[-1] / 4)


def test_iterators_and_callbacks() -> None:
    source = Iterated((t, q, m) for t, q, m in SAMPLES)
    np.testing.assert_array_equal(read_all(source, 10**6), SAMPLES)
    np.testing.assert_array_equal(read_all(Iterated([tuple(SAMPLES.T)]), 10**6), SAMPLES)
    pushed = Pushed()
    Thread(target=lambda: ([pushed.push(*one) for one in SAMPLES.tolist()], pushed.close())).start()
    np.testing.assert_array_equal(read_all(pushed, 10**6), SAMPLES)
    assert pushed.read(0.0) is None


# ---- Where others are installed.


def test_lab_streaming_layer() -> None:
    pylsl = pytest.importorskip("pylsl", reason="pylsl is not installed: pip install 'jaximp[live]'")
    info = pylsl.StreamInfo("jaximp-test-joint", "joint", 3, 1000, "double64", "jaximp-test-joint")
    channels = info.desc().append_child("channels")
    for label in ("torque", "other", "position"):
        channels.append_child("channel").append_child_value("label", label)
    outlet = pylsl.StreamOutlet(info)
    source = lsl.LslSource("jaximp-test-joint")
    source.read(0.1)
    assert outlet.wait_for_consumers(LONGEST)
    outlet.push_chunk([[m, 9.0, q] for _, q, m in SAMPLES.tolist()])
    found = read_all(source)
    np.testing.assert_array_equal(found[:, 1:], SAMPLES[:, 1:])
    assert (np.diff(found[:, 0]) > 0).all()
    source.close()
    assert source.read(0.0) is None


def test_a_stream_that_is_not_there_is_one_line() -> None:
    pytest.importorskip("pylsl", reason="pylsl is not installed: pip install 'jaximp[live]'")
    with pytest.raises(ValueError, match=matches("no stream 'nobody' was found")):
        lsl.LslSource("nobody", patience=0.2)


@pytest.mark.skipif(importlib.util.find_spec("pylsl") is not None, reason="pylsl is installed")
def test_without_pylsl_one_line_says_how_to_get_it() -> None:
    with pytest.raises(ValueError, match=matches("pip install 'jaximp[live]'")):
        lsl.LslSource("any")


def test_joint_states() -> None:
    rclpy = pytest.importorskip("rclpy", reason="there is no ROS 2 here")
    from sensor_msgs.msg import JointState

    source = ros.RosSource("/jaximp_test", "knee")
    context = rclpy.context.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("jaximp_test", context=context)
    publisher = node.create_publisher(JointState, "/jaximp_test", 1000)
    for _ in range(PIECES):
        if not publisher.get_subscription_count():
            source.read(LONGEST / PIECES)
    message = JointState(name=["hip", "knee"], position=[0.0, 1.0], effort=[0.0, 2.0])
    message.header.stamp.sec = 3
    publisher.publish(message)
    np.testing.assert_array_equal(read_all(source, 1), [[3.0, 1.0, 2.0]])
    source.close()
    node.destroy_node()
    context.try_shutdown()


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="ROS 2 is installed")
def test_without_ros_one_line_says_so() -> None:
    with pytest.raises(ValueError, match=matches("joint states need ROS 2")):
        ros.RosSource()
