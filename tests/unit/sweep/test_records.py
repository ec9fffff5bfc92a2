"""Records of workers: append-only, whole whatever happened."""

import errno
import json
import os

import pytest

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.run_status import append, read_records


def add(folder, worker="1", **more):
    append(folder, {"event": "begun", "run": "a", "worker": worker, **more})


def test_lines_of_all_workers_are_read_in_the_order_of_time(tmp_path):
    for worker, run in (("1", "a"), ("2", "b"), ("1", "c")):
        add(tmp_path, worker, run=run)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.jsonl", "2.jsonl"]
    found = read_records(tmp_path)
    assert {each.run for each in found} == set("abc")
    assert [each.time for each in found] == sorted(each.time for each in found)


FOREIGN = b'{"event": "ended", "run": "a", "worker": 3, "time": 5, "host": "x"}\n'


@pytest.mark.parametrize(
    "torn", [b'{"event": "beg', b"{}\n", b"[1]\n", b'\xff\xfe\n{"a": 1}', FOREIGN]
)
def test_a_damaged_line_loses_no_other_line(tmp_path, torn):
    add(tmp_path)
    with (tmp_path / "1.jsonl").open("ab") as file:
        file.write(torn)
    add(tmp_path, run="b")
    assert [each.run for each in read_records(tmp_path)] == ["a", "b"]


def test_a_line_is_json_with_time_and_machine(tmp_path):
    add(tmp_path, event="ended", status="finished", seconds=1.5)
    line = json.loads((tmp_path / "1.jsonl").read_text())
    assert line.keys() == {"event", "run", "worker", "time", "host", "status", "seconds"}


def test_a_full_disk_is_reported(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(UserError, match="not enough disk space"):
        add(tmp_path)
