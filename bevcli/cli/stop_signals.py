"""Ctrl-C and SIGTERM: `EndSignals` ends every command, `StopSignals` a long one after the current piece of work."""

import os
import signal
import socket
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from types import FrameType
from typing import Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)
CLEANUP_S = 10.0
ONE_SIGNAL_S = 0.05  # `timeout` of GNU sends each signal twice


class _Signals:
    """Handles signals within a `with` block. A second one ends the process, also where a library stays in one call.

    limit_s: time from the first signal to the end of the process; None without a limit.
    keeps_ignored: a signal that is ignored or handled already stays so. A job in the background ignores SIGINT.
    """

    limit_s: float | None = None
    keeps_ignored = False
    _number = 0  # of the first signal
    _before: Mapping[signal.Signals, object] = {}  # number of a signal -> its handler before

    def start(self) -> Self:
        """Handle signals from now on."""
        if threading.current_thread() is threading.main_thread():  # Python allows handlers there only
            unchanged = (signal.default_int_handler, signal.SIG_DFL)
            handled = [n for n in SIGNALS if not self.keeps_ignored or signal.getsignal(n) in unchanged]
            self._before = {number: signal.signal(number, self._receive) for number in handled}
            reader, self._writer = socket.socketpair()
            self._writer.setblocking(False)
            self._fd_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
            self._thread = threading.Thread(target=_end_at_second, args=(reader, self.limit_s), daemon=True)
            self._thread.start()
        return self

    def stop(self, *error: object) -> None:
        """Handle them as before `start`."""
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        if threading.current_thread() is threading.main_thread():
            signal.set_wakeup_fd(self._fd_before)
            self._writer.close()  # ends the thread
            self._thread.join(1.0)

    __enter__, __exit__ = start, stop

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if not self._number:
            self._number = number
            self._react(number, frame)

    def _react(self, number: int, frame: FrameType | None) -> None:
        raise NotImplementedError


class EndSignals(_Signals):
    """`EndSignals().start()` before a command: a signal raises KeyboardInterrupt or SystemExit.

    So the command deletes its partial files. It has 10 s for this and for its end, or until the second signal.
    """

    limit_s = CLEANUP_S
    keeps_ignored = True

    def _react(self, number: int, frame: FrameType | None) -> None:
        while frame is not None:
            if frame.f_code.co_filename.startswith("<frozen importlib"):  # packages turn it into other errors
                os._exit(128 + number)
            frame = frame.f_back
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)


class StopSignals(_Signals):
    """`with StopSignals("frame") as signals:`; the command asks `signals.received()` and ends.

    Args:
        work: the piece of work that is finished first, for the message.
        at_once: for work in other processes: the first signal raises KeyboardInterrupt.
    """

    def __init__(self, work: str, *, at_once: bool = False) -> None:
        self._work, self._at_once = work, at_once

    def received(self) -> bool:
        """True once a signal has come."""
        return self._number != 0

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + self._number

    def _react(self, number: int, frame: FrameType | None) -> None:
        if self._at_once:
            raise KeyboardInterrupt
        with suppress(OSError):  # the terminal may be gone
            os.write(2, f"\nstopping after this {self._work}; once more to stop at once\n".encode())


def _end_at_second(numbers: socket.socket, limit_s: float | None) -> None:
    """Ends the process at the second signal. Python calls a handler only when a long call in C returns."""
    first, since = 0, 0.0
    with numbers:
        try:
            while number := int.from_bytes(numbers.recv(1)):
                is_same = number == first and time.monotonic() - since < ONE_SIGNAL_S
                if number not in SIGNALS or is_same:
                    continue
                if first:
                    os._exit(128 + number)
                first, since = number, time.monotonic()
                numbers.settimeout(limit_s)
        except TimeoutError:
            os._exit(128 + first)
