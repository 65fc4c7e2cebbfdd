"""Signals end a command also where a library keeps it in one call, such as an endless loop of an exported file."""

import signal
import subprocess
import sys
import time

import pytest

# Python's handlers do not run before the sum returns, after minutes.
STUCK = """
import numpy as np
from bevcli.cli.stop_signals import EndSignals, StopSignals
numbers = np.broadcast_to(np.float32(1), (1 << 20, 1 << 20))
EndSignals.limit_s = {limit_s}
EndSignals().start()
with {block}:
    print("ready", flush=True)
    numbers.sum()
"""
# Deletes its partial file, and would otherwise end after minutes.
CLEANING = """
import time
from bevcli.cli.stop_signals import EndSignals
EndSignals().start()
try:
    print("ready", flush=True)
    time.sleep(600)
finally:
    print("cleaned", flush=True)
"""


def ends(code: str, *signals: int, gap_s: float = 0.1) -> tuple[int, bytes]:
    """Exit code and further output of a Python program that gets these signals once it is ready."""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            assert process.stdout.readline() == b"ready\n"
            for number in signals:
                time.sleep(gap_s)
                process.send_signal(number)
            return process.wait(20), process.stdout.read()
        finally:
            process.kill()


@pytest.mark.parametrize("block", ['StopSignals("frame")', "open('/dev/null')"])
def test_a_second_signal_ends_a_call_that_does_not_return(block):
    code = STUCK.format(limit_s=600, block=block)
    assert ends(code, signal.SIGTERM, signal.SIGTERM)[0] == 128 + signal.SIGTERM


def test_one_signal_ends_a_call_that_does_not_return_in_time():
    assert ends(STUCK.format(limit_s=0.2, block="open('/dev/null')"), signal.SIGINT)[0] == 128 + signal.SIGINT


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lets_a_command_delete_its_partial_files(number):
    assert ends(CLEANING, number)[1] == b"cleaned\n"


def test_the_same_signal_at_once_again_is_one_signal():
    """`timeout` of GNU sends each signal to the program and to its group."""
    code = (
        "import os, signal, time\n"
        "from bevcli.cli.stop_signals import StopSignals\n"
        "with StopSignals('frame') as signals:\n"
        "    print('ready', flush=True)\n"
        "    for _ in range(2): os.kill(os.getpid(), signal.SIGTERM)\n"
        "    time.sleep(0.3)\n"
        "    print(signals.received(), flush=True)\n"
    )
    assert ends(code) == (0, b"True\n")
