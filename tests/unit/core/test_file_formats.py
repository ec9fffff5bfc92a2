"""The exporter that reads a file is chosen by the name of the file."""

from pathlib import Path

import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.registry import file_formats
from crossgrad_core.registry.file_formats import exporter_for


@pytest.mark.parametrize(
    ("name", "kind"),
    [("a.ply", "Ply"), ("A.PLY", "Ply"), ("a.compressed.ply", "Ply"), ("a.b.sog", "Sog"),
     ("a.splat", "Splat")],
)  # fmt: skip
def test_the_suffix_names_the_exporter(name, kind):
    assert type(exporter_for(Path("x.sog") / name)).__name__ == kind


@pytest.mark.parametrize("name", ["a", "a.txt", "ply", "a.ply.gz"])
def test_another_name_is_one_error_with_the_suffixes_that_are_read(name):
    with pytest.raises(UserError) as caught:
        exporter_for(Path(name), "--init")
    assert caught.value.where == f"--init {name}"
    assert ".ply" in caught.value.expected and ".sog" in caught.value.expected


def test_a_common_file_imports_no_other_exporter(monkeypatch):
    built = []
    build = file_formats.build
    monkeypatch.setattr(
        file_formats,
        "build",
        lambda slot, name, options: built.append(name) or build(slot, name, options),
    )
    exporter_for(Path("a.sog"))
    assert built == ["sog"]
