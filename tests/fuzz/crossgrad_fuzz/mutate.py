"""Changes to files that know nothing of their format: bits, cuts, swaps, extreme numbers."""

import random
import re
import struct
from collections.abc import Callable, Sequence

from crossgrad_fuzz.case import MOST_BYTES
from crossgrad_fuzz.target import Mutator

INTEGERS = (
    *(0, 1, 2, 3, 7, 16, 64, 127, 128, 255, 256, 1000, 32767, 32768, 65535, 65536),
    *(2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1),
    *(-1, -2, -128, -32768, -(2**31), -(2**63)),
)  # fmt: skip
FLOATS = (
    *(0.0, -0.0, 1.0, -1.0, 1e-45, 1e-38, 1e-308, 5e-324, 1e10, 1e30, 3.4e38, 3.5e38),
    *(1e150, 1e200, 1.7e308, -1.7e308, float("inf"), float("-inf"), float("nan")),
)  # fmt: skip
#: Numbers in letters, and what looks like one.
NUMBERS = (
    *(str(number).encode() for number in INTEGERS),
    *(b"9" * 19, b"9" * 30, b"9" * 5000, b"1e400", b"1e-400", b"1e308", b"nan", b"inf", b"-inf"),
    *(b"1_000", b"+5", b"-0", b"00", b"0x10", b"1.5", b".", b"-", b"1e", b"", b" ", b"true"),
    *("²".encode(), "٣".encode(), "①".encode(), "१२".encode(), "½".encode()),
)  # fmt: skip
#: The same where a number of records is meant.
COUNTS = (
    *(b"0", b"1", b"2", b"3", b"7", b"2147483648", b"4294967295", b"9007199254740993"),
    *(b"9223372036854775807", b"9223372036854775808", b"18446744073709551615", b"9" * 30),
    *(b"9" * 5000, b"-1", b"+2", b"1_0", b"2.0", b"1e1", b"", "²".encode(), "٢".encode()),
)  # fmt: skip
_WORDS = (b"\0", b"\n", b"\r\n", b"\r", b" ", b"\t", b"\xff", b"\xef\xbb\xbf", b"\xff\xfe", b"\\",
          b"/", b"..", b"../", b"//", b".", b'"', b"'", b",", b":", b"#", b"\x1b[31m",
          "é".encode(), "\u2028".encode(), "\u202e".encode())  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


def _span(data: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    length = min(len(data) - start, rng.choice((1, 1, 2, 4, 8, 16, 64, len(data))))
    return start, start + length


def flip_bit(data: bytes, rng: random.Random) -> bytes:
    """One bit."""
    if not data:
        return data
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]


def set_byte(data: bytes, rng: random.Random) -> bytes:
    """One byte."""
    at = rng.randrange(len(data) + 1)
    return (
        data[:at] + bytes([rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))]) + data[at + 1 :]
    )


def insert(data: bytes, rng: random.Random) -> bytes:
    """Some bytes more."""
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice((1, 2, 4, 8, 32))) + data[at:]


def repeat(data: bytes, rng: random.Random) -> bytes:
    """A piece many times."""
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 1, 2, 10, 300)) + data[end:]


def delete(data: bytes, rng: random.Random) -> bytes:
    """A piece less."""
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def cut(data: bytes, rng: random.Random) -> bytes:
    """The file ends early, or starts late."""
    at = rng.randrange(len(data) + 1)
    return data[:at] if rng.random() < 0.8 else data[at:]


def swap(data: bytes, rng: random.Random) -> bytes:
    """Two pieces change places."""
    a, b, c, d = sorted(rng.randrange(len(data) + 1) for _ in range(4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def zeros(data: bytes, rng: random.Random) -> bytes:
    """A piece becomes zero, as a disk leaves it."""
    start, end = _span(data, rng)
    return data[:start] + bytes(end - start) + data[end:]


def binary_integer(data: bytes, rng: random.Random) -> bytes:
    """An extreme integer in either byte order."""
    size = rng.choice((1, 2, 4, 8))
    number = rng.choice(INTEGERS) % (1 << (8 * size))
    return _overwritten(data, number.to_bytes(size, rng.choice(("little", "big"))), rng)


def binary_float(data: bytes, rng: random.Random) -> bytes:
    """An extreme floating-point number in either byte order."""
    form, number = rng.choice("fd"), rng.choice(FLOATS)
    try:
        packed = struct.pack(rng.choice("<>") + form, number)
    except OverflowError:
        packed = struct.pack("<d", number)
    return _overwritten(data, packed, rng)


def _overwritten(data: bytes, piece: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(max(1, len(data) - len(piece) + 1))
    if rng.random() < 0.5:
        at -= at % len(piece)
    return data[:at] + piece + data[at + len(piece) :]


def number(data: bytes, rng: random.Random) -> bytes:
    """A number in letters becomes another, or none."""
    found = [match.span() for match in _NUMBER.finditer(data[:MOST_BYTES])]
    if not found:
        return data
    start, end = rng.choice(found)
    return data[:start] + rng.choice(NUMBERS) + data[end:]


def word(data: bytes, rng: random.Random) -> bytes:
    """A character that formats treat in a way of its own."""
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(_WORDS) + data[at:]


def lines(data: bytes, rng: random.Random) -> bytes:
    """A line goes, comes twice, or changes places with another."""
    parts = data.split(b"\n")
    i, j = rng.randrange(len(parts)), rng.randrange(len(parts))
    match rng.randrange(3):
        case 0:
            del parts[i]
        case 1:
            parts.insert(j, parts[i])
        case _:
            parts[i], parts[j] = parts[j], parts[i]
    return b"\n".join(parts)


def words(data: bytes, rng: random.Random) -> bytes:
    """A word of a line goes, comes twice, or changes places with another."""
    parts = data.split(b"\n")
    at = rng.randrange(len(parts))
    pieces = re.split(rb"([ ,:/\t]+)", parts[at])
    i, j = rng.randrange(len(pieces)), rng.randrange(len(pieces))
    match rng.randrange(3):
        case 0:
            del pieces[i]
        case 1:
            pieces.insert(j, pieces[i])
        case _:
            pieces[i], pieces[j] = pieces[j], pieces[i]
    parts[at] = b"".join(pieces)
    return b"\n".join(parts)


def ends(data: bytes, rng: random.Random) -> bytes:
    """Line ends and encodings of other systems."""
    match rng.randrange(5):
        case 0:
            return data.replace(b"\n", b"\r\n")
        case 1:
            return data.replace(b"\n", b"\r")
        case 2:
            return b"\xef\xbb\xbf" + data
        case 3:
            return data.decode("latin-1").encode(rng.choice(("utf-16", "utf-16-le", "utf-32")))
        case _:
            return data.rstrip(b"\n")


BLIND: tuple[Mutator, ...] = (
    flip_bit, flip_bit, set_byte, insert, repeat, delete, cut, swap, zeros, binary_integer,
    binary_integer, binary_float, number, number, word, lines, words, ends,
)  # fmt: skip


def inserter(pieces: Sequence[bytes]) -> Mutator:
    """Puts one of the pieces somewhere, over or between what is there."""

    def piece(data: bytes, rng: random.Random) -> bytes:
        at, new = rng.randrange(len(data) + 1), rng.choice(pieces)
        return data[:at] + new + data[at + rng.choice((0, len(new))) :]

    return piece


def exchanger(pieces: Sequence[bytes]) -> Mutator:
    """Puts one of the pieces in place of another one that is there."""

    def piece(data: bytes, rng: random.Random) -> bytes:
        there = [each for each in pieces if each in data]
        if not there:
            return data
        old = rng.choice(there)
        at = rng.choice([match.start() for match in re.finditer(re.escape(old), data)])
        return data[:at] + rng.choice(pieces) + data[at + len(old) :]

    return piece


def matcher(pattern: bytes, replacements: Sequence[bytes]) -> Mutator:
    """Replaces what the first group of a pattern finds, at one place."""
    compiled: re.Pattern[bytes] = re.compile(pattern)

    def piece(data: bytes, rng: random.Random) -> bytes:
        spans = [match.span(1) for match in compiled.finditer(data)]
        if not spans:
            return data
        start, end = rng.choice(spans)
        return data[:start] + rng.choice(replacements) + data[end:]

    return piece


def at_offsets(layout: Callable[[bytes], Sequence[tuple[int, int, str]]]) -> Mutator:
    """Puts extreme numbers into known fields.

    Args:
        layout: Content -> (offset, size, kind) of its fields; kind `i`, `f` (little-endian),
            `I` (big-endian) or `s`.
    """

    def field(data: bytes, rng: random.Random) -> bytes:
        fields = layout(data)
        if not fields:
            return data
        at, size, kind = rng.choice(fields)
        return data[:at] + _value(size, kind, rng) + data[at + size :]

    return field


def _value(size: int, kind: str, rng: random.Random) -> bytes:
    if kind == "f":
        number = rng.choice((*FLOATS, rng.uniform(-2, 2)))
        try:
            return struct.pack("<f" if size == 4 else "<d", number)
        except OverflowError:
            return struct.pack("<f", float("inf"))
    if kind == "s":
        return rng.choice((b"", b"..", b"/", b"../x", b"\xff\xfe", b"a" * 300, b"\n", b"."))
    small = rng.choice((*INTEGERS, rng.randrange(10))) % (1 << (8 * size))
    return small.to_bytes(size, "big" if kind == "I" else "little")
