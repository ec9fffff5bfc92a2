"""Pseudo-random numbers that are the same in every run."""


def hash32(number: int) -> int:
    """Return a pseudo-random 32-bit number for `number` (the finalizer of MurmurHash3)."""
    number = (number ^ number >> 16) * 0x85EBCA6B % 2**32
    number = (number ^ number >> 13) * 0xC2B2AE35 % 2**32
    return number ^ number >> 16
