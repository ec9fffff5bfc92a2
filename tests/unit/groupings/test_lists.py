"""The file in which a user says which view has which label."""

import pytest

from crossgrad_core.errors import UserError
from crossgrad_plugins.groupings.lists import read_labels


def test_names_with_commas_and_windows_line_ends_are_read(tmp_path):
    path = tmp_path / "labels.csv"
    path.write_bytes('\ufeff# view, label\r\nfar/,far\r\n\r\n"a,b.jpg", near\r\n'.encode())
    assert read_labels(path) == {"far/": "far", "a,b.jpg": "near"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a.jpg,near,far\n", "does not consist of a name and a label"),
        (b"a.jpg,\n", "does not consist of a name and a label"),
        (b"a.jpg,near\na.jpg,far\n", "two labels"),
        (b'"a.jpg,near\nb.jpg,far\n', "cannot be read"),
        (b"a.jpg," + b"x" * 200_000, "cannot be read"),
        (b"\xff\xfea\0", "cannot be read"),
    ],
)
def test_an_invalid_list_of_labels_gives_one_error(tmp_path, content, words):
    path = tmp_path / "labels.csv"
    path.write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        read_labels(path)
    assert str(path) in caught.value.where
    assert caught.value.todo
