"""`bevcli find-like`: the frames of a batch that are most similar to one frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def find_like(
    run: Annotated[
        str,
        typer.Argument(
            help="The drive of the frame: its name in the batch, or a result folder of `bevcli batch --embed`."
        ),
    ],
    frame: Annotated[int, typer.Option("--frame", metavar="K", help="The index of the frame.")],
    batch: Annotated[str, typer.Option("--in", metavar="BATCH_DIR", help="Folder or URL of a batch with --embed.")],
    count: Annotated[int, typer.Option("--count", min=1, help="Number of frames.")] = 12,
    per_drive: Annotated[int, typer.Option("--per-drive", min=1, help="At most this many frames of each drive.")] = 3,
    html: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="The page with thumbnails. Default: find-like.html in the batch.", show_default=False
        ),
    ] = None,
) -> None:
    """List the frames of all drives of a batch that are most similar to frame K of RUN.

    Frames are compared by their vectors, the pooled BEV features that `bevcli batch --embed` writes. A page shows a
    thumbnail of each frame.
    """
    from bevcli.batch.find_like import find_like, open_query, similar_frames_page
    from bevcli.batch.storage import open_storage
    from bevcli.errors import OutputError

    storage = open_storage(batch)
    query = open_query(run, frame, storage)
    found = find_like(query, storage, count, per_drive)
    width = max((len(each.result) for each in found), default=0)
    print(f"{'similarity':>10}  {'drive':<{width}}  frame")
    for each in found:
        print(f"{each.similarity:>10.3f}  {each.result:<{width}}  {each.frame:>5}")
    content = similar_frames_page(query, storage, found)
    if html is None:
        storage.write("find-like.html", content.encode())
    else:
        try:
            html.write_text(content)
        except OSError as error:
            raise OutputError(f"{html}: cannot be written ({error.strerror})") from None
    print(f"written  {html or f'{storage.where}/find-like.html'}")
