"""Layout: a blueprint of rerun's viewer whose memory can be freed."""

import rerun as rr
import rerun.blueprint as rrb


class Layout(rrb.Blueprint):
    """Views in the middle, side panels collapsed.

    rerun writes a blueprint into a stream in memory that refers to itself, so that its two threads and some MB stay as
    long as the process. Call `free` once the blueprint has been sent.
    """

    def __init__(self, views: rrb.Container, time_panel: rrb.TimePanel) -> None:
        panels = rrb.SelectionPanel(state="collapsed"), rrb.BlueprintPanel(state="collapsed")
        super().__init__(views, time_panel, *panels, auto_views=False, auto_layout=False)
        self._streams: list[rr.RecordingStream] = []

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        """Called by rerun when the blueprint is sent."""
        self._streams.append(stream)
        super()._log_to_stream(stream)

    def free(self) -> None:
        """Frees what sending it took, with rerun's next `flush_and_cleanup_orphaned_recordings`."""
        while self._streams:
            self._streams.pop().disconnect()
