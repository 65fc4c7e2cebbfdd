"""Frames are found by the similarity of their vectors."""

import shutil

import numpy as np
import pytest
import torch
from command_line import MINI_TOML
from memory_drive import MemorySequence
from recorded_drive import predict
from small_fleet import make_job, results_of, write_drive

from bevcli.errors import InputError
from bevcli.runs.state import save_state
from bevcli.workshop.batch.drives import find_drives
from bevcli.workshop.batch.find_like import (
    EMBEDDINGS,
    FramePooling,
    find_like,
    open_query,
    read_embeddings,
    similar_frames_page,
)
from bevcli.workshop.batch.run_batch import run_batch
from bevcli.workshop.batch.storage import open_storage


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    """A batch of three drives; "copy" has the frames of "one" in another file order of its input."""
    folder = tmp_path_factory.mktemp("similar")
    (folder / "mini.toml").write_text(MINI_TOML)
    for name, seed in (("one", 1), ("copy", 1), ("other", 20)):
        write_drive(folder / "drives" / name, seed)
    job = make_job(folder / "out", folder / "mini.toml", embed=True)
    run_batch(job, job.load_model(), find_drives([str(folder / "drives/*")])[0])
    return folder / "out"


def test_a_frames_vector_is_mean_and_deviation_of_its_features(tmp_path):
    frame = MemorySequence().load(2)
    prediction = predict(frame)
    pooling = FramePooling("model")
    pooling.add(frame, prediction)
    pooling.write(tmp_path)
    found = read_embeddings(tmp_path / EMBEDDINGS)
    features = prediction.bev.numpy()
    expected = np.concatenate([features.mean(axis=0), features.std(axis=0, ddof=1)])
    np.testing.assert_allclose(found.vectors, expected[None], rtol=1e-5, atol=1e-6)
    assert found.frames.tolist() == [2]
    assert found.timestamps_ns.tolist() == [frame.stamp.timestamp_ns]


def test_the_same_frame_of_a_copy_is_the_most_similar(batch):
    storage = open_storage(str(batch))
    query = open_query("one", 2, storage)
    found = find_like(query, storage, count=4)
    assert (found[0].result, found[0].frame) == (results_of(batch)["copy"].name, 2)
    assert found[0].similarity == pytest.approx(1, abs=1e-6)
    assert [each.similarity for each in found] == sorted([each.similarity for each in found], reverse=True)
    assert (query.result, 2) not in [(each.result, each.frame) for each in found]
    assert query.result not in [each.result for each in find_like(query, storage, count=100)]
    assert len(find_like(query, storage, count=100)) == 6
    assert len(find_like(query, storage, count=100, same_drive=True)) == 8
    assert len(find_like(query, storage, count=100, per_drive=1, same_drive=True)) == 3


def test_a_run_outside_of_the_batch_is_found_in_it(batch, tmp_path):
    shutil.copytree(results_of(batch)["one"], tmp_path / "elsewhere")
    storage = open_storage(str(batch))
    found = find_like(open_query(str(tmp_path / "elsewhere"), 1, storage), storage, count=2)
    assert {each.result for each in found} == {results_of(batch)[name].name for name in ("one", "copy")}


def test_the_page_shows_a_thumbnail_of_every_frame(batch):
    storage = open_storage(str(batch))
    query = open_query("one", 0, storage)
    page = similar_frames_page(query, storage, find_like(query, storage, count=1))
    assert page.count("data:image/jpeg;base64,/9j/") == 2


def test_what_cannot_be_searched_is_named(batch, tmp_path):
    storage = open_storage(str(batch))
    with pytest.raises(InputError, match=r"`frame=9`: one-.* has no vector of this frame \(found frames 0 to 2\)"):
        find_like(open_query("one", 9, storage), storage)
    with pytest.raises(InputError, match="nobody: is not a drive of the batch"):
        open_query("nobody", 0, storage)
    query = open_query("one", 0, storage)
    with pytest.raises(InputError, match=r"no drive has embeddings\.safetensors"):
        find_like(query, open_storage(str(tmp_path)))
    result = tmp_path / "drives/x-0"
    result.mkdir(parents=True)
    save_state(result / EMBEDDINGS, {"vectors": torch.zeros(1)})
    with pytest.raises(InputError, match=r"embeddings\.safetensors: the state cannot be read"):
        find_like(query, open_storage(str(tmp_path)))
    pooling = FramePooling("another model")
    pooling.write(result)
    with pytest.raises(InputError, match="its vectors are of other models"):
        find_like(query, open_storage(str(tmp_path)))
