"""A second signal ends a command that a library keeps in one call, such as an endless loop of an exported file."""

import signal
import subprocess
import sys
import time

# Python's handlers do not run before this sum returns, after minutes.
STUCK = """
import numpy as np
from bevcli.cli.stop_signals import StopSignals
numbers = np.broadcast_to(np.float32(1), (1 << 20, 1 << 20))
with StopSignals("frame"):
    print("ready", flush=True)
    numbers.sum()
"""


def test_a_second_signal_ends_a_call_that_does_not_return():
    with subprocess.Popen([sys.executable, "-c", STUCK], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout.readline() == b"ready\n"
            time.sleep(0.2)
            process.send_signal(signal.SIGTERM)
            time.sleep(0.1)
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 128 + signal.SIGTERM
        finally:
            process.kill()
