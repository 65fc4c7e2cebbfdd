"""StopSignals: Ctrl-C and SIGTERM end a long command after the current piece of work."""

import os
import signal
import socket
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """`with StopSignals("frame") as signals:`; the command asks `signals.received()` and ends. A second one kills it.

    Args:
        work: the piece of work that is finished first, for the message.
        at_once: for work in other processes: the first signal raises KeyboardInterrupt.
    """

    def __init__(self, work: str, *, at_once: bool = False) -> None:
        self._work, self._at_once = work, at_once
        self._number = 0
        self._before: dict[signal.Signals, object] = {}

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():  # Python allows handlers there only
            self._before = {number: signal.signal(number, self._receive) for number in SIGNALS}
            reader, self._writer = socket.socketpair()
            self._writer.setblocking(False)
            self._fd_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
            threading.Thread(target=_end_at_second, args=(reader,), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        if self._before:
            signal.set_wakeup_fd(self._fd_before)
            self._writer.close()  # ends the thread

    def received(self) -> bool:
        """True once a signal has come."""
        return self._number != 0

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + self._number

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._number = number
        for each in SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        if self._at_once:
            raise KeyboardInterrupt
        os.write(2, f"\nstopping after this {self._work}; once more to stop at once\n".encode())


def _end_at_second(numbers: socket.socket) -> None:
    """Ends the process at the second signal. Python calls `_receive` only when a long call in C returns."""
    received = 0
    with numbers:
        while number := numbers.recv(1):
            received += number[0] in SIGNALS
            if received == 2:
                os._exit(128 + number[0])
