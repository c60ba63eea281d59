"""The first Ctrl-C asks, and the second one acts."""

import os
import signal
import socket

import pytest

from eslr_jax.simulation.interrupt import Interruption


def test_only_the_second_signal_reaches_those_who_act_on_it():
    receiver, sender = socket.socketpair()
    with receiver, sender:
        sender.setblocking(False)
        receiver.setblocking(False)
        before = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        # A shell's background jobs ignore it.
        handler = signal.signal(signal.SIGINT, signal.default_int_handler)
        said = []
        try:
            with Interruption(lambda: said.append("stopping")) as stop:
                stop.begin()
                os.kill(os.getpid(), signal.SIGINT)
                assert stop.is_wanted
                stop.begin()  # as after every chunk of frames
                with pytest.raises(BlockingIOError):
                    receiver.recv(1)
                with pytest.raises(KeyboardInterrupt):
                    os.kill(os.getpid(), signal.SIGINT)
                assert receiver.recv(1) == bytes([signal.SIGINT])
        finally:
            signal.signal(signal.SIGINT, handler)
            assert signal.set_wakeup_fd(before) == sender.fileno()
    assert said == ["stopping"]
