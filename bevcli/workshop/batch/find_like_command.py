"""`bevcli find-like`: the frames of a batch that are most similar to one frame."""

from typing import Annotated

from bevcli.cli.bridge import argument
from bevcli.printing import say
from bevcli.workshop.batch.options import FindLikeOptions

PANEL = "Look"


def find_like(
    run: Annotated[
        str,
        argument(
            "The drive of the frame: its name in the batch, or a result folder of `bevcli batch --embed`.", reads=None
        ),
    ],
    options: FindLikeOptions,
) -> None:
    """List the frames of all drives of a batch that are most similar to frame K of RUN.

    Frames are compared by their vectors, the pooled BEV features that `bevcli batch --embed` writes. A page shows a
    thumbnail of each frame.
    """
    from bevcli.workshop.batch.find_like import find_like, open_query, similar_frames_page
    from bevcli.workshop.batch.storage import open_storage
    from bevcli.writing import write_whole

    storage, html = open_storage(options.batch), options.html
    query = open_query(run, options.frame, storage)
    found = find_like(query, storage, options.count, options.per_drive, same_drive=options.same_drive)
    width = max((len(each.result) for each in found), default=0)
    say(f"{'similarity':>10}  {'drive':<{width}}  frame")
    for each in found:
        say(f"{each.similarity:>10.3f}  {each.result:<{width}}  {each.frame:>5}")
    content = similar_frames_page(query, storage, found)
    if html is None:
        storage.write("find-like.html", content.encode())
    else:
        write_whole(html, content.encode())
    say(f"written  {html or f'{storage.where}/find-like.html'}")
