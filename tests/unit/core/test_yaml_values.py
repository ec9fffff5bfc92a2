"""YAML of settings: bounded, plain, and read back as it was written."""

import time

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from crossgrad_core.errors import UserError
from crossgrad_core.system.yaml_values import MOST_VALUES, read_mapping, read_yaml, write_yaml

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n"
    for old, new in zip("abcdefghi", "bcdefghij", strict=True)
)

WORDS = st.one_of(
    st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=8),
    st.sampled_from(
        ["1e-3", "no", "12:30", "~", "", "null", "0x10", "=", "<<", "1_000", ".inf", "- a", "a: b"]
    ),
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | WORDS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3),
    max_leaves=12,
)


def refused(text: str, *words: str) -> None:
    start = time.process_time()
    with pytest.raises(yaml.YAMLError) as caught:
        read_yaml(text)
    assert time.process_time() - start < 5
    message = str(caught.value)
    assert not [word for word in words if word not in message], message
    assert len(message) < 1000


@given(st.dictionaries(WORDS, VALUES, max_size=4))
def test_yaml_values_survive_a_round_trip(settings):
    found = read_yaml(write_yaml(settings))
    assert found == settings
    assert repr(found) == repr(settings)  # 1 is not 1.0, and -0.0 is not 0.0


@given(st.dictionaries(WORDS, WORDS, max_size=4))
def test_pyyaml_reads_the_written_values_alike(settings):
    assert yaml.safe_load(write_yaml(settings)) == settings


def test_an_alias_bomb_is_refused_at_once():
    refused(BOMB, "including aliases", "line")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a [*a]", "levels deep"),
        ("a: " + "[" * 400, "levels deep"),
        ("- " * 400, "levels deep"),
        ("a: [" + "1," * (MOST_VALUES + 9) + "]", "values"),
        ("a: 1\n" * 100_000, "KiB"),
        ("a: 1\nb: 2\na: 3", "'a' occurs twice"),
        ("x: {a: 1, 'a': 3}", "'a' occurs twice"),
        ("? [a]\n: 1", "not a string"),
        ("a: " + "9" * 5000, "digits"),
        ("a: .nan", "NaN"),
        ("a: !!python/object/apply:os.system [ls]", "not supported"),
        ("a: !!int abc", "not a valid int"),
        ("a: !!float abc", "not a valid float"),
        ("a: !!bool abc", "not a valid bool"),
        ("a: !!int [1]", "not supported"),
        ("a: !!set {a}", "not supported"),
        ("a: !mine 3", "not supported"),
        ('a: "\\U00110000"', "is not valid"),
        ('a: "\\uD800"', "character"),
        ('a: "x\\0y"', "character"),
        ("%YAML " + "9" * 5000 + ".1\n---\na: 1", ""),
        ("a: *b", "undefined alias"),
        ("a: 1\n---\nb: 2", "another document"),
        ("a: \x07", ""),
    ],
)
def test_yaml_values_that_are_not_settings_are_refused_with_their_position(text, words):
    refused(text, words)


def test_values_of_yaml_aliases_are_copies():
    found = read_yaml("a: &x {b: [1]}\nc: *x\nd: *x")
    assert found == {"a": {"b": [1]}, "c": {"b": [1]}, "d": {"b": [1]}}
    assert isinstance(found, dict)
    assert found["a"] is not found["c"]
    assert found["c"]["b"] is not found["d"]["b"]


def test_yaml_tags_of_plain_values_are_accepted():
    text = "a: !!str 5\nb: !!int 7\nc: !!float 3\nd: !!null ''\ne: !!bool true"
    assert read_yaml(text) == {"a": "5", "b": 7, "c": 3.0, "d": None, "e": True}


def test_a_text_of_the_largest_allowed_size_is_read_quickly():
    text = "# a comment\n" * 20_000
    start = time.process_time()
    assert read_yaml(text) is None
    assert time.process_time() - start < 10


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfea\0", "cannot be read"),
        (b"- a\n", "contains no settings"),
        (b"a: [", "not valid YAML"),
    ],
)
def test_a_broken_file_gives_one_error(tmp_path, content, words):
    path = tmp_path / "run.yaml"
    path.write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        read_mapping(path, "the file", "mend it")
    assert (caught.value.where, caught.value.todo) == (str(path), "mend it")


def test_a_byte_order_mark_and_windows_line_ends_are_accepted(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    assert read_mapping(path, "the file", "mend it") == {"a": 1, "b": 2}
