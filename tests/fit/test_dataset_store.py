"""Data sets on disk: nothing finished is lost, nothing is made twice at a time, nothing wrong is read."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import signal
import tarfile
import time
from pathlib import Path

import numpy as np
import pytest

from usdfab.errors import UsdfabError
from usdfab.fit.dataset import produce as producing, settings as settings_module, store as storing
from usdfab.fit.dataset.produce import local_workers, produce
from usdfab.fit.dataset.reader import read_dataset
from usdfab.fit.dataset.records import sample_record
from usdfab.fit.dataset.render import Rendered, encode_image
from usdfab.fit.dataset.samples import draw_sample
from usdfab.fit.dataset.settings import Settings
from usdfab.fit.dataset.store import Store, encode_record

SETTINGS = Settings(prior="paper", size=8, spp=1, shard=4)


def fake_sample(settings: Settings, index: int) -> Rendered:
    """A sample whose picture is its number: drawing is real, rendering is not."""
    image = encode_image(np.full((settings.size, settings.size, 3), index / 64, dtype=np.float32))
    sample = draw_sample(settings.prior, settings.seed, index)
    return Rendered(index, sample_record(sample, settings.rendering(), image), image, 0.0)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(producing, "render_sample", fake_sample)


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_full_shards_are_packed_and_the_rest_is_loose(tmp_path: Path, fake: None) -> None:
    made = produce(Store(tmp_path, SETTINGS), range(10))
    assert (made.made, made.there, made.others) == (10, 0, 0)
    assert [p.name for p in sorted((tmp_path / "shards").iterdir())] == ["shard-00000.tar", "shard-00001.tar"]
    assert sorted(p.name for p in (tmp_path / "loose").iterdir()) == [
        f"00000{i}.{kind}" for i in (8, 9) for kind in ("exr", "json")
    ]
    assert not list((tmp_path / "claims").iterdir())
    with tarfile.open(tmp_path / "shards/shard-00001.tar") as tar:
        assert tar.getnames() == [f"00000{i}.{kind}" for i in range(4, 8) for kind in ("exr", "json")]
    found = list(read_dataset(tmp_path))
    assert [stored.index for stored in found] == list(range(10))
    for stored in found:
        np.testing.assert_allclose(stored.image, stored.index / 64, rtol=2e-3)
        assert stored.sample == draw_sample("paper", 0, stored.index)


def test_however_the_work_is_divided_the_files_are_the_same(tmp_path: Path, fake: None) -> None:
    produce(Store(tmp_path / "a", SETTINGS), range(10))
    for i in (2, 0, 1):  # as --part 3/3, 1/3, 2/3
        produce(Store(tmp_path / "b", SETTINGS), range(i, 10, 3))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_a_second_run_makes_only_what_is_missing(tmp_path: Path, fake: None) -> None:
    produce(Store(tmp_path, SETTINGS), range(6))
    before = contents(tmp_path)
    made = produce(Store(tmp_path, SETTINGS), range(7))
    assert (made.made, made.there) == (1, 6)
    after = contents(tmp_path)
    assert {name: after[name] for name in before} == before


def test_a_claimed_sample_is_left_to_its_claimant(tmp_path: Path, fake: None) -> None:
    with Store(tmp_path, SETTINGS).claim(1) as mine:
        assert mine
        made = produce(Store(tmp_path, SETTINGS), range(3))
    assert (made.made, made.others) == (2, 1)
    assert produce(Store(tmp_path, SETTINGS), range(3)).made == 1


def _claim_and_wait(root: Path, ready: multiprocessing.synchronize.Event) -> None:
    with Store(root, SETTINGS).claim(0) as mine:
        assert mine
        ready.set()
        time.sleep(600)


def test_a_killed_process_holds_no_claim(tmp_path: Path, fake: None) -> None:
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_claim_and_wait, args=(tmp_path, ready))
    process.start()
    assert ready.wait(120)
    with Store(tmp_path, SETTINGS).claim(0) as mine:
        assert not mine
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert produce(Store(tmp_path, SETTINGS), [0]).made == 1


def _die(settings: Settings, index: int) -> Rendered:
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return fake_sample(settings, index)


def test_a_worker_that_dies_is_said_and_loses_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(producing, "render_sample", _die)
    with local_workers(1) as pool, pytest.raises(UsdfabError, match="a worker died"):
        produce(Store(tmp_path, SETTINGS), range(4), pool, 1)
    monkeypatch.setattr(producing, "render_sample", fake_sample)
    made = produce(Store(tmp_path, SETTINGS), range(4))
    assert (made.there, made.made) == (2, 2)


@pytest.mark.parametrize("times", range(7))
def test_a_full_disk_is_said_and_the_run_goes_on_later(
    tmp_path: Path, fake: None, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    """Two samples in a shard: 5 files are written, any of which may find the disk full."""
    few = Settings(prior="paper", size=8, spp=1, shard=2)
    store, left, sync = Store(tmp_path, few), [times], os.fsync

    def full(file: int) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(file)

    monkeypatch.setattr(storing.os, "fsync", full)
    if times < 5:
        with pytest.raises(UsdfabError, match=r"the disk is full; make room"):
            produce(store, range(2))
    else:
        assert produce(store, range(2)).made == 2
    monkeypatch.setattr(storing.os, "fsync", sync)
    again = produce(Store(tmp_path, few), range(2))
    assert again.there == min(times // 2, 2)
    Store(tmp_path, few).pack(0)
    assert [stored.index for stored in read_dataset(tmp_path)] == [0, 1]
    assert [p.name for p in (tmp_path / "shards").iterdir()] == ["shard-00000.tar"]
    assert not list((tmp_path / "loose").iterdir())


@pytest.mark.parametrize("change", [{"seed": 1}, {"spp": 2}, {"size": 9}, {"prior": "wide"}, {"shard": 5}])
def test_other_settings_are_refused_in_one_line(tmp_path: Path, change: dict) -> None:
    Store(tmp_path, SETTINGS)
    with pytest.raises(UsdfabError, match=f"another one .*{next(iter(change))}") as caught:
        Store(tmp_path, Settings(**({"prior": "paper", "size": 8, "spp": 1, "shard": 4} | change)))
    assert "\n" not in str(caught.value)


def test_another_parameter_table_is_refused(tmp_path: Path, fake: None, monkeypatch: pytest.MonkeyPatch) -> None:
    produce(Store(tmp_path, SETTINGS), range(1))
    monkeypatch.setattr(settings_module, "table_hash", lambda: "0123456789abcdef")
    for use in (lambda: Store(tmp_path, SETTINGS), lambda: list(read_dataset(tmp_path))):
        with pytest.raises(UsdfabError, match="another parameter table"):
            use()


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.999, -1])
def test_a_truncated_shard_is_named_and_not_skipped(tmp_path: Path, fake: None, keep: float) -> None:
    produce(Store(tmp_path, SETTINGS), range(4))
    shard = tmp_path / "shards/shard-00000.tar"
    size = shard.stat().st_size
    # Tar pads its files to 10 kB: what lies within the padding may be lost, so the end is counted from the content.
    with tarfile.open(shard) as tar:
        last = tar.getmembers()[-1]
    end = last.offset_data + last.size
    os.truncate(shard, {0: 0, 100: 100, 0.5: size // 2, 0.999: end - 1, -1: end}[keep])
    for use in (lambda: list(read_dataset(tmp_path)), lambda: Store(tmp_path, SETTINGS)):
        with pytest.raises(UsdfabError, match=r"shard-00000\.tar: the shard is damaged or cut off; remove it"):
            use()
    shard.unlink()
    assert produce(Store(tmp_path, SETTINGS), range(4)).made == 4


def test_a_changed_image_is_found(tmp_path: Path, fake: None) -> None:
    produce(Store(tmp_path, SETTINGS), range(5))
    shard, loose = tmp_path / "shards/shard-00000.tar", tmp_path / "loose/000004.exr"
    with tarfile.open(shard) as tar:
        place = tar.getmember("000002.exr").offset_data
    content = bytearray(shard.read_bytes())
    content[place + 300] ^= 1
    shard.write_bytes(content)
    with pytest.raises(UsdfabError, match=r"000002\.json: the image is damaged"):
        list(read_dataset(tmp_path))
    content[place + 300] ^= 1
    shard.write_bytes(content)
    os.truncate(loose, 200)
    with pytest.raises(UsdfabError, match=r"000004\.json: the image is damaged"):
        list(read_dataset(tmp_path))
    loose.unlink()
    with pytest.raises(UsdfabError, match="no image"):
        list(read_dataset(tmp_path))


def test_an_image_without_record_is_made_again(tmp_path: Path, fake: None) -> None:
    """As a process leaves it that dies between the two."""
    produce(Store(tmp_path, SETTINGS), range(2))
    (tmp_path / "loose/000001.json").unlink()
    os.truncate(tmp_path / "loose/000001.exr", 10)
    assert produce(Store(tmp_path, SETTINGS), range(2)).made == 1
    assert len(list(read_dataset(tmp_path))) == 2


def test_loose_copies_of_packed_samples_go(tmp_path: Path, fake: None) -> None:
    """As a process leaves them that dies after packing."""
    produce(Store(tmp_path, SETTINGS), range(4))
    rendered = fake_sample(SETTINGS, 1)
    (tmp_path / "loose/000001.exr").write_bytes(rendered.image)
    (tmp_path / "loose/000001.json").write_bytes(encode_record(rendered.record))
    assert [stored.index for stored in read_dataset(tmp_path)] == [0, 1, 2, 3]
    Store(tmp_path, SETTINGS)
    assert not list((tmp_path / "loose").iterdir())


def test_temporary_files_of_the_dead_go_and_those_of_the_living_stay(tmp_path: Path) -> None:
    Store(tmp_path, SETTINGS)
    old, new = tmp_path / "loose/.000001.abc.exr", tmp_path / "loose/.000002.abc.exr"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (1.0, 1.0))
    Store(tmp_path, SETTINGS)
    assert not old.exists() and new.exists()


def test_folders_that_are_no_data_set(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("mine")
    with pytest.raises(UsdfabError, match="holds other things"):
        Store(tmp_path / "other", SETTINGS)
    with pytest.raises(UsdfabError, match="a file is in the folder's place"):
        Store(tmp_path / "other/notes.txt", SETTINGS)
    with pytest.raises(UsdfabError, match="no data set here"):
        list(read_dataset(tmp_path / "other"))
    Store(tmp_path / "set", SETTINGS)
    for text in ("{", "[]", json.dumps({"schema": "usdfab-dataset/9"}), "{}"):
        (tmp_path / "set/dataset.json").write_text(text)
        with pytest.raises(UsdfabError, match=r"dataset\.json"):
            list(read_dataset(tmp_path / "set"))
