"""Signals that end a command: at once, or where what was begun is whole."""

import os
import signal
import subprocess
import sys

import pytest

from sgns.config import Interrupted, heed, heeded_signals, held_back
from sgns_testing.commands import environment

ENDINGS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2]


@pytest.fixture(autouse=True)
def usual_handlers():
    """As in a process that nobody told to ignore anything."""
    before = [signal.signal(number, signal.SIG_DFL) for number in ENDINGS]
    yield
    for number, handler in zip(ENDINGS, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDINGS)
def test_a_signal_interrupts(number):
    with pytest.raises(Interrupted) as caught, heeded_signals():
        signal.raise_signal(number)
    assert caught.value.number == number
    assert caught.value.cause == f"interrupted by {signal.Signals(number).name}"
    assert signal.getsignal(number) is signal.SIG_DFL


def test_what_was_ignored_or_is_another_s_stays():
    heard = []
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGUSR2, lambda *_: heard.append("another's"))
    with heeded_signals():
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGUSR2)
    assert heard == ["another's"]


def test_a_signal_waits_until_it_is_heeded():
    with heeded_signals():
        with pytest.raises(Interrupted) as caught, held_back():
            with held_back():
                heed()
                signal.raise_signal(signal.SIGTERM)
                signal.raise_signal(signal.SIGHUP)  # a machine that repeats itself
            heed()
            raise AssertionError
        assert caught.value.number == signal.SIGTERM
        with held_back():
            heed()  # it is forgotten


def test_a_signal_that_nobody_heeds_takes_effect_at_the_end():
    done = []
    with heeded_signals(), pytest.raises(Interrupted), held_back():
        signal.raise_signal(signal.SIGTERM)
        done.append("all")
    assert done == ["all"]


def test_a_second_ctrl_c_takes_effect_at_once():
    with heeded_signals(), pytest.raises(KeyboardInterrupt) as caught, held_back():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert not isinstance(caught.value, Interrupted)


def test_nohup_is_respected():
    code = "from sgns.config import heeded_signals as h; import signal\nwith h(): signal.raise_signal(1); print(1)"
    command = ["nohup", sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=60)
    assert done.stdout == "1\n", (done, os.environ)
