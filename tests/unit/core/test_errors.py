"""The wording of UserError."""

from crossgrad_core.errors import LONGEST, LONGEST_PLACE, UserError


def test_each_part_of_a_message_has_its_own_line():
    error = UserError("wrong", where="a.ply", expected="x", found="y", todo="do z")
    assert str(error).splitlines() == [
        "wrong",
        "  where:    a.ply",
        "  expected: x",
        "  found:    y",
        "  to do:    do z",
    ]


def test_file_contents_in_a_message_cannot_flood_or_control_the_terminal():
    error = UserError("wrong", where="a\x1b[2J\udcff.ply", found="9" * 10_000, todo="a\tb")
    message = str(error)
    assert r"a\x1b[2J\udcff.ply" in message
    assert r"a\tb" in message
    assert len(message) < LONGEST + 200
    assert "999 ... 999" in message
    message.encode()


def test_every_part_of_a_message_has_a_maximum_length():
    text = "\0" * 2000
    error = UserError(text, where=text, expected=text, found=text, todo=text)
    assert len(str(error)) < 4 * LONGEST + LONGEST_PLACE + 100


def test_a_path_in_a_message_is_not_shortened():
    path = "/".join(["folder"] * 140)
    assert path in str(UserError("wrong", where=path))
